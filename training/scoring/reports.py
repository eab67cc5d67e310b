"""Output of a comparison: tables on the terminal, JSON, and plots of scores, profiles and episodes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import leapnav
from leapnav.envs.scenarios.bank import BANK_DIRECTORY, ScenarioBank
from leapnav.envs.utils.colors import CURVES, FAILURE, OPTIMUM, POLICY
from leapnav.envs.utils.files import write_text
from leapnav.envs.utils.json_utils import encode, plain
from leapnav.envs.utils.tables import print_table
from leapnav.experts.data.datasets import ENVIRONMENT
from leapnav.experts.plotting.scenes import draw_scenario
from leapnav.training.scoring.barn import BarnScore
from leapnav.training.scoring.comparison import Comparison
from leapnav.training.scoring.results import Episode, bank_identity, bank_of
from leapnav.training.scoring.scores import Bracket, Interval, Score, profile

RATIOS = np.concatenate([np.linspace(1.0, 1.2, 81), np.linspace(1.2, 2.0, 41)[1:]])  # of the profiles
# Columns of the table: title, attribute of `Score`, factor, decimals of the value and of its interval.
COLUMNS = (
    ("success\n%", "success", 100, 1, 0),
    ("collision\n%", "collision", 100, 1, 0),
    ("SOC\n", "soc", 1, 3, 2),
    ("SOC\nIQM", "soc_iqm", 1, 3, 2),
    ("SPL\n", "spl", 1, 3, 2),
    ("SCT\n", "sct", 1, 3, 2),
    ("regret\n%, median", "regret", 100, 2, 2),
    ("SOC,\npose reached", "reached_soc", 1, 3, 2),
    ("regret,\npose reached\n%, median", "reached_regret", 100, 2, 2),
    ("clearance\nm, median", "clearance", 1, 2, 2),
)
NEGATIVE_REGRET = (
    "A negative regret: the episodes cost less than the best known optimum for the pose reached. A robot that slips "
    "violates the unicycle model, for which the optimum is computed; otherwise the search has missed a better path."
)
# Attributes of `Score` in the tables of the documentation.
MARKDOWN_COLUMNS = ("success", "collision", "soc", "reached_regret")
# Columns that fit into the 80 characters of a terminal, and those of further tables; the other outputs have all.
TERMINAL_COLUMNS = ("success", "collision", "soc", "soc_iqm", "regret")
REACHED_COLUMNS = ("reached_soc", "reached_regret")
PATH_COLUMNS = ("soc", "spl", "sct")
RUN_COLUMNS = ("success", "soc", "regret")
RUNS_TITLE = "each run; brackets: 95 % interval over runs and scenarios"


def print_scores(comparison: Comparison) -> None:
    """Print the tables of the policies with 95 % intervals, and for several banks a table by bank."""
    scores = comparison.scores()
    times = [f"{row.milliseconds:.2f}" if math.isfinite(row.milliseconds) else "-" for row in scores]
    title = f"{scores[0].episodes} scenarios; brackets: 95 % interval over the scenarios"
    _print_columns(scores, TERMINAL_COLUMNS, title, ("time\nms", times))
    unknown = ("unknown\nepisodes", [str(row.unknown) for row in scores])
    _print_columns(scores, REACHED_COLUMNS, "compared with the optimum for the pose reached", unknown)
    if any(math.isfinite(row.spl.value) or math.isfinite(row.sct.value) for row in scores):  # unknown in many banks
        _print_columns(scores, PATH_COLUMNS, "success weighted by optimal cost, path length and completion time")
    if any(row.runs > 1 for row in scores):
        columns = [column for column in COLUMNS if column[1] in RUN_COLUMNS]
        rows = [
            (row_name(row), *(runs_cell(getattr(row, name), *form) for _, name, *form in columns)) for row in scores
        ]
        print_table(("policy", *(title for title, *_ in columns)), rows, title=RUNS_TITLE)
    files = [bank.path.name if bank.path.parent == BANK_DIRECTORY else str(bank.path) for bank in comparison.banks]
    print(f"Scenarios: {', '.join(files)}")
    observed = [f"{sensors} ({', '.join(names)})" for sensors, names in sensors_of(comparison).items()]
    print(f"Observed: {'; '.join(observed)}")
    for note in training_notes(comparison):
        print(note)
    if any(row.reached_regret.value < 0 for row in scores):
        print(NEGATIVE_REGRET)
    if any(row.true_regret.episodes for row in scores):
        print("Cost above the true optimal cost of the scenario, between proved limits (medians):")
        for row in scores:
            print(f"  {row_name(row)}: {_bracket_text(row.true_regret)}")
    if len(comparison.banks) > 1:
        _print_banks(comparison)


def training_notes(comparison: Comparison) -> list[str]:
    """Return sentences on policies that were trained in the scenarios of a bank, or in another family or robot."""
    notes = []
    for name, bank in zip(comparison.bank_names, comparison.banks, strict=True):
        if rows := comparison.trained_on(bank):
            notes.append(f"{name}: {', '.join(rows)} trained in these scenarios")
        for row, differences in comparison.trained_elsewhere(bank).items():
            notes.append(f"{name}: {row} trained {differences}")
    return notes


def sensors_of(comparison: Comparison) -> dict[str, list[str]]:
    """Return what policies observe, each with the names of the policies."""
    found: dict[str, list[str]] = {}
    for name, runs in comparison.runs.items():
        for sensors in dict.fromkeys(run.settings.sensors for run in runs):
            found.setdefault(sensors, []).append(name)
    return found


def _print_columns(
    scores: Sequence[Score], names: Sequence[str], title: str, last: tuple[str, Sequence[str]] | None = None
) -> None:
    """Print a table with the given columns and intervals over the scenarios; `last` is another column."""
    columns = [column for column in COLUMNS if column[1] in names]
    rows = [[row_name(row), *(cell(getattr(row, name), *form) for _, name, *form in columns)] for row in scores]
    titles = ["policy", *(title for title, *_ in columns)]
    if last is not None:
        titles.append(last[0])
        for row, value in zip(rows, last[1], strict=True):
            row.append(value)
    print_table(titles, rows, title=title)


def print_barn_scores(scores: Sequence[BarnScore]) -> None:
    """Print the scores of the BARN challenge."""
    rows = [
        (
            row.policy,
            f"{100 * row.success:.1f}",
            f"{row.seconds:.1f}" if math.isfinite(row.seconds) else "-",
            f"{row.score:.4f}",
        )
        for row in scores
    ]
    print_table(("policy", "success %", "time s", "score"), rows, title="BARN challenge")


def _bracket_text(bracket: Bracket) -> str:
    if bracket.episodes == 0:
        return "no successful episode in a scenario with a proved lower bound"
    episodes = "1 episode" if bracket.episodes == 1 else f"{bracket.episodes} episodes"
    return f"{100 * bracket.low:z.2f} to {100 * bracket.high:z.2f} % ({episodes})"


def _print_banks(comparison: Comparison) -> None:
    grouping = "family" if len(comparison.families) == len(comparison.banks) else "bank"
    parts = [{row.policy: row for row in comparison.of(bank).scores()} for bank in comparison.banks]
    rows = [
        (name, *(f"{100 * part[name].success.value:.1f} / {part[name].soc.value:.3f}" for part in parts))
        for name in comparison.runs
    ]
    print_table(("policy", *comparison.bank_names), rows, title=f"success % / SOC by {grouping}")


def row_name(row: Score) -> str:
    """Return the name of a row with its number of runs."""
    return row.policy if row.runs == 1 else f"{row.policy} ({row.runs} runs)"


def cell(interval: Interval, factor: float, digits: int, interval_digits: int) -> str:
    """Format a value and, on the next line, its interval."""
    if math.isnan(interval.value):
        return "-"
    low, high = (f"{factor * bound:z.{interval_digits}f}" for bound in (interval.low, interval.high))
    return f"{factor * interval.value:z.{digits}f}\n[{low}, {high}]"


def runs_cell(interval: Interval, factor: float, digits: int, interval_digits: int) -> str:
    """Format the values of each run and, on the next line, the interval over runs and scenarios."""
    values = ", ".join("-" if math.isnan(value) else f"{factor * value:z.{digits}f}" for value in interval.runs)
    if math.isnan(interval.over_runs.low):
        return values
    low, high = (f"{factor * bound:z.{interval_digits}f}" for bound in interval.over_runs)
    return f"{values}\n[{low}, {high}]"


def markdown_cells(row: Score) -> str:
    """Return the `MARKDOWN_COLUMNS`, with intervals over the scenarios, as cells of a Markdown table."""
    return _markdown(row, cell)


def markdown_run_cells(row: Score) -> str:
    """Return the `MARKDOWN_COLUMNS`, with the values of each run and intervals over runs and scenarios."""
    return _markdown(row, runs_cell)


def _markdown(row: Score, form: Callable[[Interval, float, int, int], str]) -> str:
    columns = [(name, factor, digits) for _, name, factor, digits, _ in COLUMNS if name in MARKDOWN_COLUMNS]
    cells = [form(getattr(row, name), factor, digits, digits) for name, factor, digits in columns]
    return " | ".join(cells).replace("\n", " ")


def scores_to_dict(comparison: Comparison) -> dict[str, Any]:
    """Return the tables and all episodes as JSON-able values; NaN and infinity become None."""
    content = {
        "environment": ENVIRONMENT,
        "leapnav": leapnav.__version__,
        "banks": [
            {
                "family": bank.family,
                "file": bank.path.name,
                "identity": bank_identity(bank),
                "scores": [row.to_dict() for row in comparison.of(bank).scores()],
            }
            for bank in comparison.banks
        ],
        "scores": [row.to_dict() for row in comparison.scores()],
        "families": {
            family: [row.to_dict() for row in comparison.of(family).scores()] for family in comparison.families
        },
        "episodes": {
            name: [[episode.to_dict() for episode in run] for run in runs] for name, runs in comparison.runs.items()
        },
    }
    return plain(content)


def write_scores(comparison: Comparison, path: str | os.PathLike[str]) -> None:
    """Write `scores_to_dict` to a JSON file."""
    write_text(path, encode(scores_to_dict(comparison), indent=1) + "\n")


def plot_scores(comparison: Comparison, path: str | os.PathLike[str]) -> None:
    """Plot success rate and SOC with their intervals, and the performance profiles, into a file."""
    names = list(comparison.runs)
    figure = Figure(figsize=(11, 2.4 + 0.35 * len(names)), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.6))
    scores = comparison.scores()
    for axes, attribute, title in ((left, "success", "success rate"), (middle, "soc", "SOC")):
        draw_intervals(axes, {row.policy: getattr(row, attribute) for row in scores}, title)
    middle.set_yticklabels([])
    draw_profiles(right, comparison)
    figure.savefig(path, dpi=130)


def draw_intervals(axes: Axes, intervals: Mapping[str, Interval], title: str) -> None:
    """Draw values with their intervals, one row for each."""
    for row, interval in enumerate(intervals.values()):
        color = CURVES[row % len(CURVES)]
        axes.plot([interval.low, interval.high], [row, row], color=color, linewidth=5, alpha=0.35)
        axes.plot([interval.value], [row], "o", color=color, markersize=5)
    axes.set_yticks(range(len(intervals)), list(intervals))
    axes.invert_yaxis()
    axes.set(title=title, xlim=(-0.02, 1.02))
    axes.grid(axis="x", alpha=0.3)


def draw_profiles(axes: Axes, comparison: Comparison) -> None:
    """Draw the performance profiles: the fraction of episodes that succeed with J / J* up to a ratio."""
    for index, (name, runs) in enumerate(comparison.runs.items()):
        value, low, high = profile(runs, RATIOS)
        color = CURVES[index % len(CURVES)]
        axes.plot(RATIOS, value, color=color, linewidth=1.6, label=name)
        axes.fill_between(RATIOS, low, high, color=color, alpha=0.15, linewidth=0)
    axes.set(xlabel="cost / optimal cost", ylabel="fraction of episodes", ylim=(0, 1.02), xlim=(RATIOS[0], RATIOS[-1]))
    axes.set_title("performance profile")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=8)


def plot_episodes(
    banks: Sequence[ScenarioBank],
    episodes: Sequence[Episode],
    path: str | os.PathLike[str] | IO[bytes],
    columns: int = 4,
    *,
    title: str | None = None,
) -> None:
    """Plot the best, median and worst episodes of a policy with their optima into a file.

    Args:
        banks: the banks of the episodes.
        episodes: the episodes of a policy.
        path: the file.
        columns: number of episodes in each row, see `extremes`.
        title: title of the figure, such as the name of the policy.

    """
    rows = extremes(episodes, columns)
    figure = Figure(figsize=(3.1 * columns, 3.3 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for row_axes, (group, chosen) in zip(grid, rows.items(), strict=True):
        for column, axes in enumerate(row_axes):
            if column < len(chosen):
                draw_episode(axes, banks, chosen[column])
            else:
                axes.set_visible(False)
        row_axes[0].set_ylabel(group, fontsize=11)
    if title is not None:
        figure.suptitle(title)
    figure.savefig(path, dpi=130)


def extremes(episodes: Sequence[Episode], count: int) -> dict[str, list[Episode]]:
    """Select the best, median and worst episodes, each once, without empty groups.

    Best and median refer to the regret of the successful episodes. The worst are unsuccessful episodes, collisions
    first, followed by the successful episodes with the highest regret.

    Args:
        episodes: the episodes.
        count: maximum number of episodes in each group.

    """
    successes = sorted((e for e in episodes if e.success), key=_regret_or_infinity)
    failures = sorted((e for e in episodes if not e.success), key=lambda e: not e.collision)
    best, others = successes[:count], successes[count:]
    n_left = len(others) - min(len(others), max(0, count - len(failures)))
    worst = failures[:count] + others[n_left:][::-1]
    middle = min(max(0, len(successes) // 2 - count // 2 - count), max(0, n_left - count))
    rows = {"best": best, "median": others[:n_left][middle : middle + count], "worst": worst}
    return {title: chosen for title, chosen in rows.items() if chosen}


def _regret_or_infinity(episode: Episode) -> float:
    return math.inf if math.isnan(episode.reached_regret) else episode.reached_regret


def draw_episode(axes: Axes, banks: Sequence[ScenarioBank], episode: Episode) -> None:
    """Draw a scenario with its optimum (dashed) and the policy's path (blue if successful, else red)."""
    bank = bank_of(episode, banks)
    draw_scenario(axes, bank[episode.index])
    axes.plot(*bank.states(episode.index)[:, :2].T, color=OPTIMUM, linewidth=1.2, linestyle="--")
    axes.plot(*episode.states[:, :2].T, color=POLICY if episode.success else FAILURE, linewidth=1.8)
    missed = f"missed by {episode.goal_distance:.2f} m, {episode.heading_error:.2f} rad after {episode.duration:.1f} s"
    outcome = f"collision after {episode.duration:.1f} s" if episode.collision else missed
    if episode.success:
        outcome = (
            "regret unknown" if math.isnan(episode.reached_regret) else f"regret {100 * episode.reached_regret:z.1f} %"
        )
    axes.set_title(f"{episode.scenario}\n{outcome}", fontsize=9)
