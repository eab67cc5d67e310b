"""`leapnav compile`: all kernels into the cache, in advance."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

from leapnav.outputs import check_outputs, write_json


@dataclass(frozen=True)
class CompilationSummary:
    """The result of `compile_missing`.

    Attributes:
        compiled: names of the kernels that were not in the cache, by module.
        cache: directory of the cache.
        seconds: duration (s).

    """

    compiled: dict[str, list[str]]
    cache: Path
    seconds: float

    @property
    def count(self) -> int:
        """Number of kernels that were compiled."""
        return sum(map(len, self.compiled.values()))


@dataclass(frozen=True)
class Compile:
    """Compile all kernels into the cache, in parallel processes.

    Without this command, kernels are compiled at first use. Nothing is done for kernels that are in the cache.
    """

    jobs: int | None = None
    """Number of processes; by default one per core."""
    json: Path | None = None
    """JSON file of the compiled kernels, the cache directory and the duration (s); "-" for standard output."""

    def run(self) -> int:
        """Compile and report."""
        from leapnav.envs.utils.validation import check_integer

        if self.jobs is not None:
            check_integer("jobs", self.jobs, 1)
        check_outputs(self.json)
        summary = compile_missing(self.jobs)
        if summary.count == 0:
            print(f"all kernels are in the cache ({summary.seconds:.1f} s)")
        print(f"cache: {summary.cache}")
        write_json(asdict(summary), self.json)
        return 0


def compile_missing(jobs: int | None = None) -> CompilationSummary:
    """Compile the kernels that are not in the cache, and print their names; print nothing if there are none.

    The extremal flow of the unicycle is included, which is generated when it is first needed.

    Args:
        jobs: number of processes; None for one per core.

    """
    from leapnav.envs.kernels.compilation import all_kernels, missing, prepare
    from leapnav.envs.kernels.decorator import kernel_cache

    start = perf_counter()
    before = _cached()
    prepare(*missing(all_kernels()), jobs=jobs, advise=False)
    _compile_unicycle_flow()
    compiled: defaultdict[str, list[str]] = defaultdict(list)
    for path in sorted(_cached() - before):
        compiled[path.parent.name.rpartition("-")[0]].append(path.name.partition(".py")[0])
    summary = CompilationSummary(dict(compiled), kernel_cache(), perf_counter() - start)
    if summary.count:
        for module, names in compiled.items():
            print(f"{module}: {', '.join(names)}")
        print(f"compiled {summary.count} kernels in {summary.seconds:.1f} s", flush=True)
    return summary


def _compile_unicycle_flow() -> None:
    """Compile the extremal flow that every scenario uses, or load it from the cache."""
    from leapnav.envs.scenarios.scenario import Scenario
    from leapnav.experts.problem.problem import OptimalControlProblem

    scenario = Scenario(arena=(0, 0, 2, 2), start=(0.5, 1, 0), goal=(1.5, 1, 0), horizon=2)
    OptimalControlProblem.from_scenario(scenario).arrays  # noqa: B018 (the property compiles)


def _cached() -> set[Path]:
    """The index files of all kernels in the cache, named MODULE-STAMP/KERNEL.pyVERSION.nbi."""
    from leapnav.envs.kernels.decorator import kernel_cache

    return set(kernel_cache().glob("*/*.nbi"))
