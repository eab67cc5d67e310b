"""What an evaluation shows: the table on the terminal, its JSON, and pictures of episodes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table

import leapnav
from leapnav.experts.demonstrations import ENVIRONMENT, Demonstration
from leapnav.experts.plotting import OPTIMUM, draw_scenario
from leapnav.training.evaluation import Episode, Interval, Score

POLICY_COLOR, FAILURE_COLOR = "#2662ab", "#c0392b"


def print_scores(scores: Sequence[Score], console: Console | None = None) -> None:
    """The table of policies, each figure with its 95 % bootstrap interval."""
    table = Table(
        title=f"{scores[0].episodes} scenarios; brackets: 95 % bootstrap interval",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("policy", min_width=6, overflow="fold")
    for column in ("success\n%", "collision\n%", "SOC\n", "regret\n%, median", "return\nmean"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in scores:
        table.add_row(
            row.policy,
            _cell(row.success, 100, 1, 0),
            _cell(row.collision, 100, 1, 0),
            _cell(row.soc, 1, 3, 2),
            _cell(row.regret, 100, 2, 2),
            _cell(row.mean_return, 1, 1, 1),
        )
    (console or Console()).print(table)


def _cell(interval: Interval, factor: float, digits: int, interval_digits: int) -> str:
    if math.isnan(interval.value):
        return "-"
    low, high = (f"{factor * bound:.{interval_digits}f}" for bound in (interval.low, interval.high))
    return f"{factor * interval.value:.{digits}f}\n[{low}, {high}]"


def write_scores(
    scores: Sequence[Score], episodes: Mapping[str, Sequence[Episode]], path: str | os.PathLike[str]
) -> None:
    """The table and every episode behind it as JSON (null where there is nothing to measure)."""
    content = {
        "environment": ENVIRONMENT,
        "leapnav": leapnav.__version__,
        "scores": [asdict(row) for row in scores],
        "episodes": {
            name: [
                {
                    "scenario": e.scenario,
                    "success": e.success,
                    "collision": e.collision,
                    "cost": e.cost,
                    "return": e.episode_return,
                    "reference_cost": e.reference_cost,
                    "reached_reference": e.reached_reference,
                }
                for e in played
            ]
            for name, played in episodes.items()
        },
    }
    Path(path).write_text(json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plot_gallery(
    references: Sequence[Demonstration], episodes: Sequence[Episode], path: str | os.PathLike[str], columns: int = 4
) -> None:
    """Scenarios side by side: the optimum in black, the policy's path in blue, or red where it failed."""
    rows = math.ceil(len(references) / columns)
    figure = Figure(figsize=(3.1 * columns, 3.3 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, reference, episode in zip(grid, references, episodes, strict=False):
        draw_scenario(axes, reference.scenario)
        axes.plot(*reference.states[:, :2].T, color=OPTIMUM, linewidth=1.2, linestyle="--")
        axes.plot(*episode.states[:, :2].T, color=POLICY_COLOR if episode.success else FAILURE_COLOR, linewidth=1.8)
        outcome = (
            f"regret {100 * episode.regret:.1f} %"
            if episode.success
            else ("collision" if episode.collision else "missed")
        )
        axes.set_title(f"{episode.scenario}: {outcome}", fontsize=9)
    for axes in grid[len(references) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=130)
