"""What several tests share: the lists that general tests run over, and the stored reference data."""

import json
from pathlib import Path

import sympy as sp

from leapnav.envs import Scenario
from leapnav.experts import ControlAffineSystem, OptimalControlProblem

DATA = Path(__file__).parent / "data"


def best_known() -> list[tuple[Scenario, float]]:
    """Scenarios with the best cost known for each."""
    entries = json.loads((DATA / "best_known.json").read_text())
    return [(Scenario.from_dict(entry["scenario"]), entry["best_known_cost"]) for entry in entries]


def published_problems() -> dict[str, tuple[OptimalControlProblem, float, str]]:
    """Published problems by name, with the known cost and the source (file: data/published_problems.json)."""
    problems = {}
    for entry in json.loads((DATA / "published_problems.json").read_text()):
        symbols = tuple(sp.Symbol(name) for name in entry["state"])
        known = {str(s): s for s in symbols}
        system = ControlAffineSystem(
            state=symbols,
            drift=[sp.sympify(e, locals=known) for e in entry["drift"]],
            fields=[[sp.sympify(e, locals=known) for e in column] for column in entry["fields"]],
        )
        problem = OptimalControlProblem(
            system,
            start=entry["start"],
            goal=entry["goal"],
            horizon=entry["horizon"],
            control_weight=entry["control_weight"],
            state_cost=sp.sympify(entry["state_cost"], locals=known),
        )
        problems[entry["name"]] = problem, entry["cost"], entry["source"]
    return problems


def scenario_fields(**changes: object) -> dict:
    """A valid scenario as its file has it, with some fields changed."""
    fields = {
        "name": "small",
        "arena": [0, 0, 10, 10],
        "robot": {"model": "unicycle", "radius": 0.25, "max_speed": 2.0, "max_turn_rate": 3.0},
        "start": [1.0, 1.0, 0.0],
        "goal": [8.0, 8.0, 1.5],
        "horizon": 12.0,
        "obstacles": [
            {"circle": {"center": [4.0, 4.5], "radius": 0.8}},
            {"polygon": {"vertices": [[6.0, 3.0], [7.0, 3.5], [6.5, 5.0]]}},
        ],
        "cost": {"speed_weight": 1.0, "turn_weight": 0.5, "proximity_weight": 1.0, "proximity_scale": 0.1},
    }
    return {**fields, **changes}
