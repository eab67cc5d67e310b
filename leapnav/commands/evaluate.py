"""`leapnav evaluate`: scores of policies against the optimum."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from leapnav.commands.options import (
    EnvironmentOption,
    FamilyOrAll,
    Horizon,
    Obstacles,
    ParallelOptions,
    Robot,
    parse_environment,
)
from leapnav.outputs import check_outputs, write_json

if TYPE_CHECKING:
    from leapnav.training.scoring.comparison import Comparison

POLICIES = (
    'Policies: "expert", a baseline ("random", "go-to-goal", "dwa", "mppi", "lattice", "freespace"), an included '
    "policy (the name of its family), the directory of a policy or of a run, or a model saved by Stable-Baselines3 "
    "(.zip). Runs that differ only in their seed share a row, and so do policies with the same LABEL=."
)


@dataclass(frozen=True)
class Evaluate(ParallelOptions):
    """Score policies side by side against the optimum, on scenarios that were not used for training."""

    policies: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="POLICY...", help=POLICIES)]
    family: FamilyOrAll | None = None
    """Family of the scenarios; by default those for which the policies were trained, or clutter without any."""
    robot: Robot | None = None
    """Model of the robot of the included banks; by default that of the policies."""
    horizon: Horizon | None = None
    """Fixed or free horizon of the included banks; by default that of the policies."""
    obstacles: Obstacles | None = None
    """Obstacles of the included banks: with a proximity cost, or hard obstacles, which cost nothing; by default those
    for which the policies were trained."""
    split: Literal["test", "train"] = "test"
    """Split of the included banks."""
    bank: Path | None = None
    """Bank file to use instead, from `leapnav bank build`."""
    count: int | None = None
    """Number of scenarios per family; by default all."""
    seed: int = 0
    """Seed of the bootstrap intervals and of the random policy."""
    env: EnvironmentOption = ()
    """Arguments of the environment (KEY=VALUE) with which a model of Stable-Baselines3 was trained; by default derived
    from its observations: a lidar with a field of view of the full circle, the state or the map."""
    trust: bool = False
    """Load a model of Stable-Baselines3 with its own loader, which executes code from the file."""
    vecnormalize: Path | None = None
    """File of the statistics of VecNormalize with which the models of Stable-Baselines3 were trained; a pickle file, so
    that it needs --trust."""
    json: Path | None = None
    """JSON file of the table and of every episode; "-" for standard output."""
    html: Path | None = None
    """HTML page (.html): scores, profiles, episodes, and the learning curves of training runs."""
    plot: Path | None = None
    """Picture of the scores and the performance profiles (.png, .pdf or .svg)."""
    episodes_plot: Path | None = None
    """Picture of the first policy's best, median and worst episodes, with their optima (.png, .pdf or .svg)."""
    decisions: Path | None = None
    """Picture of the first policy's episodes with the highest regret, coloured by where it was incurred (.png, .pdf or
    .svg), and a table of its most expensive decisions."""

    def run(self) -> int:
        """Play the episodes and report the scores."""
        from leapnav.envs.scenarios.bank import ScenarioBank
        from leapnav.envs.utils.validation import check_at_least
        from leapnav.training.policies.zips import is_zip
        from leapnav.training.scoring.comparison import compare_policies, default_banks
        from leapnav.training.scoring.html_report import write_report
        from leapnav.training.scoring.policy_specs import load_policy_spec
        from leapnav.training.scoring.reports import plot_episodes, plot_scores, print_scores, scores_to_dict

        if not self.policies:
            raise ValueError("policies: expected at least one: expert, dwa, clutter, a directory, ...; got none")
        if self.count is not None:
            check_at_least("count", self.count, 1)
        for plot in (self.plot, self.episodes_plot, self.decisions):
            check_outputs(self.json, plot, page=self.html)
        # All are loaded before the first episode, so that a damaged file is reported at once.
        environment = parse_environment(self.env)
        options = {"environment": environment, "trust": self.trust, "vecnormalize": self.vecnormalize}
        specs = [load_policy_spec(name, seed=self.seed, **options) for name in self.policies]
        for name, value in (("env", self.env), ("vecnormalize", self.vecnormalize)):
            if value and not any(is_zip(spec.name) for spec in specs):
                raise ValueError(f"{name}: expected a model of Stable-Baselines3 (.zip) among the policies, got none")
        if self.bank is not None:
            banks = [ScenarioBank(self.bank)]
        else:
            banks = default_banks(specs, self.family, self.split, self.robot, self.horizon, self.obstacles)
        comparison = compare_policies(specs, banks, count=self.count, seed=self.seed, **self.parallel)
        print_scores(comparison)
        if self.json is not None:
            write_json(scores_to_dict(comparison), self.json)
        if self.html is not None:
            write_report(comparison, self.html)
            print(f"wrote {self.html}")
        if self.plot is not None:
            plot_scores(comparison, self.plot)
            print(f"wrote {self.plot}")
        if self.episodes_plot is not None:
            name, (first, *_) = next(iter(comparison.runs.items()))
            plot_episodes(comparison.banks, first.episodes, self.episodes_plot, title=name)
            print(f"wrote {self.episodes_plot}")
        if self.decisions is not None:
            self._write_decisions(comparison)
        return 0

    def _write_decisions(self, comparison: Comparison) -> None:
        """Write the picture of the most expensive decisions of the first policy, and print a table of them."""
        from leapnav.training.scoring.decision_reports import costliest_decisions, plot_decisions, print_decisions

        assert self.decisions is not None  # checked by `run`
        name, (first, *_) = next(iter(comparison.runs.items()))
        found = costliest_decisions(first, comparison.banks, workers=self.workers)
        print_decisions(found)
        plot_decisions(found, comparison.banks, self.decisions, title=name)
        print(f"wrote {self.decisions}")
