"""`leapnav report`: training runs as an HTML page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from leapnav.commands.options import EnvironmentOption, FamilyOrAll, parse_environment
from leapnav.outputs import check_outputs, write_json


@dataclass(frozen=True)
class Report:
    """Evaluate training runs and other policies and write an HTML page: scores, learning curves, profiles, episodes."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")]
    """Run directories, or other policies as in `leapnav evaluate`, which have no learning curves. Runs that differ only
    in their seed share a row and a curve, and so do runs with the same LABEL=."""
    out: Path = Path("report.html")
    """Output file of the page (.html)."""
    family: FamilyOrAll | None = None
    """Family of the scenarios; by default those of the runs, or clutter without runs."""
    count: int | None = None
    """Number of scenarios per family; by default all."""
    seed: int = 0
    """Seed of the bootstrap intervals."""
    env: EnvironmentOption = ()
    """Arguments of the environment (KEY=VALUE) with which a model of Stable-Baselines3 was trained; by default derived
    from its observation space, for a lidar."""
    trust: bool = False
    """Load a model of Stable-Baselines3 with its own loader, which executes code from the file."""
    json: Path | None = None
    """JSON file of the table and of every episode; "-" for standard output."""

    def run(self) -> int:
        """Evaluate the runs and write the page."""
        from leapnav.envs.utils.validation import check_at_least
        from leapnav.training.scoring.html_report import write_report
        from leapnav.training.scoring.reports import print_scores, scores_to_dict

        if not self.runs:
            raise ValueError("runs: expected at least one run directory, got none")
        if self.count is not None:
            check_at_least("count", self.count, 1)
        check_outputs(self.json, page=self.out)
        comparison = write_report(
            self.runs,
            self.out,
            family=self.family,
            count=self.count,
            environment=parse_environment(self.env),
            trust=self.trust,
            seed=self.seed,
        )
        print_scores(comparison)
        print(f"wrote {self.out}")
        if self.json is not None:
            write_json(scores_to_dict(comparison), self.json)
        return 0
