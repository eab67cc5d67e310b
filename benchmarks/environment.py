"""Steps per second of the environment compared with Gymnasium's Pendulum-v1, and replays of optima.

Rates are measured by Gymnasium's own benchmark functions: random actions, including resets and action sampling. The two
environments alternate in one process, so that other load affects both; the results are medians.
"""

import statistics
import tempfile
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.performance import benchmark_step, benchmark_vector_step
from tqdm.auto import tqdm

import leapnav  # noqa: F401
from leapnav.envs import NavigateVectorEnv, ScenarioBank
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.experts import find_optimum
from leapnav.experts.acting.policy import plan_actions
from leapnav.experts.data.banks import build_bank

ENV_ID, ROUNDS, ROBOTS, SCENARIOS = "leapnav/Navigate-v0", 3, 1024, 50
SECONDS: Any = 0.5  # of each measurement; Gymnasium declares an integer
RATES = [
    # Name, robots (None: the single environment), arguments, target of the ratio to Pendulum-v1.
    ("vector, state", ROBOTS, {"observation": "state"}, 50.0),
    ("vector, 32 lidar beams", ROBOTS, {}, 45.0),
    ("vector, map", ROBOTS, {"observation": "map"}, None),
    ("vector, state, shaped reward", ROBOTS, {"observation": "state", "reward": "shaped"}, None),
    ("vector, 32 beams, car", ROBOTS, {"robot": "car"}, 10.0),
    ("vector, 32 beams, dynamic_unicycle", ROBOTS, {"robot": "dynamic_unicycle"}, 10.0),
    ("vector, 32 beams, differential_drive", ROBOTS, {"robot": "differential_drive"}, 10.0),
    ("vector, 32 beams, free horizon", ROBOTS, {"horizon": "free"}, 10.0),
    ("vector, state, motors", ROBOTS, {"observation": "state", "actuation": "motor"}, None),
    ("vector, 32 lidar beams, disturbed", ROBOTS, {"disturbance": 0.1}, None),
    ("vector of 16, 32 lidar beams", 16, {}, None),
    ("single, 32 lidar beams", None, {}, 1.0),
    ("single, 32 lidar beams, motors", None, {"actuation": "motor"}, 0.3),
]


@cache
def differential_drive_bank() -> ScenarioBank:
    """A bank; without one, the time to sample scenarios would be measured."""
    folder = Path(tempfile.mkdtemp())
    return build_bank("clutter", 50, folder / "clutter.bank", robot="differential_drive", progress=False)


def rate(robots: int | None, arguments: dict, seed: int) -> float:
    """Environment steps per second of all robots."""
    if robots is None:
        return benchmark_step(gym.make(ENV_ID, family="clutter", **arguments), SECONDS, seed)
    has_bank = arguments.get("robot") != "differential_drive"
    source = {"family": "clutter"} if has_bank else {"bank": differential_drive_bank()}
    mode = "vector_entry_point"
    venv = gym.make_vec(ENV_ID, num_envs=robots, vectorization_mode=mode, **source, **arguments)
    return benchmark_vector_step(venv, SECONDS, seed)


def measure_rates() -> None:
    peer = gym.make("Pendulum-v1")
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name, *_ in RATES}
    for seed in tqdm(range(ROUNDS + 1), desc="Steps per second", unit="round"):
        for name, robots, arguments, _ in RATES:
            pair = rate(robots, arguments, seed), benchmark_step(peer, SECONDS, seed)
            if seed > 0:  # the first round loads the kernels
                rows[name].append(pair)
    print(f"{'':36}{'steps/s':>12}{'Pendulum-v1':>14}{'ratio':>8}{'target':>8}")
    for name, _, _, target in RATES:
        ours, theirs = (statistics.median(column) for column in zip(*rows[name], strict=True))
        ratio = statistics.median(a / b for a, b in rows[name])
        print(f"{name:36}{ours:12,.0f}{theirs:14,.0f}{ratio:8.2f}{'' if target is None else f'{target:8.1f}'}")


def replay(bank: ScenarioBank, plans: list[np.ndarray], **arguments: object) -> tuple[float, float]:
    """Fraction of successes of optima that are executed open-loop, and median ratio to the reference cost."""
    count = len(plans)
    venv = NavigateVectorEnv(count, bank=bank, observation="state", autoreset_mode="SameStep", **arguments)
    venv.reset(seed=0, options={"index": list(range(count))})
    actions = np.zeros((max(map(len, plans)), count, 2), np.float32)
    for i, plan in enumerate(plans):
        actions[: len(plan), i] = plan
    ended, success, cost = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count)
    for step_actions in actions:
        _, _, terminated, _, infos = venv.step(step_actions)
        for i in np.flatnonzero(terminated & ~ended):
            success[i], cost[i] = infos["final_info"]["is_success"][i], infos["final_info"]["cost"][i]
        ended |= terminated
    assert ended.all()
    ratio = float(np.median((cost / bank.costs[:count])[success])) if success.any() else float("nan")
    return float(success.mean()), ratio


def measure_replays() -> None:
    print(f"\n{'optima driven open-loop':28}{'velocity':>20}{'disturbed 0.1':>20}{'motor':>20}")
    print(f"{'':28}{'success, J/J*':>20}{'success, J/J*':>20}{'success, J/J*':>20}")
    for family in ALL_FAMILIES:
        bank = ScenarioBank.shipped(family, "test")
        scenarios = tqdm(islice(bank, SCENARIOS), desc=f"Solving {family}", total=SCENARIOS, leave=False)
        plans = [plan_actions(find_optimum(scenario), scenario, 0.05) for scenario in scenarios]
        cells = [replay(bank, plans, **arguments) for arguments in ({}, {"disturbance": 0.1}, {"actuation": "motor"})]
        row = "".join(f"{f'{100 * success:.1f} %, {ratio:.4f}':>20}" for success, ratio in cells)
        print(f"{family:28}{row}")


if __name__ == "__main__":
    measure_rates()
    measure_replays()
