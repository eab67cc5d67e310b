"""`leapnav bank build | show`: scenario banks from the command line."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from leapnav.outputs import check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.envs.bank import ScenarioBank


IMPROVEMENT = 1e-3  # share of the cost by which a second opinion must be better to be worth a word


@dataclass(frozen=True)
class Build:
    """Draw scenarios, find their optima, and write those that are certified beyond doubt to a bank.

    Stopped and started again with the same arguments, it goes on where it was.
    """

    out: Path
    """The bank's file."""
    family: str = "clutter"
    """Family of the scenarios: open, clutter, polygons, rooms or slalom."""
    count: int = 1000
    """How many scenarios the bank is to hold."""
    seed: int = 0
    """Seed of the bank. The banks that ship with leapnav have 0 (training) and 1 (test)."""
    workers: int = os.cpu_count() or 1
    """Processes; their number changes nothing in the bank."""
    json: Path | None = None
    """Write how many scenarios were drawn, and why some were rejected."""

    def run(self) -> int:
        """Builds the bank."""
        check_outputs(self.json)
        from leapnav.experts.banks import build_bank

        bank = build_bank(self.family, self.count, self.out, seed=self.seed, workers=self.workers)
        rejected = ", ".join(f"{count} rejected: {reason}" for reason, count in bank.rejected.items())
        print(f"wrote {self.out}: {len(bank)} of {bank.drawn} scenarios drawn{f' ({rejected})' if rejected else ''}")
        summary = {"scenarios": len(bank), "drawn": bank.drawn, "rejected": dict(bank.rejected)}
        write_json({"bank": str(self.out), **summary}, self.json)
        return 0


@dataclass(frozen=True)
class Show:
    """Print a summary of a bank, draw some of its scenarios with their optima, and, if asked, search them again."""

    file: tyro.conf.Positional[Path]
    """The bank's file, or a family that ships with leapnav, as in rooms-test."""
    plot: Path | None = None
    """Where to draw the contact sheet (.png, .pdf or .svg); by default the bank's name with .png, in this folder."""
    count: int = 24
    """How many scenarios to draw, evenly spaced in the bank; 0 draws none."""
    verify: bool = False
    """Search every scenario again with a hundred times the effort (seconds each) and report where it found better."""
    json: Path | None = None
    """Write a row for each scenario: name, cost, horizon, clearance; and what --verify found."""
    workers: int = os.cpu_count() or 1
    """Processes of --verify."""

    def run(self) -> int:
        """Reports; exit code 1 if the second search found a better optimum somewhere."""
        from leapnav.envs.bank import FOLDER, ScenarioBank
        from leapnav.experts.plotting import plot_bank

        shipped = FOLDER / f"{self.file}.bank"
        bank = ScenarioBank(shipped if not self.file.exists() and shipped.exists() else self.file)
        plot = self.plot or Path(bank.path.with_suffix(".png").name)
        if self.count < 0:
            raise ValueError(f"count: expected at least 0, got {self.count!r}")
        check_outputs(self.json, plot)
        _print_summary(bank)
        if self.count > 0:
            plot_bank(bank, plot, self.count)
            print(f"wrote {plot}")
        rows = [
            {"name": scenario.name, "cost": float(cost), "horizon": scenario.horizon, "clearance": float(clearance)}
            for scenario, cost, clearance in zip(bank, bank.costs, bank.certificates[:, 3], strict=True)
        ]
        code = self._verify(bank, rows) if self.verify else 0
        write_json(rows, self.json)
        return code

    def _verify(self, bank: ScenarioBank, rows: list[dict[str, Any]]) -> int:
        from leapnav.experts.second_opinion import verify_bank

        opinions = verify_bank(bank, workers=self.workers)
        better = [opinion for opinion in opinions if opinion.improvement > IMPROVEMENT]
        for opinion in better:
            print(
                f"{opinion.name}: J = {opinion.best:.6g} instead of {opinion.cost:.6g} "
                f"({100 * opinion.improvement:.2f} % better), from {opinion.source}"
            )
        doubtful = [opinion for opinion in opinions if opinion.doubts]
        tried = sum(opinion.tried for opinion in opinions) / len(opinions)
        print(
            f"better by more than {100 * IMPROVEMENT:g} % in {len(better)} of {len(bank)} scenarios "
            f"({tried:.0f} paths tried in each)"
        )
        print(
            f"cheaper solutions that touch or lack a certificate, which the bank's builder did not see: {len(doubtful)}"
        )
        found = {opinion.name: asdict(opinion) for opinion in opinions}
        for row in rows:
            row.update(found[row["name"]])
        return 1 if better else 0


def _print_summary(bank: ScenarioBank) -> None:
    import numpy as np
    from rich import box
    from rich.console import Console
    from rich.table import Table

    residual, defect, drift, _ = bank.certificates.max(axis=0)
    horizons = np.array([scenario.horizon for scenario in bank])
    seconds = bank.second_costs / bank.costs - 1
    print(f"{bank.path}: {len(bank)} scenarios of {bank.family}, seed {bank.seed}, leapnav {bank.software}")
    print(f"  drawn              {bank.drawn}")
    for reason, count in bank.rejected.items():
        print(f"  rejected           {count} ({reason})")
    print(f"  largest residual   {residual:.1e}")
    print(f"  largest defect     {defect:.1e}")
    print(f"  largest drift of H {drift:.1e}")
    print(f"  with alternatives  {np.isfinite(seconds).sum()}")
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("", "least", "median", "most"):
        table.add_column(column, justify="right", no_wrap=True)
    for name, values, scale in (
        ("J*", bank.costs, 1),
        ("horizon (s)", horizons, 1),
        ("clearance (m)", bank.certificates[:, 3], 1),
        ("second best (% dearer)", seconds[np.isfinite(seconds)], 100),
    ):
        if len(values):
            row = scale * np.percentile(values, [0, 50, 100])
            table.add_row(name, *(f"{value:.3g}" for value in row))
    Console().print(table)
