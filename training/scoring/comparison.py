"""Comparison of policies on the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.training.scoring.evaluation import Evaluation, evaluate
from leapnav.training.scoring.policy_specs import PolicySpec, group_by_row
from leapnav.training.scoring.scores import Score, score


@dataclass(frozen=True, eq=False)
class Comparison:
    """The results of several policies on the same banks.

    Attributes:
        banks: the banks.
        runs: for each row of the table, the evaluations of its runs on all banks.
        seed: random seed of the bootstrap.

    """

    banks: tuple[ScenarioBank, ...]
    runs: Mapping[str, Sequence[Evaluation]]
    seed: int

    @property
    def families(self) -> tuple[str, ...]:
        """The families of the banks."""
        return tuple(dict.fromkeys(bank.family for bank in self.banks))

    def scores(self) -> list[Score]:
        """Compute the rows of the table."""
        return [score(name, runs, self.seed) for name, runs in self.runs.items()]

    def of(self, family: str) -> Comparison:
        """Return the comparison restricted to one family."""
        runs = {
            name: [Evaluation(tuple(e for e in run if e.family == family), run.milliseconds) for run in evaluations]
            for name, evaluations in self.runs.items()
        }
        return Comparison(tuple(bank for bank in self.banks if bank.family == family), runs, self.seed)


def compare_policies(
    specs: Sequence[PolicySpec],
    banks: Sequence[ScenarioBank],
    *,
    count: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Comparison:
    """Evaluate all policies on all scenarios of the banks.

    Args:
        specs: the policies, see `load_policy_spec`.
        banks: the banks, at least one.
        count: number of scenarios of each bank; None: all.
        seed: random seed of the bootstrap intervals and the disturbances.
        progress: show progress bars.

    Raises:
        ValueError: see `group_by_row` and `evaluate`.

    """
    runs: dict[str, list[Evaluation]] = {}
    for row, members in group_by_row(specs).items():
        runs[row] = []
        for member in members:
            evaluations = [
                evaluate(
                    member.policy,
                    bank,
                    count=count,
                    environment=member.environment,
                    seed=seed,
                    label=f"{member.name}: {bank.family}",
                    progress=progress,
                )
                for bank in banks
            ]
            episodes = tuple(episode for evaluation in evaluations for episode in evaluation)
            milliseconds = float(np.mean([evaluation.milliseconds for evaluation in evaluations]))
            runs[row].append(Evaluation(episodes, milliseconds))
    return Comparison(tuple(banks), runs, seed)
