"""Policies by their names, as the command line gives them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from leapnav.experts.policy import ExpertPolicy
from leapnav.training.baselines import GoToGoal, RandomPolicy
from leapnav.training.evaluation import Entrant, Policy
from leapnav.training.policies import load_policy, policy_environment, read_description

BASELINES = ("expert", "random", "go-to-goal")


@dataclass(frozen=True)
class NamedEntrant:
    """A policy to evaluate.

    Attributes:
        name: as it was given, without the label.
        label: of its row, None if none was given.
        method: what runs that differ in their seed alone have in common, None if it is not known.
        entrant: the policy, or what makes it for an environment.
        environment: arguments of the environment that it has to see.

    """

    name: str
    label: str | None
    method: str | None
    entrant: Entrant
    environment: Mapping[str, Any]


def load_entrant(name: str, *, seed: int = 0) -> NamedEntrant:
    """A policy by its name.

    Args:
        name: "expert", "random", "go-to-goal", the folder of a policy or a run, or the name of a policy that ships;
            with "LABEL=" before it, all of the same label are runs of one method.
        seed: of the random policy.

    Raises:
        FileNotFoundError: there is no such policy.
        ValueError: it cannot be loaded, see `load_policy`.

    """
    label, place = (None, name) if Path(name).exists() or "=" not in name else name.split("=", 1)
    if place in BASELINES:
        makers: dict[str, Any] = {
            "expert": ExpertPolicy,
            "random": lambda env: RandomPolicy(_single_action_space(env), seed),
            "go-to-goal": GoToGoal,
        }
        return NamedEntrant(place, label, None, makers[place], {})
    policy, description = load_policy(place), read_description(place)
    # Of a run's configuration all but seed and folder make the method.
    training = {key: value for key, value in description["training"].items() if key not in ("seed", "out")}
    method = json.dumps(training, sort_keys=True) if training else None
    return NamedEntrant(place, label, method, policy, policy_environment(place))


def grouped(entrants: Sequence[NamedEntrant]) -> dict[str, list[NamedEntrant]]:
    """The entrants by rows of the table: by label, and without one, runs that differ in their seed alone together.

    Raises:
        ValueError: two rows would have the same name.

    """
    rows: dict[tuple[str, str], list[NamedEntrant]] = {}
    for entrant in entrants:
        named = ("label", entrant.label) if entrant.label is not None else ("method", entrant.method or entrant.name)
        rows.setdefault(named, []).append(entrant)
    found: dict[str, list[NamedEntrant]] = {}
    for (kind, label), members in rows.items():
        name = label if kind == "label" else members[0].name
        if name in found:
            raise ValueError(f"policies: {name}: named more than once")
        if len({member.name for member in members}) < len(members):
            raise ValueError(f"policies: {members[0].name}: named more than once")
        found[name] = members
    return found


def make_entrant(name: str, env: Any, *, seed: int = 0) -> Policy:
    """A policy by its name, for an environment; see `load_entrant`.

    Raises:
        FileNotFoundError, ValueError: there is no such policy, or it observes another environment.

    """
    if name not in BASELINES:
        return load_policy(name, env)
    entrant: Any = load_entrant(name, seed=seed).entrant
    return entrant(env)


def _single_action_space(env: Any) -> gym.spaces.Space:
    return getattr(env, "single_action_space", env.action_space)
