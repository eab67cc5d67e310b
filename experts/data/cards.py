"""Data cards: what is in a bank, where it comes from and how it was made, as Markdown for the Hugging Face Hub."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import is_built_in

LICENCE = "mit"  # of scenarios that leapnav samples
UNKNOWN = "unknown"


def data_card(bank: ScenarioBank) -> str:
    """Return the data card of a bank: YAML metadata of the Hub, then Markdown.

    Origin and licence of given scenarios are those that `build_bank_of` was told, or unknown.
    """
    given = bank.given or {}
    built_in = bank.given is None and is_built_in(bank.family)
    licence = given.get("licence") or (LICENCE if built_in else UNKNOWN)
    content = f"# {bank.path.name}\n\n{_sentences(bank)}\n\n{_table(_facts(bank, licence))}\n\n{_usage(bank)}\n"
    return f"---\n{_metadata(bank, licence)}\n---\n\n{content}"


def _metadata(bank: ScenarioBank, licence: str) -> str:
    # JSON texts are valid YAML, whatever a name contains.
    lines = [
        f"license: {json.dumps(licence)}",
        f"pretty_name: {json.dumps(bank.path.stem)}",
        "tags: [robotics, navigation, optimal-control, imitation-learning, leapnav]",
    ]
    return "\n".join(lines)


def _sentences(bank: ScenarioBank) -> str:
    kind = f"a {bank.horizon} horizon" + ("" if bank.obstacles == "cost" else " and hard obstacles")
    return (
        f"{len(bank)} scenarios of a wheeled robot (`{bank.robot.model}`) among obstacles, with {kind}, each with its "
        "certified optimum: cost, states, controls and costates. A scenario bank of leapnav, an HDF5 file."
    )


def _facts(bank: ScenarioBank, licence: str) -> list[tuple[str, Any]]:
    given = bank.given or {}
    proved = int(np.isfinite(bank.lower_bounds).sum())
    if bank.given is None:
        origin = f"sampled by leapnav, family `{bank.family}`, seed {bank.seed}"
    else:
        origin = given.get("origin") or UNKNOWN
    facts = [
        ("origin", origin),
        ("licence", licence),
        ("scenarios", f"{len(bank)}, of {bank.drawn} {'sampled' if bank.given is None else 'given'}"),
        *((f"rejected: {reason}", count) for reason, count in bank.rejected.items()),
        *([("doubtful optima", len(given["doubtful"]))] if given.get("doubtful") else []),
        ("software", f"leapnav {bank.software}"),
        ("lower bounds proved", proved),
        *((f"BLAKE2b of {name}", f"`{value}`") for name, value in sorted(bank.checksums.items())),
    ]
    return [(name, str(value)) for name, value in facts]


def _table(facts: list[tuple[str, Any]]) -> str:
    rows = [f"| {name} | {value.replace('|', chr(92) + '|')} |" for name, value in facts]
    return "\n".join(["| | |", "|---|---|", *rows])


def _usage(bank: ScenarioBank) -> str:
    return (
        "```python\n"
        "from leapnav.envs import NavigateEnv, ScenarioBank\n\n"
        f'bank = ScenarioBank("{bank.path.name}")\n'
        "env = NavigateEnv(bank=bank)\n"
        "```"
    )
