"""Evaluation of policies, the expert included, on the scenarios of a bank with known optima."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from joblib import delayed

from leapnav.envs.episodes import act_with, play_episode
from leapnav.envs.goal_navigation import NavigateGoalEnv
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.banks.checks import Reference
from leapnav.envs.scenarios.families import BANK_ENDING, check_family
from leapnav.envs.scenarios.scenario import Scenario, check_robot
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.unwrapping import unwrap
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.envs.vector import AutoresetMode, NavigateGoalVectorEnv, NavigateVectorEnv
from leapnav.experts.optimum import find_reached_optimum
from leapnav.experts.pools import process_pool
from leapnav.experts.problem.problem import Trajectory
from leapnav.training.environments.playing import PlayedEpisode, play_episodes
from leapnav.training.policies.files import environment_of, warn_of_wrappers
from leapnav.training.scoring.adapters import (
    FunctionPolicy,
    Policy,
    PolicyFactory,
    PolicyOrFactory,
    adapted,
    is_goal_conditioned,
)
from leapnav.training.scoring.policy_specs import load_policy_spec
from leapnav.training.scoring.results import Episode, Evaluation, bank_identity
from leapnav.training.threads import limit_threads

BATCH_SIZE = 256  # episodes simulated in parallel
MIN_PARALLEL = 64  # searches, below which starting processes takes longer
MAX_TIMED_ACTIONS = 100
GOAL_ARGUMENTS = {"reward": "cost"}  # of the environment for goal-conditioned policies
MIN_REVERSE_SPEED = 0.05  # m/s; an optimum that reaches this speed backwards counts as reversing


@limit_threads
def evaluate(
    policy: PolicyOrFactory | str | Path,
    bank: ScenarioBank | str | Path = "clutter",
    *,
    count: int | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 0,
    timed: bool = True,
    workers: int = 1,
    dask: str | None = None,
    label: str = "Evaluating",
    progress: bool = True,
) -> Evaluation:
    """Evaluate a policy on each scenario of a bank, with deterministic actions.

    The same policy, bank and seed give the same episodes.

    Args:
        policy: an object with the `predict` method of Stable-Baselines3 for batches of observations; a class of such
            objects that takes an environment, such as `ExpertPolicy`, or a `PolicyFactory`; or any other function,
            which maps one observation to an action. The arguments of `predict` after the observation are optional. A
            model with `VecNormalize` gets normalised observations. The actions of a policy with another bounded
            action space, such as that of `RescaleAction`, are scaled to [-1, 1]. A policy of
            `leapnav/NavigateGoal-v0` is evaluated there. The names, directories and files of `compare` are accepted.
        bank: a bank, its file (`.bank`), or the name of a family for its test split, with the robot, horizon and
            obstacles of `environment`; by default the obstacles are those of the training of a policy that is given by
            its name.
        count: number of scenarios, from the first of the bank; None: all.
        environment: arguments of the environment, such as `control_period`; None: no others than those that determine
            the observations of the model's environment, or of the training of a policy that is given by its name, as
            far as these are known. Given arguments take precedence over these.
        seed: random seed of the disturbances.
        timed: measure the computation time of an action; otherwise `milliseconds` is NaN.
        workers: number of processes that search the optima for the poses reached, which takes most of the time; the
            results do not depend on it.
        dask: address of a Dask scheduler (`tcp://host:8786`) whose workers are used for that instead. Requires the
            extra `cluster`.
        label: label of the progress bar.
        progress: show a progress bar.

    Raises:
        FileNotFoundError: there is no policy or bank of this name.
        TypeError: `policy` is neither a policy nor a function that returns one.
        ValueError: an argument is invalid, or the policy expects other observations.
        ModuleNotFoundError, OSError: the Dask scheduler cannot be used.

    """
    check_at_least("workers", workers, 1)
    policy, bank, environment = resolve(policy, bank, environment, seed)
    if len(bank) == 0 or (count is not None and count < 1):
        raise ValueError(f"count: expected at least one scenario, got {len(bank) if count is None else count}")
    arguments = {name: value for name, value in environment.items() if name != "obstacles"}
    indices = list(range(len(bank) if count is None else min(count, len(bank))))
    episodes: list[Episode] = []
    with progress_bar(total=len(indices), label=label, unit="episodes", show=progress) as bar:
        for first in range(0, len(indices), BATCH_SIZE):
            batch = indices[first : first + BATCH_SIZE]
            episodes += _play_batch(policy, bank, batch, arguments, seed)
            bar.update(sum(not episode.success for episode in episodes[first:]))
        reached = [i for i, episode in enumerate(episodes) if episode.success]
        with process_pool(workers if len(reached) >= MIN_PARALLEL else 1, dask, return_as="generator") as pool:
            tasks = (delayed(_optimal_cost_to)(*_search(episodes[i], bank)) for i in reached)
            for i, cost in zip(reached, cast(Iterator[float], pool(tasks)), strict=True):
                episodes[i] = replace(episodes[i], reached_reference=cost)
                bar.update()
    milliseconds = _median_milliseconds(policy, bank, arguments) if timed else math.nan
    task = {"robot": bank.robot.model, "horizon": bank.horizon}
    warn_of_wrappers(policy, 3)
    return Evaluation(tuple(episodes), milliseconds, EnvironmentSettings(**{**arguments, **task}))


def known_environment(policy: Any) -> dict[str, Any]:
    """Return the arguments of the environment that determine the observations of a policy, as far as it knows them."""
    found = environment_of(policy)
    if not found and isinstance(getattr(policy, "observation_space", None), gym.spaces.Dict):
        return {} if is_goal_conditioned(policy) else {"dict_observation": True}
    return found


def resolve(
    policy: PolicyOrFactory | str | Path,
    bank: ScenarioBank | str | Path,
    environment: Mapping[str, Any] | None,
    seed: int,
) -> tuple[PolicyOrFactory, ScenarioBank, dict[str, Any]]:
    """Return the policy, the bank and the arguments of the environment of an evaluation, see `evaluate`."""
    obstacles, trained, name = None, None, policy
    if isinstance(policy, (str, Path)):
        spec = load_policy_spec(str(policy), seed=seed)
        policy, environment = spec.policy, {**spec.environment, **(environment or {})}
        obstacles, trained = spec.obstacles, spec.trained_robot
    environment = {**known_environment(policy), **(environment or {})}
    if not (hasattr(policy, "predict") or callable(policy)):
        raise TypeError(
            "policy: expected a name, an object with `predict`, a function of an observation, or a PolicyFactory, got "
            f"{type(policy).__name__}"
        )
    if not isinstance(bank, ScenarioBank):
        if not isinstance(bank, (str, Path)):
            raise ValueError(f"bank: expected a ScenarioBank, its file or a family, got {type(bank).__name__}")
        bank = _named_bank(str(bank), {"obstacles": obstacles, **environment})
    differences = [] if trained is None else trained.differences(bank.robot)
    if differences:
        warnings.warn(f"{name}: trained with another robot: {'; '.join(differences)}", stacklevel=4)
    return policy, bank, environment


def _named_bank(name: str, environment: Mapping[str, Any]) -> ScenarioBank:
    """Return the bank of a file, or the included test bank of a family for an environment."""
    if name.endswith(BANK_ENDING):
        return ScenarioBank(name)
    check_family(name)
    kinds = environment.get("horizon") or "fixed", environment.get("obstacles") or "cost"
    return ScenarioBank.shipped(name, "test", check_robot(environment.get("robot") or "unicycle").model, *kinds)


def _play_batch(
    policy_or_factory: PolicyOrFactory,
    bank: ScenarioBank,
    indices: Sequence[int],
    arguments: Mapping[str, Any],
    seed: int,
) -> list[Episode]:
    """Play scenarios of a bank in parallel, one robot for each; the optima for the poses reached are not searched."""
    is_goal = is_goal_conditioned(policy_or_factory)
    make, kinds = (NavigateGoalVectorEnv, GOAL_ARGUMENTS) if is_goal else (NavigateVectorEnv, {})
    venv = make(len(indices), bank=bank, autoreset_mode=AutoresetMode.SAME_STEP, **{**kinds, **arguments})
    policy = _policy_for(policy_or_factory, venv, venv.single_observation_space)
    played = play_episodes(policy, venv, {"index": list(indices)}, seed)
    venv.close()
    return [_make_episode(bank, index, one) for index, one in zip(indices, played, strict=True)]


def _make_episode(bank: ScenarioBank, index: int, played: PlayedEpisode) -> Episode:
    """Combine an episode with the reference of its scenario."""
    scenario, reference = bank[index], bank.reference(index)
    outcome = {name: value for name, value in vars(played).items() if name != "actions"}
    return Episode(
        family=bank.family,
        bank=bank_identity(bank),
        index=index,
        scenario=scenario.name,
        cost=float(played.costs[-1]),
        reference_cost=reference.cost,
        reached_reference=math.nan,
        reference_clearance=reference.certificate[3],
        reversing=bool(_speeds(reference).min() < -MIN_REVERSE_SPEED),
        lower_bound=math.nan if reference.lower_bound is None else reference.lower_bound,
        length=played.length,
        shortest_length=float(bank.shortest_lengths[index]),
        shortest_time=float(bank.shortest_times[index]),
        **outcome,
    )


def _speeds(reference: Reference) -> np.ndarray:
    """Return the speeds (N - 1,) along the heading (m/s) of an optimum, negative backwards."""
    step, heading = np.diff(reference.states, axis=0), reference.states[:-1, 2]
    return (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / np.diff(reference.times)


def _search(episode: Episode, bank: ScenarioBank) -> tuple[Scenario, np.ndarray, float, Trajectory]:
    """Return the scenario, the final state and the cost of an episode, and the optimum of the scenario as a guess."""
    reference = bank.reference(episode.index)
    guess = Trajectory(reference.times, reference.states.astype(float), reference.costates.astype(float))
    return bank[episode.index], episode.states[-1], episode.cost, guess


def _optimal_cost_to(scenario: Scenario, state: np.ndarray, cost: float, guess: Trajectory) -> float:
    """Return J* for the pose that a successful episode has reached; NaN if no certified extremal is found."""
    optimum = find_reached_optimum(scenario, state, cost, guess)
    return optimum.cost if optimum.success else math.nan


class _OneRobot:
    """A policy that gets batches of one observation, because it may be a policy for batches only."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def predict(self, observation: Any, *arguments: Any, **others: Any) -> Any:
        batch = {k: v[None] for k, v in observation.items()} if isinstance(observation, dict) else observation[None]
        return self._policy.predict(batch, *arguments, **others)


def _median_milliseconds(policy_or_factory: PolicyOrFactory, bank: ScenarioBank, arguments: Mapping[str, Any]) -> float:
    """Return the median computation time of one action on the first scenario of a bank (ms)."""
    is_goal = is_goal_conditioned(policy_or_factory)
    make, kinds = (NavigateGoalEnv, GOAL_ARGUMENTS) if is_goal else (NavigateEnv, {})
    env = make(bank=bank, **{**kinds, **arguments})
    act = act_with(_OneRobot(_policy_for(policy_or_factory, env, env.observation_space)))
    seconds: list[float] = []

    def timed_act(observation: Any, info: dict[str, Any]) -> np.ndarray | None:
        started = time.perf_counter()
        action = act(observation, info)
        seconds.append(time.perf_counter() - started)
        return action

    _, _, steps = play_episode(env, timed_act, seed=0, options={"index": 0})
    for _ in islice(steps, MAX_TIMED_ACTIONS):
        pass
    env.close()
    return 1e3 * float(np.median(seconds))


def _policy_for(policy_or_factory: PolicyOrFactory, env: Any, observation_space: Any) -> Policy:
    """Return the policy for an environment, after a check of its observation space."""
    given: Any = policy_or_factory
    if hasattr(given, "predict") and not isinstance(given, type):
        policy: Policy = given
    elif isinstance(given, (type, PolicyFactory)):
        policy = given(env)
    else:
        policy = FunctionPolicy(given, observation_space, unwrap(env)[0].settings.model.sizes()[1])
    if not hasattr(policy, "predict"):
        raise TypeError(f"policy: expected one with `predict`, got {type(policy).__name__}")
    expected = getattr(policy, "observation_space", None)
    if expected is not None and expected != observation_space:
        raise ValueError(
            f"policy: expected observations {expected.shape or 'as a dict'}, got {observation_space.shape or 'a dict'} "
            "or other bounds; pass the arguments of the environment that the policy was trained with"
        )
    return adapted(policy)
