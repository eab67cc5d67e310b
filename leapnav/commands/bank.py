"""`leapnav bank build|show|verify|card|prove|shortest`: scenario banks."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from leapnav.commands.options import Family, FamilyTaskOptions, ParallelOptions
from leapnav.outputs import FAILED, check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.envs.scenarios.bank import ScenarioBank

# Fraction of the reference cost. Smaller differences between two searches are not reported.
MIN_IMPROVEMENT = 1e-3
RESUMPTION = "the same command resumes where it stopped"


@dataclass(frozen=True)
class Build(FamilyTaskOptions, ParallelOptions):
    """Sample scenarios, or read them; find their optima; and write those with an unambiguous certificate to a bank.

    The same command resumes an interrupted build.
    """

    out: Path
    """Output file of the bank."""
    scenarios: tuple[str, ...] = ()
    """Scenario files, directories of them, or quoted patterns such as "worlds/*.json"; they are used instead of sampled
    scenarios, and the options from --family to --seed are not."""
    doubtful: bool = False
    """Also admit files with a certified optimum for which a cheaper solution touches or was not certified."""
    origin: str = ""
    """Where the files come from, for the data card."""
    licence: str = ""
    """Licence of the files, for the data card."""
    family: Family = "clutter"
    """Family of the scenarios: built in, module:function, or a file (.bank, .json)."""
    count: int = 1000
    """Number of scenarios in the bank."""
    seed: int = 0
    """Seed of the bank; the included banks have 0 (training) and 1 (test)."""
    json: Path | None = None
    """JSON file of the numbers of sampled and of rejected scenarios; "-" for standard output."""

    resumption = RESUMPTION

    def run(self) -> int:
        """Build the bank."""
        check_outputs(self.json)
        from leapnav.experts.data.banks import build_bank, build_bank_of

        if self.scenarios:
            sources = {"origin": self.origin, "licence": self.licence}
            bank = build_bank_of(self.scenarios, self.out, doubtful=self.doubtful, **sources, **self.parallel)
            assert bank.given is not None
            for kind in ("rejected", "doubtful"):
                for name, reason in bank.given.get(kind, {}).items():
                    print(f"{name}: {kind}: {reason}")
        else:
            bank = build_bank(self.family, self.count, self.out, seed=self.seed, **self.task, **self.parallel)
        rejected = ", ".join(f"{count} rejected: {reason}" for reason, count in bank.rejected.items())
        kind = "sampled" if bank.given is None else "given"
        print(f"wrote {self.out}: {len(bank)} of {bank.drawn} {kind} scenarios{f' ({rejected})' if rejected else ''}")
        summary = {"scenarios": len(bank), "drawn": bank.drawn, "rejected": dict(bank.rejected)}
        write_json({"bank": str(self.out), **summary}, self.json)
        return 0


@dataclass(frozen=True)
class Show:
    """Check the checksums and the optima of a bank, print a summary, and optionally draw scenarios."""

    file: tyro.conf.Positional[Path]
    """Bank file, or the name of an included bank, for example rooms-test."""
    plot: Path | None = None
    """Picture of scenarios with their optima (.png, .pdf or .svg)."""
    count: int = 24
    """Number of scenarios in the picture, evenly spaced in the bank."""
    json: Path | None = None
    """JSON file of name, cost, horizon (s), clearance (m) and lower bound of every scenario; "-" for standard
    output."""

    def run(self) -> int:
        """Print the summary and draw the picture."""
        from leapnav.envs.utils.validation import check_at_least

        check_at_least("count", self.count, 1)
        check_outputs(self.json, self.plot)
        bank = _checked(self.file)
        _print_summary(bank)
        if self.plot is not None:
            from leapnav.experts.plotting.extremals import plot_bank

            plot_bank(bank, self.plot, self.count)
            print(f"wrote {self.plot}")
        columns = (bank.costs, bank.horizons, bank.certificates[:, 3], bank.lower_bounds)
        rows = [
            {
                "name": scenario.name,
                "cost": float(cost),
                "horizon": float(horizon),
                "clearance": float(clearance),
                "lower_bound": None if math.isnan(bound) else float(bound),
            }
            for scenario, cost, horizon, clearance, bound in zip(bank, *columns, strict=True)
        ]
        write_json(rows, self.json)
        return 0


@dataclass(frozen=True)
class Verify(ParallelOptions):
    """Search every scenario of a bank again, with about 100 times the effort (seconds each).

    Exit code 1: a lower cost was found.
    """

    file: tyro.conf.Positional[Path]
    """Bank file, or the name of an included bank, for example rooms-test."""
    json: Path | None = None
    """JSON file of the results of all scenarios; "-" for standard output."""

    def run(self) -> int:
        """Search again and print lower costs."""
        from leapnav.experts.second_opinion import verify_bank

        check_outputs(self.json)
        bank = _checked(self.file)
        opinions = verify_bank(bank, **self.parallel)
        improved = [opinion for opinion in opinions if opinion.improvement > MIN_IMPROVEMENT]
        for opinion in improved:
            print(
                f"{opinion.name}: J = {opinion.best:.6g} instead of {opinion.cost:.6g} "
                f"({100 * opinion.improvement:.2f} % lower), from {opinion.source}"
            )
        tried = sum(opinion.tried for opinion in opinions) / len(opinions)
        print(
            f"cost lower by more than {100 * MIN_IMPROVEMENT:g} % in {len(improved)} of {len(bank)} scenarios "
            f"({tried:.0f} paths tried in each)"
        )
        doubtful = sum(bool(opinion.doubts) for opinion in opinions)
        print(f"scenarios with new solutions of lower cost that collide or are not certified: {doubtful}")
        write_json([asdict(opinion) for opinion in opinions], self.json)
        return FAILED if improved else 0


@dataclass(frozen=True)
class Card:
    """Print the data card of a bank, as Markdown for the Hugging Face Hub."""

    file: tyro.conf.Positional[Path]
    """Bank file, or the name of an included bank, for example rooms-test."""

    def run(self) -> int:
        """Print the card."""
        from leapnav.experts.data.cards import data_card

        print(data_card(_checked(self.file)), end="")
        return 0


@dataclass(frozen=True)
class Prove:
    """Prove lower bounds of the cost of the scenarios of a bank, check the proofs, and store the bounds in the bank.

    Scenarios with a bound of at most this gap are skipped, others are computed again. The same command resumes after an
    interruption.

    Exit code 1: there is no bound of a scenario, for a reason that is printed.
    """

    file: tyro.conf.Positional[Path]
    """Bank file."""
    gap: float = 0.05
    """Relative optimality gap to prove."""
    time_limit: float = 60.0
    """Time (s) for each scenario, after which the best bound proved so far is stored."""
    count: int | None = None
    """Number of scenarios, from the first of the bank; by default all."""
    workers: int = os.cpu_count() or 1
    """Number of processes, each with one thread."""
    json: Path | None = None
    """JSON file of the results of all scenarios that were not skipped; "-" for standard output."""

    resumption = RESUMPTION

    def run(self) -> int:
        """Prove, and print the distribution of the gaps."""
        from leapnav.envs.scenarios.bank import ScenarioBank
        from leapnav.experts.data.bank_bounds import prove_bank

        check_outputs(self.json)
        results = prove_bank(
            self.file, gap=self.gap, time_limit=self.time_limit, count=self.count, workers=self.workers
        )
        for result in results:
            if result.fault:
                print(f"{result.name}: no lower bound: {result.fault}")
        if results:
            print(f"wrote {self.file}; scenarios examined: {len(results)}")
        else:
            print(f"{self.file}: a gap of at most {100 * self.gap:g} % is already proved for all of these scenarios")
        bank = ScenarioBank(self.file)
        for line in gap_summary(bank):
            print(line)
        write_json([asdict(result) for result in results], self.json)
        return FAILED if any(result.fault for result in results) else 0


@dataclass(frozen=True)
class Shortest:
    """Find the shortest path and the minimum time of each scenario of a bank, and store them in the bank.

    They are the denominators of SPL and SCT in `leapnav evaluate`. The same command resumes after an interruption.

    Exit code 1: one of the two was not found for a scenario, whose name is printed.
    """

    file: tyro.conf.Positional[Path]
    """Bank file."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: Path | None = None
    """JSON file of the length (m) and the time (s) of all scenarios; "-" for standard output."""

    resumption = RESUMPTION

    def run(self) -> int:
        """Search, and print the scenarios without a result."""
        from leapnav.experts.data.bank_shortest import find_shortest

        check_outputs(self.json)
        results = find_shortest(self.file, workers=self.workers)
        missing = [result.name for result in results if math.isnan(result.length) or math.isnan(result.time)]
        for name in missing:
            print(f"{name}: no shortest path or no minimum time was found")
        print(f"wrote {self.file}; scenarios: {len(results)}")
        write_json([asdict(result) for result in results], self.json)
        return FAILED if missing else 0


@dataclass(frozen=True)
class Bank:
    """Build and inspect scenario banks, files of scenarios with their certified optima, and add bounds to them."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[
            Annotated[Build, tyro.conf.subcommand("build")]
            | Annotated[Show, tyro.conf.subcommand("show")]
            | Annotated[Verify, tyro.conf.subcommand("verify")]
            | Annotated[Card, tyro.conf.subcommand("card")]
            | Annotated[Prove, tyro.conf.subcommand("prove")]
            | Annotated[Shortest, tyro.conf.subcommand("shortest")],
            tyro.conf.arg(name=""),
        ]
    ]


def gap_summary(bank: ScenarioBank) -> list[str]:
    """Return the lines that describe the proved lower bounds of a bank, none if it has no bounds."""
    import numpy as np

    gaps = 1.0 - bank.lower_bounds / bank.costs
    gaps = 100 * gaps[np.isfinite(gaps)]
    if not len(gaps):
        return []
    median, high = np.percentile(gaps, [50, 90])
    counts = ", ".join(f"{limit} % in {(gaps < limit * (1 + 1e-6)).sum()}" for limit in (1, 2, 5, 10, 20))
    return [
        f"  lower bounds       proved for {len(gaps)} of {len(bank)} scenarios",
        f"  proved gap         median {median:.2f} %, 90th percentile {high:.2f} %, maximum {gaps.max():.2f} %",
        f"  gap at most        {counts}",
    ]


def _checked(file: Path) -> ScenarioBank:
    """Return the bank in a file, or an included bank by its name, after a check of its checksums and its optima."""
    from leapnav.envs.scenarios.bank import BANK_DIRECTORY, ScenarioBank

    shipped = BANK_DIRECTORY / f"{file}.bank"
    bank = ScenarioBank(shipped if not file.exists() and shipped.exists() else file)
    bank.verify_checksums()
    for index in range(len(bank)):
        bank.reference(index)
    return bank


def _print_summary(bank: ScenarioBank) -> None:
    import numpy as np

    from leapnav.envs.utils.tables import print_table

    residual, defect, drift, _ = bank.certificates.max(axis=0)
    excess = bank.second_costs / bank.costs - 1
    kind = "" if bank.horizon == "fixed" else ", free horizon"
    kind += "" if bank.obstacles == "cost" else ", hard obstacles"
    source = f"seed {bank.seed}" if bank.given is None else "given"
    print(f"{bank.path}: {len(bank)} scenarios of {bank.family}{kind}, {source}, leapnav {bank.software}")
    robots = {scenario.robot.model_dump_json(exclude_none=True) for scenario in bank}
    others = "" if len(robots) <= 1 else f" (of {len(robots)} different ones)"
    print(f"  robot              {bank.robot.model_dump_json(exclude_none=True)}{others}")
    print("  checksums, optima  verified")
    print(f"  {'sampled' if bank.given is None else 'given  '}            {bank.drawn}")
    for reason, count in bank.rejected.items():
        print(f"  rejected           {count} ({reason})")
    print(f"  maximum residual   {residual:.1e}")
    print(f"  maximum defect     {defect:.1e}")
    print(f"  maximum drift of H {drift:.1e}")
    print(f"  with alternatives  {np.isfinite(excess).sum()}")
    for line in gap_summary(bank):
        print(line)
    quantities = {
        "J*": bank.costs,
        "horizon (s)" if bank.horizon == "fixed" else "duration (s)": bank.horizons,
        "clearance (m)": bank.certificates[:, 3],
        "excess cost of the second best (%)": 100 * excess[np.isfinite(excess)],
        "shortest length (m)": bank.shortest_lengths[np.isfinite(bank.shortest_lengths)],
        "minimum time (s)": bank.shortest_times[np.isfinite(bank.shortest_times)],
    }
    rows = [
        (name, *(f"{value:.3g}" for value in np.percentile(values, [0, 50, 100])))
        for name, values in quantities.items()
        if len(values)
    ]
    print_table(("", "minimum", "median", "maximum"), rows)
