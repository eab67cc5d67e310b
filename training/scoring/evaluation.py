"""Evaluation of policies, the expert included, on the scenarios of a bank with known optima."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium as gym
import numpy as np

from leapnav.envs.episodes import act_with, play_episode
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenarios.bank import Reference, ScenarioBank
from leapnav.envs.scenarios.families import check_family
from leapnav.envs.scenarios.scenario import Scenario, check_robot
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.unwrapping import unwrap
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import in_words
from leapnav.envs.vector import AutoresetMode, NavigateVectorEnv
from leapnav.experts.optimum import find_reached_optimum
from leapnav.experts.problem.problem import Trajectory
from leapnav.training.threads import limit_threads

if TYPE_CHECKING:
    import pandas

BATCH_SIZE = 256  # episodes simulated in parallel
MAX_TIMED_ACTIONS = 100
_UNLISTED = ("states", "costs", "episode_return")  # not in the record of an episode
MIN_REVERSE_SPEED = 0.05  # m/s; an optimum that reaches this speed backwards counts as reversing


class Policy(Protocol):
    """Any object with the `predict` method of Stable-Baselines3, for one observation or a batch of observations."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for observations, and the state of a recurrent policy."""
        ...


# A policy that depends on the environment, such as `ExpertPolicy`, is given as a class, or as a function whose
# parameter is named `env`. Any other function is a policy itself: it maps an observation to an action.
PolicyOrFactory = Policy | Callable[[Any], Any]


class FunctionPolicy:
    """A policy from a function of one observation, called for each robot.

    Args:
        function: maps an observation (d,), or a dictionary, to an action (m,).
        observation_space: the space of one observation, to recognise batches.
        n_actions: number m of controls.

    """

    def __init__(self, function: Callable[[Any], Any], observation_space: gym.spaces.Space, n_actions: int = 2) -> None:
        self._function, self._space, self._n_actions = function, observation_space, n_actions

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions (m,) or (N, m) for an observation or a batch of them."""
        if isinstance(observation, Mapping):
            assert isinstance(self._space, gym.spaces.Dict)
            name, values = next(iter(observation.items()))
            is_batch, count = np.ndim(values) > len(self._space[name].shape or ()), len(values)
            rows = [{key: value[i] for key, value in observation.items()} for i in range(count)] if is_batch else []
        else:
            is_batch = np.ndim(observation) > len(self._space.shape or ())
            rows = list(observation) if is_batch else []
        return np.array([self._action(row) for row in rows]) if is_batch else self._action(observation), state

    def _action(self, observation: Any) -> np.ndarray:
        action = np.asarray(self._function(observation), dtype=np.float32)
        if action.shape != (self._n_actions,) or not np.isfinite(action).all():
            raise ValueError(
                f"policy: expected {in_words(self._n_actions)} finite numbers from the function, got {action.tolist()}"
            )
        return action


@dataclass(frozen=True, eq=False)
class Episode:
    """The result of a policy on one scenario.

    Attributes:
        family, index, scenario: the scenario: its family, its index in the bank, its name.
        success, collision: outcome of the episode.
        cost: cost J of the episode.
        episode_return: sum of the rewards.
        reference_cost: optimal cost J* of the scenario.
        reached_reference: optimal cost J* for the state that a successful episode has reached, see
            `find_reached_optimum`; NaN for other episodes, and if no certified extremal was found.
        clearance: minimum clearance of the episode (m).
        reference_clearance: minimum clearance of the optimum (m).
        reversing: whether the optimum contains backward driving.
        states (K + 1, n): the states before and after each environment step.
        costs (K + 1,): the cost J so far at these states.
        lower_bound: proved lower bound of the cost of the scenario; NaN if none is known.
        truncated: whether the time limit of a free horizon ended the episode, without a penalty for the missed goal.

    """

    family: str
    index: int
    scenario: str
    success: bool
    collision: bool
    cost: float
    episode_return: float
    reference_cost: float
    reached_reference: float
    clearance: float
    reference_clearance: float
    reversing: bool
    states: np.ndarray
    costs: np.ndarray
    lower_bound: float = math.nan
    truncated: bool = False

    @property
    def optimal_cost(self) -> float:
        """J* for the pose that a successful episode has reached, else J* of the scenario."""
        return self.reference_cost if math.isnan(self.reached_reference) else self.reached_reference

    @property
    def soc(self) -> float:
        """Success weighted by optimal cost: S J* / max(J, J*), with J* for the reached pose.

        If that is not known, J* of the scenario is used.
        """
        if not self.success:
            return 0.0
        return self.optimal_cost / max(self.cost, self.optimal_cost)

    @property
    def ratio(self) -> float:
        """Cost ratio J / J* of the performance profile, with J* as in `soc`; infinite for an unsuccessful episode."""
        return self.cost / self.optimal_cost if self.success else math.inf

    @property
    def regret(self) -> float:
        """Regret (J - J*) / J* of a successful episode, with J* for the reached pose; NaN if that is not known.

        It is negative only if the episode is cheaper than the best optimum that the search found, or if the robot
        slips: its path then violates the unicycle model.
        """
        return (self.cost - self.reached_reference) / self.reached_reference

    @property
    def true_regret(self) -> tuple[float, float]:
        """Proved limits of J / J_0 - 1, where J_0 is the infimum of the cost of collision-free paths to the goal pose.

        J_0 is between `lower_bound` and `reference_cost`. A robot may stop within the tolerances of the goal, so the
        limits can be negative and need not contain `regret`, which refers to the pose reached. NaN if no lower bound is
        known or the episode is no success; the upper limit is infinite if the lower bound is not positive.
        """
        if math.isnan(self.lower_bound) or not self.success:
            return math.nan, math.nan
        high = self.cost / self.lower_bound - 1.0 if self.lower_bound > 0 else math.inf
        return self.cost / self.reference_cost - 1.0, high

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes without the states and their costs, and SOC and regret."""
        record = {name: value for name, value in vars(self).items() if name not in _UNLISTED}
        return {**record, "return": self.episode_return, "soc": self.soc, "regret": self.regret}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of a policy on a bank.

    Attributes:
        episodes: the episodes, in the order of the bank.
        milliseconds: median computation time of one action (ms).
        settings: settings of the environment.

    """

    episodes: tuple[Episode, ...]
    milliseconds: float
    settings: EnvironmentSettings = field(default_factory=EnvironmentSettings)

    def __repr__(self) -> str:
        families = ", ".join(dict.fromkeys(episode.family for episode in self.episodes))
        return (
            f"<Evaluation: {len(self)} episodes ({families}), success {100 * self.success:.1f} %, collision "
            f"{100 * self.collision:.1f} %, SOC {self.soc:.3f}, median regret {100 * self.regret:.2f} %>"
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas data frame with one row per episode and the columns of `Episode.to_dict`.

        Raises:
            ImportError: pandas is not installed.

        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError('to_dataframe needs pandas: pip install "leapnav[pandas]"') from error
        return pandas.DataFrame([episode.to_dict() for episode in self.episodes])

    def __len__(self) -> int:
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)

    @property
    def success(self) -> float:
        """Success rate."""
        return float(np.mean([episode.success for episode in self.episodes]))

    @property
    def collision(self) -> float:
        """Collision rate."""
        return float(np.mean([episode.collision for episode in self.episodes]))

    @property
    def soc(self) -> float:
        """Mean success weighted by optimal cost."""
        return float(np.mean([episode.soc for episode in self.episodes]))

    @property
    def regret(self) -> float:
        """Median regret of the successful episodes; NaN if there are none."""
        values = [episode.regret for episode in self.episodes if episode.success]
        return float(np.nanmedian(values)) if values else math.nan


@limit_threads
def evaluate(
    policy: PolicyOrFactory,
    bank: ScenarioBank | str = "clutter",
    *,
    count: int | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 0,
    timed: bool = True,
    label: str = "Evaluating",
    progress: bool = True,
) -> Evaluation:
    """Evaluate a policy on each scenario of a bank, with deterministic actions.

    The same policy, bank and seed give the same episodes.

    Args:
        policy: an object with the `predict` method of Stable-Baselines3 for batches of observations; a class or a
            function of an environment, with a parameter `env`, that returns one, such as `ExpertPolicy`; or any other
            function, which maps one observation to an action.
        bank: a bank, or the name of a family for its test split, with the robot and the horizon of `environment`.
        count: number of scenarios, from the first of the bank; None: all.
        environment: arguments of the environment, such as `observation`.
        seed: random seed of the disturbances.
        timed: measure the computation time of an action; otherwise `milliseconds` is NaN.
        label: label of the progress bar.
        progress: show a progress bar.

    Raises:
        TypeError: `policy` is neither a policy nor a function that returns one.
        ValueError: an argument is invalid, or the policy expects other observations.

    """
    if not (hasattr(policy, "predict") or callable(policy)):
        raise TypeError(
            "policy: expected an object with `predict`, a function of an observation, or a function of `env` that "
            f"returns a policy, got {type(policy).__name__}"
        )
    if not isinstance(bank, ScenarioBank):
        if not isinstance(bank, str):
            raise ValueError(f"bank: expected a ScenarioBank or the name of a family, got {type(bank).__name__}")
        check_family(bank)
        given = environment or {}
        robot = check_robot(given.get("robot") or "unicycle")
        bank = ScenarioBank.shipped(bank, "test", robot.model, given.get("horizon") or "fixed")
    if len(bank) == 0 or (count is not None and count < 1):
        raise ValueError(f"count: expected at least one scenario, got {len(bank) if count is None else count}")
    arguments = dict(environment or {})
    indices = list(range(len(bank) if count is None else min(count, len(bank))))
    episodes: list[Episode] = []
    with progress_bar(total=len(indices), label=label, unit="episodes", show=progress) as bar:
        for first in range(0, len(indices), BATCH_SIZE):
            batch = indices[first : first + BATCH_SIZE]
            episodes += _play_batch(policy, bank, batch, arguments, seed, bar.update)
    milliseconds = _median_milliseconds(policy, bank, arguments) if timed else math.nan
    task = {"robot": bank.robot.model, "horizon": bank.horizon}
    return Evaluation(tuple(episodes), milliseconds, EnvironmentSettings(**{**arguments, **task}))


def _play_batch(
    policy_or_factory: PolicyOrFactory,
    bank: ScenarioBank,
    indices: Sequence[int],
    arguments: Mapping[str, Any],
    seed: int,
    on_episode: Callable[[], Any],
) -> list[Episode]:
    """Play scenarios of a bank in parallel, one robot for each."""
    count = len(indices)
    venv = NavigateVectorEnv(count, bank=bank, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
    policy = _policy_for(policy_or_factory, venv, venv.single_observation_space)
    observations, _ = venv.reset(seed=seed, options={"index": list(indices)})
    states, costs = [venv.states], [np.zeros(count)]
    returns, clearances = np.zeros(count), np.full(count, np.inf)
    episodes: list[Episode | None] = [None] * count
    state, starts = None, np.ones(count, dtype=bool)
    while any(episode is None for episode in episodes):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, terminated, truncated, infos = venv.step(actions)
        starts = terminated | truncated
        playing = np.array([episode is None for episode in episodes])
        returns += np.where(playing, rewards, 0.0)
        # Robots whose episode has ended are already in the next one; their last step is in `final_info`.
        last = infos.get("final_info", infos)
        states.append(np.where(starts[:, None], _states(last), _states(infos)))
        costs.append(np.where(starts, last["cost"], infos["cost"]))
        clearances = np.minimum(clearances, np.where(starts, last["clearance"], infos["clearance"]))
        for i in np.flatnonzero(starts & playing).tolist():
            episodes[i] = _make_episode(
                bank,
                indices[i],
                np.array([row[i] for row in states]),
                np.array([row[i] for row in costs]),
                success=bool(last["is_success"][i]),
                collision=bool(last["collision"][i]),
                episode_return=float(returns[i]),
                clearance=float(clearances[i]),
                truncated=bool(truncated[i]),
            )
            on_episode()
    venv.close()
    return [episode for episode in episodes if episode is not None]


def _states(infos: Mapping[str, Any]) -> np.ndarray:
    """Return the states (N, n) of the robots from the infos of a step."""
    return np.concatenate([infos["pose"], infos["motion"]], axis=1) if "motion" in infos else infos["pose"]


def _make_episode(
    bank: ScenarioBank, index: int, states: np.ndarray, costs: np.ndarray, *, success: bool, **outcome: Any
) -> Episode:
    """Combine the outcome of an episode with the reference of its scenario."""
    scenario, reference, cost = bank[index], bank.reference(index), float(costs[-1])
    return Episode(
        family=bank.family,
        index=index,
        scenario=scenario.name,
        success=success,
        cost=cost,
        reference_cost=reference.cost,
        reached_reference=_optimal_cost_to(states[-1], scenario, reference, cost) if success else math.nan,
        reference_clearance=reference.certificate[3],
        reversing=bool(_speeds(reference).min() < -MIN_REVERSE_SPEED),
        states=states,
        costs=costs,
        lower_bound=math.nan if reference.lower_bound is None else reference.lower_bound,
        **outcome,
    )


def _speeds(reference: Reference) -> np.ndarray:
    """Return the speeds (N - 1,) along the heading (m/s) of an optimum, negative backwards."""
    step, heading = np.diff(reference.states, axis=0), reference.states[:-1, 2]
    return (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / np.diff(reference.times)


def _optimal_cost_to(state: np.ndarray, scenario: Scenario, reference: Reference, cost: float) -> float:
    """Return J* for the pose that a successful episode has reached; NaN if no certified extremal is found."""
    guess = Trajectory(reference.times, reference.states.astype(float), reference.costates.astype(float))
    optimum = find_reached_optimum(scenario, state, cost, guess)
    return optimum.cost if optimum.success else math.nan


def _median_milliseconds(policy_or_factory: PolicyOrFactory, bank: ScenarioBank, arguments: Mapping[str, Any]) -> float:
    """Return the median computation time of one action on the first scenario of a bank (ms)."""
    env = NavigateEnv(bank=bank, **arguments)
    act = act_with(_policy_for(policy_or_factory, env, env.observation_space))
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


def _is_factory(given: Callable[..., Any]) -> bool:
    """Return whether a callable makes a policy for an environment."""
    if isinstance(given, type):
        return True
    try:
        return "env" in inspect.signature(given).parameters
    except (TypeError, ValueError):  # some functions in C have no signature
        return False


def _policy_for(policy_or_factory: PolicyOrFactory, env: Any, observation_space: Any) -> Policy:
    """Return the policy for an environment, after a check of its observation space."""
    given: Any = policy_or_factory
    if hasattr(given, "predict") and not isinstance(given, type):
        policy: Policy = given
    elif _is_factory(given):
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
    return policy
