"""`leapnav evaluate --html`: a self-contained HTML page of a comparison."""

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
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import families_of
from leapnav.envs.utils.colors import CURVES
from leapnav.envs.utils.files import write_text
from leapnav.envs.utils.json_utils import encode
from leapnav.training.config import RunConfig, read_config
from leapnav.training.scoring.comparison import Comparison
from leapnav.training.scoring.decision_reports import costliest_decisions, plot_decisions
from leapnav.training.scoring.reports import (
    COLUMNS,
    NEGATIVE_REGRET,
    RUN_COLUMNS,
    cell,
    draw_profiles,
    plot_episodes,
    row_name,
    runs_cell,
    sensors_of,
    training_notes,
)
from leapnav.training.scoring.results import Episode, Evaluation, bank_identity
from leapnav.training.scoring.scores import Score

CLEARANCE_BINS = (0.0, 0.05, 0.1, 0.2, math.inf)  # bin edges of the optimum's clearance (m)
N_GALLERY_COLUMNS = 4


@dataclass(frozen=True)
class _RunRecord:
    """The files of a run.

    Attributes:
        folder: its directory.
        config: the configuration.
        record: content of `config.json`.
        evaluations: lines of `evaluations.jsonl`.

    """

    folder: Path
    config: RunConfig
    record: dict[str, Any]
    evaluations: list[dict[str, Any]]


def write_report(comparison: Comparison, path: str | os.PathLike[str], *, progress: bool = True) -> None:
    """Write the page of a comparison: scores, profiles, episodes, and the learning curves of training runs.

    Args:
        comparison: the results, of `compare` or `leapnav evaluate`. Runs that differ only in their seed share a row and
            a curve.
        path: file of the page.
        progress: show progress bars.

    Raises:
        FileNotFoundError: a file of a training run is missing.
        ValueError: a file of a training run is damaged.

    """
    by_row = {row: [_read_run(folder) for folder in folders] for row, folders in comparison.folders.items()}
    records = [record for members in by_row.values() for record in members]
    families = comparison.families
    scores = comparison.scores()
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = environment.from_string(
        files("leapnav.training.scoring").joinpath("report.html.jinja").read_text(encoding="utf-8")
    )
    page = template.render(
        title=_title(records),
        version=leapnav.__version__,
        date=datetime.now().astimezone().strftime("%Y-%m-%d"),
        episodes=scores[0].episodes,
        banks=[f"{bank.family}, {bank.path.name}" for bank in comparison.banks],
        sensors=sensors_of(comparison),
        notes=training_notes(comparison),
        seeds=_seeds(scores),
        columns=[*_titles(COLUMNS), "unknown", "time ms"],
        rows=[
            {
                "name": row_name(row),
                "cells": [_split_cell(cell(getattr(row, name), *form)) for _, name, *form in COLUMNS]
                + [(str(row.unknown), ""), (f"{row.milliseconds:.2f}", "")],
            }
            for row in scores
        ],
        curves=_learning_curves(by_row, families) if by_row else [],
        profiles=_profiles(comparison),
        failures=_success_tables(comparison),
        negative_regret=NEGATIVE_REGRET if any(row.reached_regret.value < 0 for row in scores) else "",
        galleries=[
            {"name": row, "png": _gallery(comparison.banks, comparison.runs[row][0])} for row in comparison.runs
        ],
        decisions=[{"name": row, "png": _decisions(comparison, row, progress)} for row in comparison.runs],
        runs=[_summary(record) for record in records],
    )
    write_text(path, page)


def _title(records: Sequence[_RunRecord]) -> str:
    if not records:
        return "Comparison of policies"
    return "Training runs" if len(records) > 1 else f"Training run {records[0].folder}"


def _titles(columns: Sequence[tuple[Any, ...]]) -> list[str]:
    return [title.replace("\n", " ").strip() for title, *_ in columns]


def _seeds(scores: Sequence[Score]) -> dict[str, Any]:
    """Return the table of the runs of methods with several of them."""
    columns = [column for column in COLUMNS if column[1] in RUN_COLUMNS]
    rows = [
        {
            "name": row_name(row),
            "cells": [_split_cell(runs_cell(getattr(row, name), *form)) for _, name, *form in columns],
        }
        for row in scores
        if row.runs > 1
    ]
    return {"columns": _titles(columns), "rows": rows}


def _split_cell(text: str) -> tuple[str, str]:
    """Return the value of a cell and its interval, which may be empty."""
    value, _, interval = text.partition("\n")
    return value, interval


def _read_run(folder: Path) -> _RunRecord:
    """Read the files of a run."""
    _, config = read_config(folder)
    try:
        record = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        lines = (folder / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
        return _RunRecord(folder, config, record, [json.loads(line) for line in lines])
    except ValueError as error:
        raise ValueError(f"{folder / 'evaluations.jsonl'}: damaged: {error}") from None


def _learning_curves(rows: dict[str, list[_RunRecord]], families: Sequence[str]) -> list[dict[str, str]]:
    """Plot success rate and SOC, means over the families of a run, over steps and over time."""
    several_runs = any(len(records) > 1 for records in rows.values())
    note = "; bands: range over the seeds" if several_runs else ""
    curves = []
    for axis, label, caption in (
        ("step", "samples or environment steps", "samples or environment steps used for training"),
        ("seconds", "wall-clock time (min)", "wall-clock time, evaluations included"),
    ):
        figure = Figure(figsize=(10, 3.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, measure in zip(panels, ("success", "soc"), strict=True):
            for index, (row, records) in enumerate(rows.items()):
                _draw_curve(axes, records, axis, measure, CURVES[index % len(CURVES)], row)
            if axis == "step":
                axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.set(xlabel=label, ylabel={"success": "success rate", "soc": "SOC"}[measure], ylim=(-0.02, 1.02))
            axes.grid(alpha=0.3)
        handles = panels[1].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
        text = (
            f"Scores during the training ({', '.join(families)}) against {caption}{note}. Stars: the last evaluation, "
            "of the test split unless the family is a bank."
        )
        curves.append({"svg": _as_svg(figure), "caption": text})
    return curves


def _draw_curve(axes: Axes, records: Sequence[_RunRecord], axis: str, measure: str, color: str, label: str) -> None:
    """Draw the mean over the seeds during the training, with their range, and the results of the last evaluation."""
    scale = 1 / 60 if axis == "seconds" else 1.0
    curves, ends = [], []
    for record in records:
        families, lines = families_of(record.config.family), record.evaluations
        values = [float(np.mean([line[family][measure] for family in families])) for line in lines]
        points = [(scale * line[axis], value) for line, value in zip(lines, values, strict=True)]
        curves.append(np.array([p for p, line in zip(points, lines, strict=True) if not line["final"]]).reshape(-1, 2))
        ends += [p for p, line in zip(points, lines, strict=True) if line["final"]]
    # The grid is that of the run with the most evaluations, up to the end of the shortest run.
    if all(len(curve) for curve in curves):
        grid = max(curves, key=len)[:, 0]
        common = grid[grid <= min(curve[-1, 0] for curve in curves)]
        rows = np.array([np.interp(common, *curve.T) for curve in curves])
        axes.plot(common, rows.mean(axis=0), color=color, linewidth=1.6, label=label, marker="o", markersize=2.5)
        label = "_" + label  # in the legend once
        if len(rows) > 1:
            axes.fill_between(common, rows.min(axis=0), rows.max(axis=0), color=color, alpha=0.18, linewidth=0)
    if ends:
        axes.plot(*np.array(ends).T, "*", color=color, markersize=7, label=label)


def _success_tables(comparison: Comparison) -> list[dict[str, Any]]:
    """Tabulate the success rate by family or bank, by the optimum's clearance, and by whether the optimum reverses."""
    bins = [
        (f"{low:g} to {high:g} m" if math.isfinite(high) else f"over {low:g} m", low, high)
        for low, high in pairwise(CLEARANCE_BINS)
    ]
    groupings: list[tuple[str, dict[str, Callable[[Episode], bool]]]] = [
        (
            "by family" if len(comparison.families) == len(comparison.banks) else "by bank",
            {
                name: lambda e, identity=identity: e.bank == identity
                for name, identity in zip(comparison.bank_names, map(bank_identity, comparison.banks), strict=True)
            },
        ),
        (
            "by clearance",
            {name: lambda e, low=low, high=high: low <= e.reference_clearance < high for name, low, high in bins},
        ),
        ("by reversing", {"forwards": lambda e: not e.reversing, "reversing": lambda e: e.reversing}),
    ]
    first = next(iter(comparison.runs.values()))[0]
    tables = []
    for title, groups in groupings:
        sizes = {name: sum(map(contains, first)) for name, contains in groups.items()}
        groups = {name: contains for name, contains in groups.items() if sizes[name]}
        rows = [
            {
                "name": policy,
                "cells": [
                    f"{100 * np.mean([e.success for run in runs for e in run if contains(e)]):.1f}"
                    for contains in groups.values()
                ],
            }
            for policy, runs in comparison.runs.items()
        ]
        tables.append({"title": title, "columns": [f"{name} ({sizes[name]})" for name in groups], "rows": rows})
    return tables


def _gallery(banks: Sequence[ScenarioBank], evaluation: Evaluation) -> str:
    """Plot selected episodes of a run, as a PNG file in base64."""
    buffer = io.BytesIO()
    plot_episodes(banks, evaluation.episodes, buffer, N_GALLERY_COLUMNS)
    return base64.b64encode(buffer.getvalue()).decode()


def _decisions(comparison: Comparison, row: str, progress: bool) -> str:
    """Plot the most expensive decisions of a run, as a PNG file in base64."""
    found = costliest_decisions(comparison.runs[row][0], comparison.banks, N_GALLERY_COLUMNS, progress=progress)
    buffer = io.BytesIO()
    plot_decisions(found, comparison.banks, buffer, N_GALLERY_COLUMNS)
    return base64.b64encode(buffer.getvalue()).decode()


def _summary(record: _RunRecord) -> dict[str, str]:
    """Summarise a run for the list of runs."""
    last = record.evaluations[-1] if record.evaluations else {"step": 0, "seconds": 0.0}
    config, algorithm = record.config, record.record["config"]["algorithm"]
    return {
        "name": str(record.folder),
        "summary": (
            f"{algorithm}, {config.family}, seed {config.seed}, {last['step']:,} samples or environment steps, "
            f"{last['seconds'] / 60:.1f} min"
        ),
        "config": encode(record.record, indent=1),
    }


def _profiles(comparison: Comparison) -> str:
    """Plot the performance profiles as SVG text."""
    figure = Figure(figsize=(8, 3.8), layout="constrained")
    draw_profiles(figure.subplots(), comparison)
    return _as_svg(figure)


def _as_svg(figure: Figure) -> str:
    """Return a figure as an SVG element, without the XML header."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    text = buffer.getvalue()
    return text[text.index("<svg") :]
