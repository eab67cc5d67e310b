"""Specifications of policies by name, as given on the command line."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.scenario import check_robot
from leapnav.experts.acting.policy import ExpertPolicy
from leapnav.training.policies.baselines import GoToGoal, RandomPolicy
from leapnav.training.policies.files import BASELINES as BASELINES
from leapnav.training.policies.files import OBSERVED, load_policy, policy_environment, read_description, trained_robot
from leapnav.training.policies.planners import PLANNERS, PlannerPolicy
from leapnav.training.policies.zips import is_zip, load_zip
from leapnav.training.scoring.adapters import (
    NormalizedPolicy,
    Policy,
    PolicyFactory,
    PolicyOrFactory,
    read_statistics,
    statistics_beside,
)


@dataclass(frozen=True)
class PolicySpec:
    """Specification of a policy to evaluate.

    Attributes:
        name: the name without the label: a baseline, a directory or an included policy.
        label: name of the row in the table; None if not given.
        method: text that is identical for runs that differ only in their seed; None if unknown.
        policy: the policy, or a function that makes it for an environment.
        environment: arguments of the environment that determine the policy's observations.
        is_baseline: whether the policy drives any robot.
        run: directory of the training run; None for other policies.
        family: family of the scenarios of the training; None if it is unknown.
        obstacles: kind of the obstacles of the training; None if it is unknown.
        trained_robot: robot of the training; None if its parameters are unknown.

    """

    name: str
    label: str | None
    method: str | None
    policy: PolicyOrFactory
    environment: Mapping[str, Any]
    is_baseline: bool = False
    run: Path | None = None
    family: str | None = None
    obstacles: str | None = None
    trained_robot: RobotModel | None = None

    @property
    def robot(self) -> str | None:
        """Model of the robot that the policy drives; None for a baseline."""
        return None if self.is_baseline else check_robot(self.environment.get("robot") or "unicycle").model

    @property
    def horizon(self) -> str | None:
        """Kind of the horizon for which the policy was trained; None for a baseline."""
        return None if self.is_baseline else self.environment.get("horizon") or "fixed"


def load_policy_spec(
    name: str,
    *,
    seed: int = 0,
    environment: Mapping[str, Any] | None = None,
    trust: bool = False,
    vecnormalize: str | Path | None = None,
) -> PolicySpec:
    """Load a policy by its name.

    Args:
        name: one of `BASELINES`, the name of an included policy, the directory of a policy or a run, or a model of
            Stable-Baselines3 (`.zip`). With the prefix "LABEL=", policies with the same label are treated as runs of
            one method.
        seed: random seed of the baselines "random" and "mppi".
        environment: arguments of the environment of a `.zip`, see `load_zip`.
        trust: load a `.zip` with Stable-Baselines3, which executes code from the file.
        vecnormalize: file of the statistics of `VecNormalize` with which the model of a `.zip` was trained; a pickle
            file, so that it needs `trust`.

    Raises:
        FileNotFoundError: there is no such policy.
        ValueError: the policy cannot be loaded, see `load_policy`.

    """
    label, place = (None, name) if Path(name).exists() or "=" not in name else name.split("=", 1)
    if place in BASELINES:
        factories: dict[str, Any] = {
            "expert": ExpertPolicy,
            "random": PolicyFactory(lambda env: RandomPolicy(_single_action_space(env), seed)),
            "go-to-goal": GoToGoal,
            **{name: PolicyFactory(partial(PlannerPolicy, planner=name, seed=seed)) for name in PLANNERS},
        }
        # A baseline reads the robot and the obstacles from the environment.
        return PolicySpec(place, label, None, factories[place], {"observation": "state"}, is_baseline=True)
    if is_zip(place):
        observed = {key: value for key, value in (environment or {}).items() if key in OBSERVED}
        model, arguments = load_zip(place, observed or None, trust=trust)
        arguments = {**arguments, **(environment or {})}
        beside = statistics_beside(place)
        if vecnormalize is not None:
            if not trust:
                raise ValueError(
                    f"vecnormalize: {vecnormalize} is a pickle file, which can execute code: it needs trust"
                )
            model = NormalizedPolicy(model, read_statistics(vecnormalize))
        elif beside is not None:
            warnings.warn(
                f"{place}: {beside} may contain statistics of VecNormalize, without which the scores are wrong; pass "
                "vecnormalize (--vecnormalize) if the model was trained with them",
                stacklevel=2,
            )
        return PolicySpec(place, label, None, model, arguments)
    policy, description = load_policy(place), read_description(place)
    # The method is the configuration of the run without the seed and the directory.
    training = {key: value for key, value in description["training"].items() if key not in ("seed", "out")}
    method = json.dumps(training, sort_keys=True) if training else None
    run = Path(place) if (Path(place) / "config.json").is_file() else None
    family, environment = training.get("family"), policy_environment(place)
    robot, obstacles = trained_robot(description), training.get("obstacles") or ("cost" if training else None)
    known = {"family": family, "obstacles": obstacles, "trained_robot": robot}
    return PolicySpec(place, label, method, policy, environment, run=run, **known)


def group_by_row(specs: Sequence[PolicySpec]) -> dict[str, list[PolicySpec]]:
    """Group policies by the rows of the table.

    Policies with the same label share a row. Without a label, runs that differ only in their seed share a row.

    Raises:
        ValueError: two rows would have the same name.

    """
    groups: dict[tuple[str, str], list[PolicySpec]] = {}
    for spec in specs:
        key = ("label", spec.label) if spec.label is not None else ("method", spec.method or spec.name)
        groups.setdefault(key, []).append(spec)
    rows: dict[str, list[PolicySpec]] = {}
    for (kind, label), members in groups.items():
        name = label if kind == "label" else members[0].name
        if name in rows:
            raise ValueError(f"policies: {name}: given more than once")
        if len({member.name for member in members}) < len(members):
            raise ValueError(f"policies: {members[0].name}: given more than once")
        rows[name] = members
    return rows


def make_policy_from_spec(name: str, env: Any, *, seed: int = 0) -> Policy:
    """Load a policy by its name for an environment, see `load_policy_spec`.

    Raises:
        FileNotFoundError: there is no such policy.
        ValueError: the policy cannot be loaded, or was trained with other observations.

    """
    if name not in BASELINES:
        return load_policy(name, env)
    make: Any = load_policy_spec(name, seed=seed).policy
    return make(env)


def _single_action_space(env: Any) -> gym.spaces.Space:
    return getattr(env, "single_action_space", env.action_space)
