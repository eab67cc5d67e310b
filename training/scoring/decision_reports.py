"""Pictures and tables of the most expensive decisions of a policy."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import IO, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.utils.colors import FAILURE, OPTIMUM
from leapnav.envs.utils.tables import print_table
from leapnav.experts.plotting.scenes import draw_scenario
from leapnav.training.scoring.decisions import Decisions, decisions_of, level_regrets
from leapnav.training.scoring.results import Evaluation, bank_identity, bank_of

N_SHOWN = 8  # episodes in a picture
COLOR_MAP = "viridis_r"
COLOR_QUANTILE = 95  # of the regrets in a picture that are not those of the loss; the end of the color scale
MIN_COLOR_SCALE = 0.05


def costliest_decisions(
    evaluation: Evaluation,
    banks: Sequence[ScenarioBank],
    count: int = N_SHOWN,
    *,
    workers: int = 1,
    progress: bool = True,
) -> list[Decisions]:
    """Return the decisions of the episodes with the highest regret, in decreasing order of the regret.

    Args:
        evaluation: the episodes.
        banks: their banks.
        count: number of episodes.
        workers: number of processes for the searches.
        progress: show a progress bar.

    """
    order = np.argsort(-level_regrets(evaluation), kind="stable")[:count]
    found: list[Decisions] = []
    for bank in banks:
        chosen = tuple(e for e in (evaluation.episodes[i] for i in order) if e.bank == bank_identity(bank))
        part = replace(evaluation, episodes=chosen)
        found += decisions_of(part, bank, workers=workers, progress=progress)
    return sorted(found, key=lambda one: -float(one.regrets.sum()))


def print_decisions(decisions: Sequence[Decisions]) -> None:
    """Print the most expensive decision of each episode, that of the loss excluded."""
    rows = []
    for one in decisions:
        ordinary = _before_loss(one)
        k = int(np.argmax(ordinary)) if len(ordinary) else 0
        rows.append(
            (
                one.episode.scenario,
                "success" if one.episode.success else "collision" if one.episode.collision else "missed",
                f"{one.times[k]:.2f}",
                f"{one.times[k + 1]:.2f}",
                f"{one.regrets[k]:.3f}",
                f"{one.regrets.sum():.3f}",
                "" if np.isnan(one.lost_at) else f"{one.lost_at:.2f}",
            )
        )
    columns = ("scenario", "outcome", "from\ns", "to\ns", "regret", "regret of\nthe level", "lost at\ns")
    print_table(columns, rows, title="Most expensive decisions", text=2)


def plot_decisions(
    decisions: Sequence[Decisions],
    banks: Sequence[ScenarioBank],
    path: str | os.PathLike[str] | IO[bytes],
    columns: int = 4,
    *,
    title: str | None = None,
) -> None:
    """Plot where along the paths of episodes the regret was incurred, with the optima, into a file.

    Args:
        decisions: the decisions of each episode.
        banks: the banks of the episodes.
        path: the file.
        columns: number of episodes in each row.
        title: title of the figure, such as the name of the policy.

    Raises:
        ValueError: there are no episodes.

    """
    if not decisions:
        raise ValueError("decisions: expected those of at least one episode, got none")
    n_rows = -(-len(decisions) // columns)
    figure = Figure(figsize=(3.1 * columns + 0.8, 3.3 * n_rows), layout="constrained")
    grid = figure.subplots(n_rows, columns, squeeze=False)
    rates = np.concatenate([_before_loss(one) / np.diff(one.times)[: len(_before_loss(one))] for one in decisions])
    top = max(MIN_COLOR_SCALE, float(np.percentile(rates, COLOR_QUANTILE))) if len(rates) else MIN_COLOR_SCALE
    scale = Normalize(0.0, top)
    for axes in grid.ravel()[len(decisions) :]:
        axes.set_visible(False)
    for axes, one in zip(grid.ravel()[: len(decisions)], decisions, strict=True):
        _draw_decisions(axes, banks, one, scale)
    figure.colorbar(ScalarMappable(scale, COLOR_MAP), ax=grid, label="regret per second", extend="max", shrink=0.8)
    if title is not None:
        figure.suptitle(title)
    figure.savefig(path, dpi=130)


def _before_loss(decisions: Decisions) -> np.ndarray:
    """Return the regrets of the intervals before that after which no optimum exists."""
    if np.isnan(decisions.lost_at):
        return decisions.regrets if decisions.episode.success else decisions.regrets[:-1]
    return decisions.regrets[: int(np.searchsorted(decisions.times, decisions.lost_at - 1e-9)) - 1]


def _draw_decisions(axes: Any, banks: Sequence[ScenarioBank], decisions: Decisions, scale: Normalize) -> None:
    """Draw an episode with its optimum (dashed), the path coloured by the regret, red after the loss."""
    episode = decisions.episode
    bank = bank_of(episode, banks)
    draw_scenario(axes, bank[episode.index])
    axes.plot(*bank.states(episode.index)[:, :2].T, color=OPTIMUM, linewidth=1.0, linestyle="--")
    ordinary = _before_loss(decisions)
    steps = decisions.steps
    rates = ordinary / np.diff(decisions.times)[: len(ordinary)]
    pieces = [episode.states[steps[k] : steps[k + 1] + 1, :2] for k in range(len(ordinary))]
    axes.add_collection(LineCollection(pieces, array=rates, cmap=COLOR_MAP, norm=scale, linewidths=2.6))
    lost = episode.states[steps[len(ordinary)] :, :2]
    title = f"{episode.scenario}: regret {decisions.regrets.sum():.2f}"
    if len(ordinary) < len(decisions.regrets):
        axes.plot(*lost.T, color=FAILURE, linewidth=1.8)
        axes.plot(*lost[0], "x", color=FAILURE, markersize=7)
        title = f"{episode.scenario}: {'collision' if episode.collision else 'missed'}, {ordinary.sum():.2f} before"
    axes.set_title(title, fontsize=9)
