"""Policies side by side: every one on the same scenarios, and each row's runs together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from leapnav.envs.bank import ScenarioBank
from leapnav.training.entrants import NamedEntrant, grouped
from leapnav.training.evaluation import Evaluation, evaluate
from leapnav.training.scores import Score, score


@dataclass(frozen=True, eq=False)
class Contest:
    """What policies did on some banks.

    Attributes:
        banks: that were played, one after the other.
        runs: for each row of the table, its runs' evaluations over all banks.
        seed: of the bootstrap.

    """

    banks: tuple[ScenarioBank, ...]
    runs: Mapping[str, Sequence[Evaluation]]
    seed: int

    @property
    def families(self) -> tuple[str, ...]:
        """The families that were played."""
        return tuple(dict.fromkeys(bank.family for bank in self.banks))

    def scores(self) -> list[Score]:
        """The rows of the table."""
        return [score(name, runs, self.seed) for name, runs in self.runs.items()]

    def of(self, family: str) -> Contest:
        """The same of one family alone."""
        chosen = {
            name: [Evaluation(tuple(e for e in run if e.family == family), run.milliseconds) for run in runs]
            for name, runs in self.runs.items()
        }
        return Contest(tuple(bank for bank in self.banks if bank.family == family), chosen, self.seed)


def contest(
    entrants: Sequence[NamedEntrant],
    banks: Sequence[ScenarioBank],
    *,
    count: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Contest:
    """Plays all policies on all scenarios of the banks.

    Args:
        entrants: see `load_entrant`.
        banks: one or more.
        count: only so many scenarios of each.
        seed: of the bootstrap intervals and of the disturbances, if the environment has any.
        progress: show progress bars.

    Raises:
        ValueError: see `grouped` and `evaluate`.

    """
    runs: dict[str, list[Evaluation]] = {}
    for row, members in grouped(entrants).items():
        runs[row] = []
        for member in members:
            found = [
                evaluate(
                    member.entrant,
                    bank,
                    count=count,
                    environment=member.environment,
                    seed=seed,
                    label=f"{member.name}: {bank.family}",
                    progress=progress,
                )
                for bank in banks
            ]
            episodes = tuple(episode for evaluation in found for episode in evaluation)
            runs[row].append(Evaluation(episodes, float(np.mean([e.milliseconds for e in found]))))
    return Contest(tuple(banks), runs, seed)
