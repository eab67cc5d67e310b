"""Pools of processes: those of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, cast

from joblib import Parallel, parallel_config

# Joblib's batch size: with one task, an interruption or a lost worker loses only the tasks at work. Joblib declares a
# string but accepts an integer.
ONE = cast(str, 1)
DASK_TIMEOUT = 30  # s to wait for a scheduler and its workers


@contextmanager
def process_pool(
    workers: int = 1,
    dask: str | None = None,
    *,
    return_as: Literal["generator", "generator_unordered"] = "generator_unordered",
    pre_dispatch: str = "4 * n_jobs",
) -> Iterator[Parallel]:
    """Provide a pool of processes.

    Args:
        workers: number of processes of this machine; not used with `dask`.
        dask: address of a Dask scheduler (`tcp://host:8786`) whose workers are used instead. They need leapnav, but no
            access to the files of this machine. A task of a lost worker is computed again by another one.
        return_as: order of the results: that of the tasks, or that in which they are finished.
        pre_dispatch: number of tasks that are prepared in advance.

    Raises:
        ModuleNotFoundError: `dask` is given, and the extra `cluster` is not installed.
        OSError: the scheduler cannot be reached.

    """
    if dask is None:
        yield Parallel(n_jobs=workers, return_as=return_as, batch_size=ONE, pre_dispatch=pre_dispatch)
        return
    try:
        from dask.distributed import Client
    except ImportError:
        raise ModuleNotFoundError('a Dask cluster needs dask: pip install "leapnav[cluster]"') from None
    with Client(dask, timeout=DASK_TIMEOUT), parallel_config(backend="dask", wait_for_workers_timeout=DASK_TIMEOUT):
        yield Parallel(n_jobs=-1, return_as=return_as, batch_size=ONE, pre_dispatch=pre_dispatch)
