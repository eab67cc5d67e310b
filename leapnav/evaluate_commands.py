"""`leapnav evaluate` and `leapnav report`: policies beside the optimum."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from leapnav.outputs import check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.envs.bank import ScenarioBank

POLICY = """"expert", "random", "go-to-goal", the folder of a policy or of a run, or the name of a policy that ships: a
family, or "all". Runs that differ in their seed alone share a row; so do those with the same LABEL=."""


@dataclass(frozen=True)
class Evaluate:
    """Score policies side by side against the optimum, on scenarios that they have never seen."""

    policies: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="POLICY...", help=POLICY)]
    family: str = "clutter"
    """Family of the scenarios: open, clutter, polygons, rooms, slalom, or all of them."""
    split: Literal["test", "train"] = "test"
    """Which of the banks that ship with leapnav."""
    bank: Path | None = None
    """A bank of your own instead, from `leapnav bank build`."""
    count: int | None = None
    """Only so many scenarios of each family; by default all."""
    seed: int = 0
    """Of the bootstrap intervals and the random policy."""
    json: Path | None = None
    """Write the table and every episode."""
    plot: Path | None = None
    """Write a picture of the scores and the performance profiles."""
    episodes_plot: Path | None = None
    """Write a picture of the first policy's best, median and worst episodes beside their optima."""

    def run(self) -> int:
        """Plays and reports."""
        from leapnav.training.contest import contest
        from leapnav.training.entrants import load_entrant
        from leapnav.training.reports import plot_episodes, plot_scores, print_scores, scores_to_dict

        if not self.policies:
            raise ValueError("policies: name at least one folder, or expert, random or go-to-goal")
        if self.count is not None and self.count < 1:
            raise ValueError(f"count: expected at least 1, got {self.count}")
        for plot in (self.plot, self.episodes_plot):
            check_outputs(self.json, plot)
        # All are loaded before the first is played: a broken file is told at once.
        entrants = [load_entrant(name, seed=self.seed) for name in self.policies]
        found = contest(entrants, self._banks(), count=self.count, seed=self.seed)
        print_scores(found)
        if self.json is not None:
            write_json(scores_to_dict(found), self.json)
        if self.plot is not None:
            plot_scores(found, self.plot)
            print(f"wrote {self.plot}")
        if self.episodes_plot is not None:
            plot_episodes(found.banks, next(iter(found.runs.values()))[0].episodes, self.episodes_plot)
            print(f"wrote {self.episodes_plot}")
        return 0

    def _banks(self) -> list[ScenarioBank]:
        from leapnav.envs.bank import ScenarioBank
        from leapnav.envs.families import ALL, FAMILIES, check_family

        if self.bank is not None:
            return [ScenarioBank(self.bank)]
        check_family(self.family)
        families = FAMILIES if self.family == ALL else (self.family,)
        return [ScenarioBank.shipped(family, self.split) for family in families]


@dataclass(frozen=True)
class Report:
    """Training runs as one HTML page: scores, learning curves, profiles, failures and episodes."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN...")]
    """Folders of runs. Those that differ in their seed alone share a row and a curve; so do those with the same
    LABEL=."""
    out: Path = Path("report.html")
    """The page."""
    count: int | None = None
    """Only so many scenarios of each family; by default all."""
    seed: int = 0
    """Of the bootstrap intervals."""
    json: Path | None = None
    """Write the table and every episode."""

    def run(self) -> int:
        """Evaluates the runs and writes the page."""
        from leapnav.training.html_report import write_report
        from leapnav.training.reports import print_scores, scores_to_dict

        if not self.runs:
            raise ValueError("runs: name at least one folder")
        if self.count is not None and self.count < 1:
            raise ValueError(f"count: expected at least 1, got {self.count}")
        check_outputs(self.json, page=self.out)
        found = write_report(self.runs, self.out, count=self.count, seed=self.seed)
        print_scores(found)
        print(f"wrote {self.out}")
        if self.json is not None:
            write_json(scores_to_dict(found), self.json)
        return 0
