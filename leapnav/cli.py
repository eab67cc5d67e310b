"""The command line: `leapnav solve | bank | rollout | train | evaluate | report | watch | play | demo | doctor`."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import tyro

from leapnav.bank_commands import Build, Show
from leapnav.doctor import Doctor
from leapnav.evaluate_commands import Evaluate, Report
from leapnav.outputs import check_outputs, reserved_for_json, write_json
from leapnav.play.command import Play
from leapnav.train_commands import TrainCommand, train_command
from leapnav.watch import Watch

if TYPE_CHECKING:
    from leapnav.envs.scenario import Scenario
    from leapnav.experts import Extremal, Optimum

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130  # exit codes
DEVIATION = 1e-6  # of a replay: what other versions of the libraries may make of the last bits
DESCRIPTION = "Wheeled-robot navigation in which the optimum is known: find optima, learn from them, score policies."


@dataclass(frozen=True)
class Solve:
    """Find the optimum of a scenario, or one extremal with a method of your choice, or compare the methods.

    Exit code 0: certified; 1: no certified solution; 2: bad input.
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (JSON)."""
    method: Literal["optimum", "leapfrog", "multiple_shooting", "single_shooting", "collocation", "all"] = "optimum"
    """"optimum" searches globally; the others solve from the best path of the lattice search; "all" compares them."""
    plot: Path | None = None
    """Write a picture of the solution (.png, .pdf or .svg); with "all", of the cheapest one that is certified."""
    json: Path | None = None
    """Write the solution: cost, certificate, states, controls, costates, history; with "all", one for each method.
    "-" is standard output."""

    def run(self) -> int:
        """Solves and reports."""
        from leapnav.envs.scenario import Scenario

        scenario = Scenario.from_json(self.scenario)
        check_outputs(self.json, self.plot)
        return self._compare(scenario) if self.method == "all" else self._solve(scenario)

    def _solve(self, scenario: Scenario) -> int:
        from leapnav.experts import Optimum, find_optimum, solve

        assert self.method != "all"
        extremal = find_optimum(scenario) if self.method == "optimum" else solve(scenario, method=self.method)
        print(f"{scenario.name}: {extremal.status.name}: {extremal.status.value}")
        certificate = extremal.certificate
        if certificate is not None:
            conjugate = certificate.conjugate_point
            print(f"  cost               {extremal.cost:.9f}")
            print(f"  residual           {certificate.residual:.1e}")
            print(f"  defect             {certificate.defect:.1e}")
            print(f"  drift of H         {certificate.hamiltonian_drift:.1e}")
            print(f"  conjugate point    {'none' if conjugate is None else f'{conjugate:.3f} s'}")
            print(f"  clearance          {certificate.clearance:.3f} m")
            scope = " (of the best candidate alone)" if self.method == "optimum" else ""
            print(f"  iterations         {len(extremal.history)}{scope}")
            print(f"  evaluations        {extremal.work}{scope}")
        if isinstance(extremal, Optimum) and extremal.success:
            _print_alternatives(extremal)
        self._write(scenario, extremal, extremal.to_dict())
        return 0 if extremal.success else FAILED

    def _compare(self, scenario: Scenario) -> int:
        extremals = _solve_by_all_methods(scenario)
        best = min(extremals.values(), key=lambda extremal: (not extremal.success, extremal.cost))
        content = {method: extremal.to_dict() for method, extremal in extremals.items()}
        self._write(scenario, best if best.success else None, content)
        return 0 if best.success else FAILED

    def _write(self, scenario: Scenario, extremal: Extremal | None, content: dict[str, Any]) -> None:
        from leapnav.experts.plotting import plot_solution

        write_json(content, self.json)
        if self.plot is not None and extremal is not None and len(extremal.times):
            plot_solution(scenario, extremal, self.plot)
            print(f"wrote {self.plot}")


@dataclass(frozen=True)
class Rollout:
    """Sample scenarios, find their optima, drive them in the environment and write a Minari dataset.

    Stopped and started again with the same arguments, it goes on where it was.
    """

    out: Path
    """Folder for the dataset."""
    family: str = "clutter"
    """Family of the scenarios: open, clutter, polygons, rooms or slalom."""
    count: int = 100
    """How many scenarios."""
    seed: int = 1000
    """Scenario i has seed SEED + i; at least 2, for those of 0 and 1 are in the banks that ship."""
    recoveries: int = 0
    """For each scenario, demonstrations that start from states pushed off its optimum."""
    noise: float = 0.0
    """Standard deviation of noise on the executed actions; the recorded ones are the expert's, in closed loop."""
    workers: int = os.cpu_count() or 1
    """Processes; their number changes nothing in the dataset."""
    dask: str | None = None
    """Address of a Dask scheduler (tcp://host:8786) whose workers do the work instead."""
    force: bool = False
    """Replace a dataset or an unfinished rollout that the folder holds."""
    check: bool = False
    """Write nothing: replay the dataset that the folder holds and report the largest deviation (exit code 1 if there
    is one)."""
    json: Path | None = None
    """Write what was made, or what --check found."""

    def run(self) -> int:
        """Writes the dataset, or checks it."""
        check_outputs(self.json)
        if self.check:
            return self._check()
        from leapnav.experts.demonstrations import dataset_id
        from leapnav.experts.rollouts import rollout

        summary = rollout(
            self.family,
            self.count,
            self.out,
            seed=self.seed,
            recoveries=self.recoveries,
            noise=self.noise,
            workers=self.workers,
            dask=self.dask,
            force=self.force,
        )
        print(
            f"wrote {self.out}: {summary.demonstrations} demonstrations, {summary.steps} steps "
            f"({summary.unsolved} scenarios without a certified optimum and "
            f"{summary.failed_replays} failed replays left out)"
        )
        print(f"minari.load_dataset({dataset_id(self.family)!r}) reads it with MINARI_DATASETS_PATH={self.out}")
        write_json(asdict(summary), self.json)
        return 0

    def _check(self) -> int:
        from leapnav.experts.rollouts import check_dataset

        replay = check_dataset(self.out)
        print(
            f"{self.out}: {replay.episodes} episodes replayed; largest deviation of observations "
            f"{replay.observation:.1e}, rewards {replay.reward:.1e}, states {replay.state:.1e} (episode {replay.worst})"
        )
        write_json(asdict(replay), self.json)
        return 0 if max(replay.observation, replay.reward, replay.state) <= DEVIATION else FAILED


@dataclass(frozen=True)
class Demo:
    """The whole way on clutter scenarios: optima, demonstrations, a clone, and its score against the optimum."""

    out: Path = Path("runs/demo")
    """Folder of the results; what is there already is used again."""

    def run(self) -> int:
        """Runs the demo."""
        from leapnav.demo import run_demo

        run_demo(self.out)
        return 0


@dataclass(frozen=True)
class Bank:
    """Scenario banks: scenarios with their certified optima in one file."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Build, tyro.conf.subcommand("build")] | Annotated[Show, tyro.conf.subcommand("show")]
    ]

    @property
    def json(self) -> Path | None:
        """Where the action writes."""
        return self.action.json

    def run(self) -> int:
        """Builds or shows a bank."""
        return self.action.run()


COMMANDS = {
    "solve": Solve,
    "bank": Bank,
    "rollout": Rollout,
    "train": TrainCommand,  # `main` puts one in its place that knows the defaults of the family
    "evaluate": Evaluate,
    "report": Report,
    "watch": Watch,
    "play": Play,
    "demo": Demo,
    "doctor": Doctor,
}


def parse(words: list[str]) -> Any:
    """The command that the words ask for; it has a method `run`.

    Raises:
        ValueError, FileNotFoundError: the run to resume is damaged, or there is none.
        SystemExit: the words are no command, or ask for help.

    """
    commands = {**COMMANDS, "train": train_command(words)}
    return tyro.extras.subcommand_cli_from_dict(commands, prog="leapnav", description=DESCRIPTION, args=words)


def main(arguments: list[str] | None = None) -> int:
    """Runs a command and returns its exit code; bad input is one line on standard error and exit code 2."""
    try:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        with reserved_for_json(getattr(command, "json", None)):
            return command.run()
    except BrokenPipeError:  # whoever read what was printed has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"leapnav: {_message(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("leapnav: interrupted", file=sys.stderr)
        return INTERRUPTED


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _solve_by_all_methods(scenario: Scenario) -> dict[str, Extremal]:
    """Every method's extremal from the same path; prints them side by side."""
    from leapnav.experts import OptimalControlProblem, Status, solve
    from leapnav.experts import Path as GuessedPath
    from leapnav.experts.certificate import failure
    from leapnav.experts.lattice import Lattice
    from leapnav.experts.methods import Method

    candidate = next(Lattice(scenario).candidates(), None)
    if candidate is None:
        print(f"{scenario.name}: {Status.NO_PATH.name}: {Status.NO_PATH.value}")
        return dict.fromkeys(get_args(Method), failure(OptimalControlProblem.from_scenario(scenario), Status.NO_PATH))
    path = GuessedPath(candidate.times, candidate.poses)
    extremals, seconds = {}, {}
    for method in get_args(Method):
        # The first solve loads or compiles what the second one, which is timed, then finds in memory.
        solve(scenario, method=method, guess=path)
        start = perf_counter()
        extremals[method] = solve(scenario, method=method, guess=path)
        seconds[method] = perf_counter() - start
    print(f"{scenario.name}: every method from the best path of the lattice search")
    _print_comparison(extremals, seconds)
    for method, extremal in extremals.items():
        if not extremal.success:
            print(f"{method}: {extremal.status.value}")
    return extremals


def _print_comparison(extremals: Mapping[str, Extremal], seconds: Mapping[str, float]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("method", no_wrap=True)
    table.add_column("status", overflow="fold")
    for column in ("cost", "residual", "itera-\ntions", "evalu-\nations", "time\nms"):
        table.add_column(column, justify="right", no_wrap=True)
    for method, extremal in extremals.items():
        certificate = extremal.certificate
        table.add_row(
            method,
            extremal.status.name,
            "-" if certificate is None else f"{extremal.cost:.9g}",
            "-" if certificate is None else f"{max(certificate.residual, certificate.defect):.1e}",
            str(len(extremal.history)),
            str(extremal.work),
            f"{1000 * seconds[method]:.1f}",
        )
    Console().print(table)


def _print_alternatives(optimum: Optimum) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    for doubt in optimum.doubts:
        print(f"  in doubt           J = {doubt.cost:.6g} was found too: {doubt.status.value}")
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("cost", "dearer", "winding", "clearance"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("driving", overflow="fold")
    table.add_column("sides", overflow="fold")
    for extremal in (optimum, *optimum.alternatives):
        clearance = extremal.certificate.clearance if extremal.certificate is not None else None
        table.add_row(
            f"{extremal.cost:.6f}",
            f"{100 * (extremal.cost / optimum.cost - 1):.2f} %" if optimum.cost > 0 else "-",
            f"{extremal.heading_winding:+d}" if extremal.heading_winding else "0",
            "-" if clearance is None else f"{clearance:.3f} m",
            ", ".join(extremal.driving_modes) or "turn on the spot",
            "".join(side[0].upper() for side in extremal.path_class) or "-",
        )
    print("Local optima (sides: where each obstacle lies as seen from the path, Left or Right)")
    Console().print(table)
