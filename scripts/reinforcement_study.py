"""Measure where PPO improves on the policy that it starts from, on the same fresh scenarios.

python scripts/reinforcement_study.py                       # all cases; finished runs are skipped
python scripts/reinforcement_study.py --only rooms free --seeds 0
python scripts/reinforcement_study.py --scores              # trains nothing, scores the finished runs

    motors    robots with motors and disturbances; the start is the policy of the ideal robot
    rooms     lidar alone in rooms, where doors behind walls cannot be observed
    free      a free horizon
    grazes    lidar alone in clutter; episodes of 4 s that start shortly before a failure of the start
"""

import argparse
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from leapnav.envs import NavigateEnv, Scenario, ScenarioBank
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.sources import ScenarioSource
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts.data.banks import build_bank
from leapnav.training import (
    DAggerRunConfig,
    NavigateVecEnv,
    PPOConfig,
    evaluate,
    load_policy,
    make_policy,
    policy_environment,
    score,
    train_dagger,
    train_ppo,
)
from leapnav.training.learning.driving import drive_episodes
from leapnav.training.policies.actors import copy_actor
from leapnav.training.scoring.reports import markdown_cells

SEEDS, SCENARIOS, BANK_SEED = 3, 4000, 781
N_DRIVEN, N_ROBOTS, HARD_SEED = 20_000, 256, 783  # episodes of the start, from whose failures the hard starts are taken
HARD_TIMES, HARD_STARTS = (0.5, 4.0), 4  # s before a failure; number per failure
HARD_PROBABILITY, HARD_DURATION = 0.5, 4.0  # fraction of the episodes that have a hard start, and their length (s)


@dataclass(frozen=True)
class Case:
    """A policy to start from, and the settings of PPO that differ from the defaults of a warm start."""

    family: str
    start: str
    settings: dict[str, Any] = field(default_factory=dict)
    disturbances: tuple[float, ...] = (0.0,)  # of the evaluations
    hard_starts: bool = False

    @property
    def horizon(self) -> str:
        """The kind of horizon."""
        return self.settings.get("horizon", "fixed")


CASES = {
    "motors": Case("clutter", "clutter", {"actuation": "motor", "disturbance": 0.2}, (0.2, 0.1, 0.0)),
    "rooms": Case("rooms", "lidar-rooms"),
    "free": Case("clutter", "free-clutter", {"horizon": "free"}),
    "grazes": Case("clutter", "lidar-clutter", hard_starts=True),
}


class HardStarts(VecEnvWrapper):
    """Start some of the episodes at given states, and truncate these after a few seconds.

    Args:
        venv: the training environment.
        scenarios: the rests of scenarios from the given states.
        seed: random seed.

    """

    def __init__(self, venv: VecEnv, scenarios: list[Scenario], seed: int) -> None:
        super().__init__(venv)
        inner: Any = venv
        while not isinstance(inner, NavigateVecEnv):
            inner = inner.venv
        self._robots, self._scenarios, self._rng = inner, scenarios, np.random.default_rng(seed)
        self._limit = round(HARD_DURATION / inner.venv.control_period)
        self._left = np.full(self.num_envs, np.iinfo(int).max)  # steps until the truncation

    def reset(self) -> VecEnvObs:
        """Start an ordinary episode of each robot."""
        self._left[:] = np.iinfo(int).max
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Step all robots."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._left -= 1
        truncated = ~dones & (self._left == 0)
        for i in np.flatnonzero(truncated).tolist():
            infos[i] = {"terminal_observation": observations[i].copy(), "TimeLimit.truncated": True}
        hard = (dones | truncated) & (self._rng.random(self.num_envs) < HARD_PROBABILITY)
        self._left[dones | truncated] = np.iinfo(int).max
        self._left[hard] = self._limit
        restarted = hard | truncated
        if restarted.any():
            chosen = self._rng.integers(len(self._scenarios), size=self.num_envs)
            scenarios = [self._scenarios[k] if is_hard else None for k, is_hard in zip(chosen, hard, strict=True)]
            observations = self._robots.restart(restarted, scenarios)
        return observations, rewards, dones | truncated, infos


def find_hard_starts(policy: BasePolicy, settings: EnvironmentSettings, family: str, workers: int) -> list[Scenario]:
    """Return the rests of scenarios from states shortly before the collisions of a policy."""
    episodes = drive_episodes(
        policy,
        ScenarioSource(family, split="fresh"),
        settings,
        (HARD_SEED,),
        robots=N_ROBOTS,
        workers=workers,
    )
    rng, starts, failures = np.random.default_rng(HARD_SEED), [], 0
    for episode in islice(episodes, N_DRIVEN):
        if not episode.played.collision:
            continue
        failures += 1
        for before in rng.uniform(*HARD_TIMES, size=HARD_STARTS):
            step = len(episode.played.actions) - round(before / settings.control_period)
            if step > 0:
                time = step * settings.control_period
                try:
                    starts.append(episode.scenario.from_state(episode.played.states[step], time))
                except ScenarioError:  # in contact already
                    continue
    episodes.close()
    print(f"{failures} collisions in {N_DRIVEN} episodes, {len(starts)} hard starts", flush=True)
    return starts


def prepare_start(case: Case, folder: Path, workers: int) -> Path:
    """Return the policy to start from; those with lidar alone are trained first."""
    if not case.start.startswith("lidar-"):
        return Path(case.start)
    run = folder / case.start
    if not (run / "policy.json").exists():
        train_dagger(DAggerRunConfig.tuned(case.family, observation="lidar", out=run), workers=workers)
    return run


def train(name: str, case: Case, folder: Path, seeds: list[int], workers: int) -> None:
    """Train the seeds that are not finished."""
    start, hard = prepare_start(case, folder, workers), None
    for seed in seeds:
        run = folder / f"{name}-{seed}"
        if (run / "finished").exists():
            continue
        wrapper = None
        if case.hard_starts:
            if hard is None:
                settings = EnvironmentSettings(**policy_environment(start))
                hard = find_hard_starts(load_policy(start), settings, case.family, workers)
            wrapper = partial(HardStarts, scenarios=hard, seed=seed)
        settings = {**case.settings, "warm_start": (start,), "out": run, "seed": seed, "evaluate_every": 500_000}
        train_ppo(PPOConfig.tuned(case.family, **settings), wrapper=wrapper)
        (run / "finished").touch()


def adapt(start: Path, environment: dict[str, Any], family: str) -> BasePolicy:
    """Return the policy to start from, for the observations of the case."""
    policy = load_policy(start)
    if environment.get("actuation", "velocity") == "velocity":
        return policy
    env = NavigateEnv(family, split="fresh", **environment)
    adapted = make_policy(env.observation_space, env.action_space, hidden=(256, 256, 256))
    copy_actor(policy, adapted)
    return adapted


def print_scores(name: str, case: Case, folder: Path, workers: int) -> None:
    """Print the scores of the start and of the finished runs, and the paired differences of the success rates."""
    start = prepare_start(case, folder, workers)
    path = folder / f"{case.family}-{case.horizon}.bank"
    if not path.exists():
        build_bank(case.family, SCENARIOS, path, horizon=case.horizon, seed=BANK_SEED, workers=workers)
    bank = ScenarioBank(path)
    actuation = {"actuation": "motor"} if "actuation" in case.settings else {}
    for disturbance in case.disturbances:
        environment = {**policy_environment(start), **actuation, "disturbance": disturbance}
        options: dict[str, Any] = {"environment": environment, "timed": False, "progress": False}
        before = evaluate(adapt(start, environment, case.family), bank, **options)
        print(f"disturbance {disturbance}\n| {start} | {markdown_cells(score(name, before))} |", flush=True)
        for run in sorted(folder.glob(f"{name}-[0-9]*")):
            if not (run / "finished").exists():
                continue
            after = evaluate(load_policy(run), bank, **options)
            pairs = [(a.success, b.success) for a, b in zip(before, after, strict=True)]
            gained, lost = (sum(pair == wanted for pair in pairs) for wanted in ((False, True), (True, False)))
            p = binomtest(gained, max(1, gained + lost)).pvalue  # McNemar's exact test
            print(f"| {run} | {markdown_cells(score(name, after))} |")
            print(f"  gain {100 * (gained - lost) / len(pairs):.2f} % ({gained} gained, {lost} lost), p = {p:.0e}")


def main() -> None:
    """Train, and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/reinforcement"))
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--seeds", nargs="+", type=int, default=range(SEEDS))
    parser.add_argument("--workers", type=int, default=2, help="number of processes")
    parser.add_argument("--scores", action="store_true", help="train nothing")
    arguments = parser.parse_args()
    for name in arguments.only:
        if not arguments.scores:
            train(name, CASES[name], arguments.runs, list(arguments.seeds), arguments.workers)
        print_scores(name, CASES[name], arguments.runs, arguments.workers)


if __name__ == "__main__":
    main()
