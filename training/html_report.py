"""`leapnav report`: training runs as one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import io
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

import leapnav
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import ALL, FAMILIES
from leapnav.experts.plotting import CURVES
from leapnav.training.config import RunConfig, read_config
from leapnav.training.contest import Contest, contest
from leapnav.training.entrants import NamedEntrant, grouped, load_entrant
from leapnav.training.evaluation import Episode, Evaluation
from leapnav.training.reports import COLUMNS, cell, draw_profiles, plot_episodes

BASELINES = ("expert", "go-to-goal", "random")
CLEARANCES = (0.0, 0.05, 0.1, 0.2, math.inf)  # m, that kinds of scenarios are told apart by
GALLERY_COLUMNS = 4


@dataclass(frozen=True)
class _Run:
    """A run's record."""

    entrant: NamedEntrant
    folder: Path
    config: RunConfig
    record: dict[str, Any]
    evaluations: list[dict[str, Any]]


def write_report(
    runs: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
    *,
    count: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> Contest:
    """Evaluates runs beside the expert and the baselines, and writes the page.

    Args:
        runs: their folders; runs that differ in their seed alone share a row and a curve, and so do those with the same
            label ("LABEL=FOLDER").
        path: of the page.
        count: only so many scenarios of each family.
        seed: of the bootstrap intervals.
        progress: show progress bars.

    Returns:
        What was evaluated.

    Raises:
        FileNotFoundError: a folder holds no run.
        ValueError: there are no runs, or one is damaged.

    """
    if not runs:
        raise ValueError("runs: expected at least one, got none")
    found = [_read(os.fspath(run)) for run in runs]
    trained = {name for run in found for name in (FAMILIES if run.config.family == ALL else (run.config.family,))}
    families = [family for family in FAMILIES if family in trained]
    banks = [ScenarioBank.shipped(family, "test") for family in families]
    entrants = [run.entrant for run in found] + [load_entrant(name) for name in BASELINES]
    result = contest(entrants, banks, count=count, seed=seed, progress=progress)
    by_row = {
        row: [run for run in found if any(run.entrant is member for member in members)]
        for row, members in grouped([run.entrant for run in found]).items()
    }
    scores = result.scores()
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = environment.from_string(files("leapnav.training").joinpath("report.html.jinja").read_text())
    page = template.render(
        title="Training runs" if len(found) > 1 else f"Training run {found[0].entrant.name}",
        version=leapnav.__version__,
        date=datetime.now().astimezone().strftime("%Y-%m-%d"),
        episodes=scores[0].episodes,
        families=families,
        resampled="the runs" if any(row.runs > 1 for row in scores) else "the scenarios",
        columns=[title.replace("\n", " ").strip() for title, *_ in COLUMNS] + ["time ms"],
        rows=[
            {
                "name": row.policy + (f" ({row.runs} runs)" if row.runs > 1 else ""),
                "cells": [_lines(cell(getattr(row, name), *form)) for _, name, *form in COLUMNS]
                + [(f"{row.milliseconds:.2f}", "")],
            }
            for row in scores
        ],
        curves=_curves(by_row, families),
        profiles=_svg(lambda axes: draw_profiles(axes, result)),
        failures=_failures(result),
        galleries=[{"name": row, "png": _gallery(banks, result.runs[row][0])} for row in by_row],
        runs=[_summary(run) for run in found],
    )
    Path(path).write_text(page)
    return result


def _lines(text: str) -> tuple[str, str]:
    """A figure, and its interval if it has one."""
    value, _, interval = text.partition("\n")
    return value, interval


def _read(name: str) -> _Run:
    entrant = load_entrant(name)
    folder = Path(entrant.name)
    _, config = read_config(folder)
    try:
        record = json.loads((folder / "config.json").read_text())
        lines = (folder / "evaluations.jsonl").read_text().splitlines()
        return _Run(entrant, folder, config, record, [json.loads(line) for line in lines])
    except ValueError as error:
        raise ValueError(f"{folder / 'evaluations.jsonl'}: damaged: {error}") from None


def _curves(rows: dict[str, list[_Run]], families: Sequence[str]) -> list[dict[str, str]]:
    """Success and SOC, means over the run's families, against steps and against time."""
    found = []
    for axis, label, caption in (
        ("step", "samples or steps of the environment", "What the policies had learned from"),
        ("seconds", "wall-clock time (min)", "The time that it took, evaluations included"),
    ):
        figure = Figure(figsize=(10, 3.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, measure in zip(panels, ("success", "soc"), strict=True):
            for number, (row, runs) in enumerate(rows.items()):
                _draw_curve(axes, runs, axis, measure, CURVES[number % len(CURVES)], row)
            if axis == "step":
                axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.set(xlabel=label, ylabel={"success": "success rate", "soc": "SOC"}[measure], ylim=(-0.02, 1.02))
            axes.grid(alpha=0.3)
        lines = panels[1].get_legend_handles_labels()
        figure.legend(*lines, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
        note = "; the band is that of the seeds" if any(len(runs) > 1 for runs in rows.values()) else ""
        text = f"{caption}, and how good they were on the test split ({', '.join(families)}){note}."
        found.append({"svg": _as_svg(figure), "caption": text})
    return found


def _draw_curve(axes: Axes, runs: Sequence[_Run], axis: str, measure: str, color: str, label: str) -> None:
    """The mean over the seeds, and their range."""
    curves = []
    for run in runs:
        families = FAMILIES if run.config.family == ALL else (run.config.family,)
        values = [float(np.mean([line[family][measure] for family in families])) for line in run.evaluations]
        curves.append((np.array([line[axis] for line in run.evaluations], dtype=float), np.array(values)))
    if axis == "seconds":
        curves = [(places / 60, values) for places, values in curves]
    longest = max(curves, key=lambda curve: len(curve[0]))[0]
    common = longest[longest <= min(places[-1] for places, _ in curves)]
    rows = np.array([np.interp(common, places, values) for places, values in curves])
    axes.plot(common, rows.mean(axis=0), color=color, linewidth=1.6, label=label, marker="o", markersize=2.5)
    if len(rows) > 1:
        axes.fill_between(common, rows.min(axis=0), rows.max(axis=0), color=color, alpha=0.18, linewidth=0)


def _failures(result: Contest) -> list[dict[str, Any]]:
    """Success by family, by the optimum's clearance, and by whether it reverses."""
    bins = [
        (f"{low:g} to {high:g} m" if math.isfinite(high) else f"over {low:g} m", low, high)
        for low, high in pairwise(CLEARANCES)
    ]
    kinds: list[tuple[str, dict[str, Callable[[Episode], bool]]]] = [
        ("by family", {family: lambda e, family=family: e.family == family for family in result.families}),
        (
            "by clearance",
            {name: lambda e, low=low, high=high: low <= e.reference_clearance < high for name, low, high in bins},
        ),
        ("by reversing", {"forwards": lambda e: not e.reversing, "reversing": lambda e: e.reversing}),
    ]
    first = next(iter(result.runs.values()))[0]
    tables = []
    for title, groups in kinds:
        sizes = {name: sum(map(belongs, first)) for name, belongs in groups.items()}
        kept = {name: belongs for name, belongs in groups.items() if sizes[name]}
        rows = [
            {
                "name": policy,
                "cells": [
                    f"{100 * np.mean([e.success for run in runs for e in run if belongs(e)]):.1f}"
                    for belongs in kept.values()
                ],
            }
            for policy, runs in result.runs.items()
        ]
        tables.append({"title": title, "columns": [f"{name} ({sizes[name]})" for name in kept], "rows": rows})
    return tables


def _gallery(banks: Sequence[ScenarioBank], evaluation: Evaluation) -> str:
    buffer = io.BytesIO()
    plot_episodes(banks, evaluation.episodes, buffer, GALLERY_COLUMNS)
    return base64.b64encode(buffer.getvalue()).decode()


def _summary(run: _Run) -> dict[str, str]:
    last = run.evaluations[-1] if run.evaluations else {"step": 0, "seconds": 0.0}
    algorithm = run.record["config"]["algorithm"]
    summary = f"{algorithm}, {run.config.family}, seed {run.config.seed}, {last['step']:,} samples or steps"
    return {
        "name": run.entrant.name,
        "summary": f"{summary}, {last['seconds'] / 60:.1f} min",
        "config": json.dumps(run.record, indent=1),
    }


def _svg(draw: Callable[[Axes], None]) -> str:
    figure = Figure(figsize=(8, 3.8), layout="constrained")
    draw(figure.subplots())
    return _as_svg(figure)


def _as_svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    text = buffer.getvalue()
    return text[text.index("<svg") :]
