"""What the programs share: a bank with one scenario, an included policy, and the return that it must have there."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from leapnav.envs import ScenarioBank
from leapnav.experts import build_bank
from leapnav.training import evaluate, load_policy, policy_environment

ID = "leapnav/Navigate-v0"
NAME = "open"  # policy and family
BANK = "one.bank"


def one_scenario(**environment: Any) -> dict[str, Any]:
    """Return arguments of the environment with which every episode is in the same scenario."""
    if not Path(BANK).exists():
        build_bank(NAME, 1, BANK, seed=3, progress=False)
    return {"family": BANK, **environment}


def return_of(policy: Any, environment: dict[str, Any] | None = None) -> float:
    """Return what a policy gets there in `evaluate`."""
    found = evaluate(policy, ScenarioBank(BANK), environment=environment, timed=False, progress=False)
    return found.episodes[0].episode_return


def included() -> tuple[dict[str, Any], Callable[[np.ndarray], np.ndarray], float]:
    """Return arguments of the environment, the included policy as a function of observations, and its return."""
    policy, environment = load_policy(NAME), policy_environment(NAME)
    arguments = one_scenario(**environment)

    def act(observation: np.ndarray) -> np.ndarray:
        return np.asarray(policy.predict(observation, deterministic=True)[0])

    return arguments, act, return_of(policy, environment)


def report(what: str, found: float, expected: float) -> None:
    """Print the return that a client measured, and that of `evaluate`."""
    print(json.dumps({"what": what, "found": round(float(found), 4), "expected": round(expected, 4)}), flush=True)
