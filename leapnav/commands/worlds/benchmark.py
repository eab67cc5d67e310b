"""`leapnav benchmark`: policies and the expert in the worlds of other benchmarks."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from leapnav.commands.options import TaskOptions
from leapnav.outputs import FAILED, check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.envs.scenarios.scenario import Scenario
    from leapnav.experts.minimum_time import MinimumTime


@dataclass(frozen=True)
class BenchmarkBarn(TaskOptions):
    """Score policies in the worlds of the BARN challenge, with its own score beside ours.

    The worlds are solved first, and the optima are stored in a bank. The BARN challenge runs in another simulator
    (Gazebo), with another robot, and counts the time only: its published scores cannot be compared with these.
    """

    folder: tyro.conf.Positional[Path]
    """Directory of the files world_N.world, or a clone of the challenge's repository."""
    policy: tuple[str, ...] = ("expert",)
    """Policies, see `leapnav evaluate`."""
    bank: Path = Path("barn.bank")
    """Bank of the worlds; it is built unless it exists."""
    count: int | None = None
    """Number of worlds; by default all."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: Path | None = None
    """JSON file of the tables and of every episode; "-" for standard output."""

    resumption = "the same command resumes the bank where it stopped"

    def run(self) -> int:
        """Build the bank, play the episodes and report the scores."""
        check_outputs(self.json)
        from leapnav.envs.worlds.barn import LICENCE, ORIGIN, path_lengths, read_barn
        from leapnav.experts.data.banks import build_bank_of
        from leapnav.training.scoring.barn import barn_scores
        from leapnav.training.scoring.comparison import compare_policies
        from leapnav.training.scoring.policy_specs import load_policy_spec
        from leapnav.training.scoring.reports import print_barn_scores, print_scores, scores_to_dict

        specs = [load_policy_spec(name) for name in self.policy]
        scenarios = read_barn(self.folder, **self.task)
        bank = build_bank_of(scenarios, self.bank, doubtful=True, origin=ORIGIN, licence=LICENCE, workers=self.workers)
        assert bank.given is not None
        for name, reason in bank.given["rejected"].items():
            print(f"{name}: left out: {reason}")
        if bank.given["doubtful"]:
            print(
                f"doubtful optima, since a cheaper solution touches or was not certified: {len(bank.given['doubtful'])}"
            )
        comparison = compare_policies(specs, [bank], count=self.count, workers=self.workers)
        scores = barn_scores(comparison, path_lengths(self.folder))
        print_scores(comparison)
        print_barn_scores(scores)
        write_json({**scores_to_dict(comparison), "barn": [asdict(row) for row in scores]}, self.json)
        return 0


@dataclass(frozen=True)
class BenchmarkDynobench:
    """Compare the minimum time of the problems of dynobench with the durations of its stored solutions.

    The robot's boxes are exact, and the paths end at the goal, which the stored solutions reach within a tolerance. The
    times are upper bounds of the minimum time. Each path is then divided into the time steps of dynobench, and checked
    by its rules. Problems of robots without wheels, or with several robots, are left out.
    """

    folder: tyro.conf.Positional[Path]
    """Clone of the repository https://github.com/quimortiz/dynobench."""
    tol: float = 0.02
    """Tolerance of the minimum time, see `leapnav.experts.minimum_time`."""
    json: Path | None = None
    """JSON file of the table; "-" for standard output."""

    def run(self) -> int:
        """Compute the minimum times and print the table; it fails if one is missing or breaks a rule."""
        check_outputs(self.json)
        from leapnav.envs.worlds.dynobench import read_dynobench
        from leapnav.envs.worlds.dynobench_rules import check_trajectory, discretise

        problems = read_dynobench(self.folder)
        planners = sorted({planner for problem in problems.values() for planner in problem.durations})
        rows: dict[str, dict[str, float | None]] = {}
        all_accepted = True
        for name, problem in problems.items():
            if problem.scenario is None:
                print(f"{name}: left out: {problem.reason}")
                continue
            row, found = _minimum_time(problem.scenario, self.tol)
            row = {"leapnav": row.pop("leapnav"), "steps": None, **row, **dict.fromkeys(planners)}
            if found is not None:
                extremal = found.extremal
                trajectory = discretise(problem, lambda times: extremal.evaluate(times)[0], found.horizon)  # noqa: B023
                row["steps"] = problem.time_step * len(trajectory.actions)
                for rule, size in check_trajectory(problem, trajectory).broken.items():
                    print(f"{name}: not accepted by the rules of dynobench: {rule} {size:.3g}")
                    all_accepted = False
            rows[name] = {**row, **problem.durations}
        _print_durations(rows)
        write_json(rows, self.json)
        return 0 if all_accepted and all(row["leapnav"] is not None for row in rows.values()) else FAILED


@dataclass(frozen=True)
class BenchmarkTpcap:
    """Compute the minimum times of the cases of the competition TPCAP (automated parking).

    The car has the dimensions and the limits of the competition: of speed, acceleration, steering and its rate. It is
    at rest at both ends. Obstacles must not be touched.
    """

    folder: tyro.conf.Positional[Path]
    """Directory of the files CaseN.csv."""
    tol: float = 0.02
    """Tolerance of the minimum time, see `leapnav.experts.minimum_time`."""
    json: Path | None = None
    """JSON file of the table; "-" for standard output."""

    def run(self) -> int:
        """Compute the minimum times and print the table; it fails if one is missing."""
        check_outputs(self.json)
        from leapnav.envs.worlds.tpcap import read_tpcap

        rows: dict[str, dict[str, float | None]] = {}
        for scenario in read_tpcap(self.folder):
            cost = scenario.cost.model_copy(update={"proximity_weight": 0.0})
            rows[scenario.name or ""] = _minimum_time(scenario.model_copy(update={"cost": cost}), self.tol)[0]
        _print_durations(rows)
        write_json(rows, self.json)
        return 0 if all(row["leapnav"] is not None for row in rows.values()) else FAILED


def _minimum_time(scenario: Scenario, tol: float) -> tuple[dict[str, float | None], MinimumTime | None]:
    """Return time (s), tolerance and clearance (m) of the path of minimum time, None if there is none, and the path."""
    from leapnav.experts import SolveError, minimum_time

    try:
        found = minimum_time(scenario, tol)
    except SolveError as error:
        print(error)
        return dict.fromkeys(("leapnav", "tolerance", "clearance")), None
    certificate = found.extremal.certificate
    clearance = certificate.clearance if certificate is not None else None
    return {"leapnav": found.horizon, "tolerance": found.tolerance, "clearance": clearance}, found


@dataclass(frozen=True)
class Benchmark:
    """Run a benchmark of the field on your own download."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[
            Annotated[BenchmarkBarn, tyro.conf.subcommand("barn")]
            | Annotated[BenchmarkDynobench, tyro.conf.subcommand("dynobench")]
            | Annotated[BenchmarkTpcap, tyro.conf.subcommand("tpcap")],
            tyro.conf.arg(name=""),
        ]
    ]


def _print_durations(rows: Mapping[str, Mapping[str, float | None]]) -> None:
    from leapnav.envs.utils.tables import print_table

    cells = [
        (name, *("-" if value is None else f"{value:.3g}" for value in row.values())) for name, row in rows.items()
    ]
    print_table(("problem", *next(iter(rows.values()), {})), cells, title="durations (s)")
