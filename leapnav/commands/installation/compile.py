"""`leapnav compile`: all kernels into the cache, in advance."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from time import perf_counter
from typing import Any

from leapnav.outputs import check_outputs, write_json


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
        print(f"compiled {summary['compiled']} kernels in {summary['seconds']:.1f} s; cache: {summary['cache']}")
        write_json(summary, self.json)
        return 0


def compile_missing(jobs: int | None = None) -> dict[str, Any]:
    """Compile the kernels that are not in the cache, with the generated ones of the robots.

    Args:
        jobs: number of processes; None for one per core.

    Returns:
        `compiled`, the number of kernels; `cache`, the directory; `seconds`.

    """
    from leapnav.envs.kernels.compilation import GENERATED, prepare
    from leapnav.envs.kernels.decorator import kernel_cache, kernels_of

    start = perf_counter()
    for package in ("leapnav.envs", "leapnav.experts"):
        for module in walk_packages(import_module(package).__path__, f"{package}."):
            try:
                import_module(module.name)
            except ModuleNotFoundError as error:  # a package of an extra that is not installed
                if (error.name or "").startswith("leapnav"):
                    raise
    _load_robots()
    count = prepare(*kernels_of("leapnav", GENERATED), jobs=jobs)
    return {"compiled": count, "cache": kernel_cache(), "seconds": perf_counter() - start}


def _load_robots() -> None:
    """Generate the functions of the problems of all robots."""
    from leapnav.envs.robots.base import MODELS
    from leapnav.envs.scenarios.scenario import Scenario
    from leapnav.experts.problem.problem import OptimalControlProblem
    from leapnav.experts.transcription.direct import generated_functions

    fields = {"arena": (0, 0, 4, 4), "start": (1, 2, 0), "goal": (3, 2, 0), "horizon": 2.0}
    for robot in MODELS:
        scenario = Scenario.from_dict({**fields, "robot": {"model": robot}})
        generated_functions(OptimalControlProblem.from_scenario(scenario))
