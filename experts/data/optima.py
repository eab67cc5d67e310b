"""Optima of many problems on several processes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import cast

from joblib import delayed

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.optimum import Effort, Optimum, find_optimum
from leapnav.experts.pools import process_pool
from leapnav.experts.problem.problem import OptimalControlProblem


def find_optima(
    problems: Iterable[Scenario | OptimalControlProblem],
    effort: Effort = "high",
    *,
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
) -> list[Optimum]:
    """Find the optimum of each problem, see `find_optimum`.

    The result does not depend on the number of processes. `build_bank_of` writes the optima to a file, and continues
    after an interruption.

    Args:
        problems: scenarios or optimal control problems.
        effort: see `find_optimum`.
        workers: number of processes. They take about 4 s to start, so that two need more time than one for fewer than
            about 250 scenarios of `clutter`.
        dask: address of a Dask scheduler (`tcp://host:8786`) whose workers are used instead.
        progress: whether to show a progress bar.

    Returns:
        The optima in the order of the problems; those without `success` have the reason as their status.

    Raises:
        TypeError: one of them is neither a scenario nor a problem.
        ValueError: the effort is unknown, or workers < 1.
        ModuleNotFoundError: `dask` is given, and the extra `cluster` is not installed.
        OSError: the scheduler cannot be reached.

    """
    check_at_least("workers", workers, 1)
    given = list(problems)
    task = delayed(find_optimum)
    found: list[Optimum] = []
    with (
        progress_bar(total=len(given), label="Finding optima", unit="problems", show=progress) as bar,
        process_pool(workers, dask, return_as="generator") as pool,
    ):
        calls = (task(problem, effort) for problem in given)
        for optimum in cast(Iterator[Optimum], pool(calls)):
            found.append(optimum)
            bar.update()
    return found
