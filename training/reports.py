"""What an evaluation shows: the table on the terminal, its JSON, and pictures of profiles and episodes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table

import leapnav
from leapnav.envs.bank import ScenarioBank
from leapnav.experts.demonstrations import ENVIRONMENT
from leapnav.experts.plain import finite
from leapnav.experts.plotting import CURVES, OPTIMUM, draw_scenario
from leapnav.training.contest import Contest
from leapnav.training.evaluation import Episode
from leapnav.training.scores import Interval, Score, profile

POLICY_COLOR, FAILURE_COLOR = "#2662ab", "#c0392b"
RATIOS = np.concatenate([np.linspace(1.0, 1.2, 81), np.linspace(1.2, 2.0, 41)[1:]])  # of a performance profile
# Columns of the table: title, attribute, factor, digits of the value and of its interval.
COLUMNS = (
    ("success\n%", "success", 100, 1, 0),
    ("collision\n%", "collision", 100, 1, 0),
    ("SOC\n", "soc", 1, 3, 2),
    ("SOC\nIQM", "soc_iqm", 1, 3, 2),
    ("regret\n%, median", "regret", 100, 2, 2),
    ("clearance\nm, median", "clearance", 1, 2, 2),
)
ON_A_TERMINAL = 5  # columns, which have 80 characters; pages and files have all


def print_scores(contest: Contest, console: Console | None = None) -> None:
    """The table of policies, each figure with its 95 % bootstrap interval; with several families, theirs too."""
    console = console or Console()
    scores = contest.scores()
    resampled = "the runs" if any(row.runs > 1 for row in scores) else "the scenarios"
    table = Table(
        title=f"{scores[0].episodes} scenarios; brackets: 95 % bootstrap interval over {resampled}",
        box=box.SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
    )
    table.add_column("policy", min_width=10, overflow="fold")
    for title, *_ in COLUMNS[:ON_A_TERMINAL]:
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("time\nms", justify="right", no_wrap=True)
    for row in scores:
        cells = [cell(getattr(row, name), *form) for _, name, *form in COLUMNS[:ON_A_TERMINAL]]
        table.add_row(_name(row), *cells, f"{row.milliseconds:.2f}" if math.isfinite(row.milliseconds) else "-")
    console.print(table)
    if len(contest.families) > 1:
        console.print(_family_table(contest))


def _family_table(contest: Contest) -> Table:
    table = Table(title="success % / SOC by family", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("policy", min_width=6, overflow="fold")
    rows: dict[str, list[str]] = {name: [] for name in contest.runs}
    for family in contest.families:
        table.add_column(family, justify="right", no_wrap=True)
        for row in contest.of(family).scores():
            rows[row.policy].append(f"{100 * row.success.value:.1f} / {row.soc.value:.3f}")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    return table


def _name(row: Score) -> str:
    return row.policy if row.runs == 1 else f"{row.policy} ({row.runs} runs)"


def cell(interval: Interval, factor: float, digits: int, interval_digits: int) -> str:
    """A figure and, on the next line, its interval."""
    if math.isnan(interval.value):
        return "-"
    low, high = (f"{factor * bound:.{interval_digits}f}" for bound in (interval.low, interval.high))
    return f"{factor * interval.value:.{digits}f}\n[{low}, {high}]"


def scores_to_dict(contest: Contest) -> dict[str, Any]:
    """The table and every episode behind it as plain numbers (None where there is nothing to measure)."""
    content = {
        "environment": ENVIRONMENT,
        "leapnav": leapnav.__version__,
        "banks": [{"family": bank.family, "file": bank.path.name} for bank in contest.banks],
        "scores": [asdict(row) for row in contest.scores()],
        "families": {family: [asdict(row) for row in contest.of(family).scores()] for family in contest.families},
        "episodes": {
            name: [[_record(episode) for episode in run] for run in runs] for name, runs in contest.runs.items()
        },
    }
    return finite(content)


def write_scores(contest: Contest, path: str | os.PathLike[str]) -> None:
    """`scores_to_dict` as JSON."""
    Path(path).write_text(json.dumps(scores_to_dict(contest), indent=1, allow_nan=False) + "\n")


def _record(episode: Episode) -> dict[str, Any]:
    record = {name: value for name, value in vars(episode).items() if name not in ("states", "episode_return")}
    return {**record, "return": episode.episode_return, "soc": episode.soc, "regret": episode.regret}


def plot_scores(contest: Contest, path: str | os.PathLike[str]) -> None:
    """Writes a picture: success and SOC with their intervals, and the performance profiles."""
    names = list(contest.runs)
    figure = Figure(figsize=(11, 2.4 + 0.35 * len(names)), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.6))
    scores = contest.scores()
    for axes, attribute, title in ((left, "success", "success rate"), (middle, "soc", "SOC")):
        draw_intervals(axes, {row.policy: getattr(row, attribute) for row in scores}, title)
    middle.set_yticklabels([])
    draw_profiles(right, contest)
    figure.savefig(path, dpi=130)


def draw_intervals(axes: Axes, intervals: Mapping[str, Interval], title: str) -> None:
    """Values with their intervals, one below the other."""
    for number, interval in enumerate(intervals.values()):
        color = CURVES[number % len(CURVES)]
        axes.plot([interval.low, interval.high], [number, number], color=color, linewidth=5, alpha=0.35)
        axes.plot([interval.value], [number], "o", color=color, markersize=5)
    axes.set_yticks(range(len(intervals)), list(intervals))
    axes.invert_yaxis()
    axes.set(title=title, xlim=(-0.02, 1.02))
    axes.grid(axis="x", alpha=0.3)


def draw_profiles(axes: Axes, contest: Contest) -> None:
    """The share of episodes that succeed at a cost of at most tau times the optimum's, against tau."""
    for number, (name, runs) in enumerate(contest.runs.items()):
        value, low, high = profile(runs, RATIOS, contest.seed)
        color = CURVES[number % len(CURVES)]
        axes.plot(RATIOS, value, color=color, linewidth=1.6, label=name)
        axes.fill_between(RATIOS, low, high, color=color, alpha=0.15, linewidth=0)
    axes.set(xlabel="cost / optimum", ylabel="share of episodes", ylim=(0, 1.02), xlim=(RATIOS[0], RATIOS[-1]))
    axes.set_title("performance profile")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=8)


def plot_episodes(
    banks: Sequence[ScenarioBank],
    episodes: Sequence[Episode],
    path: str | os.PathLike[str] | IO[bytes],
    columns: int = 4,
) -> None:
    """Writes a picture of a policy's best, median and worst episodes beside their optima.

    Best and median are by cost over that of the optimum, among the successes; the worst are failures, collisions first,
    as far as there are.
    """
    rows = extremes(episodes, columns)
    figure = Figure(figsize=(3.1 * columns, 3.3 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for line, (title, chosen) in zip(grid, rows.items(), strict=True):
        for number, axes in enumerate(line):
            if number < len(chosen):
                draw_episode(axes, banks, chosen[number])
            else:
                axes.set_visible(False)
        line[0].set_ylabel(title, fontsize=11)
    figure.savefig(path, dpi=130)


def extremes(episodes: Sequence[Episode], count: int) -> dict[str, list[Episode]]:
    """The best, the median and the worst episodes."""
    successes = sorted((e for e in episodes if e.success), key=lambda e: e.cost / e.reference_cost)
    failures = sorted((e for e in episodes if not e.success), key=lambda e: not e.collision)
    middle = max(0, len(successes) // 2 - count // 2)
    worst = failures[:count] + successes[::-1][: max(0, count - len(failures))]
    rows = {"best": successes[:count], "median": successes[middle : middle + count], "worst": worst}
    return {title: chosen for title, chosen in rows.items() if chosen}


def draw_episode(axes: Axes, banks: Sequence[ScenarioBank], episode: Episode) -> None:
    """A scenario with its optimum, dashed, and the policy's path: blue, or red where it failed."""
    bank = next(bank for bank in banks if bank.family == episode.family)
    draw_scenario(axes, bank[episode.index])
    axes.plot(*bank.states(episode.index)[:, :2].T, color=OPTIMUM, linewidth=1.2, linestyle="--")
    axes.plot(*episode.states[:, :2].T, color=POLICY_COLOR if episode.success else FAILURE_COLOR, linewidth=1.8)
    outcome = "collision" if episode.collision else "missed"
    if episode.success:
        outcome = f"cost {100 * (episode.cost / episode.reference_cost - 1):+.1f} %"
    axes.set_title(f"{episode.scenario}: {outcome}", fontsize=9)
