"""A policy on the scenarios of a bank, beside their optima: what every policy goes through, the expert too."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from tqdm.auto import tqdm

from leapnav.envs.bank import Reference, ScenarioBank
from leapnav.envs.families import FAMILIES
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.scenario import Scenario
from leapnav.envs.vector import AutoresetMode, NavigateVectorEnv
from leapnav.experts.methods import solve
from leapnav.experts.problem import Path

ROBOTS = 256  # that drive at once
TIMED = 100  # actions whose time is taken
REVERSING = 0.05  # m/s; an optimum that goes backwards at least this fast reverses


class Policy(Protocol):
    """What can be scored: anything with Stable-Baselines3's `predict` for many observations at once."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions for observations, and the policy's own state."""
        ...


# One that must know the environment that it drives, as `ExpertPolicy` does, is given as a function that makes it.
Entrant = Policy | Callable[[Any], Policy]


@dataclass(frozen=True, eq=False)
class Episode:
    """How a policy did on one scenario.

    Attributes:
        family, index, scenario: which one: its family, its number in the bank, its name.
        success, collision: how it ended.
        cost: J that was paid.
        episode_return: the sum of the rewards.
        reference_cost: J* of the scenario.
        reached_reference: J* for the pose that was reached, re-solved from the optimum's costates where the episode was
            a success; NaN otherwise, and where no certified extremal was found.
        clearance: m, the smallest on the way.
        reference_clearance: m, the optimum's.
        reversing: whether the optimum drives backwards somewhere.
        states (K + 1, 3): the path driven.

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

    @property
    def soc(self) -> float:
        """Success weighted by optimal cost: S J* / max(J, J*)."""
        return float(self.success) * self.reference_cost / max(self.cost, self.reference_cost)

    @property
    def ratio(self) -> float:
        """J / J* of a success, infinite otherwise: what a performance profile counts."""
        return self.cost / self.reference_cost if self.success else math.inf

    @property
    def regret(self) -> float:
        """(J - J*) / J*, with J* for the pose that was reached."""
        return (self.cost - self.reached_reference) / self.reached_reference


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A policy on a bank: its episodes in the bank's order, and the median time (ms) that it takes for one action."""

    episodes: tuple[Episode, ...]
    milliseconds: float

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
        """Mean of the success weighted by optimal cost."""
        return float(np.mean([episode.soc for episode in self.episodes]))

    @property
    def regret(self) -> float:
        """Median regret of the successes, NaN without any."""
        values = [episode.regret for episode in self.episodes if episode.success]
        return float(np.nanmedian(values)) if values else math.nan


def evaluate(
    policy: Entrant,
    bank: ScenarioBank | str = "clutter",
    *,
    count: int | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 0,
    timed: bool = True,
    label: str = "Evaluating",
    progress: bool = True,
) -> Evaluation:
    """Plays each scenario of a bank once, with deterministic actions.

    The same policy, bank and seed give the same episodes.

    Args:
        policy: anything with Stable-Baselines3's `predict` for many observations at once; or a function that makes one
            for an environment, as `ExpertPolicy` does.
        bank: a bank, or a family's name for its test split.
        count: only so many scenarios, from the first on.
        environment: arguments of the environment, `observation` and so on.
        seed: of the disturbances, if the environment has any.
        timed: whether to time single actions; otherwise `milliseconds` is NaN.
        label: of the progress bar.
        progress: show it.

    Raises:
        TypeError: the policy is none.
        ValueError: an argument is impossible, or the policy's observations are not the environment's.

    """
    if not (hasattr(policy, "predict") or callable(policy)):
        raise TypeError(
            "policy: expected one with `predict`, or a function that makes one for an environment, got "
            f"{type(policy).__name__}"
        )
    if not isinstance(bank, ScenarioBank):
        if not isinstance(bank, str) or bank not in FAMILIES:
            got = repr(bank) if isinstance(bank, str) else type(bank).__name__
            raise ValueError(f"bank: expected a ScenarioBank or one of {', '.join(FAMILIES)}, got {got}")
        bank = ScenarioBank.shipped(bank, "test")
    if len(bank) == 0 or (count is not None and count < 1):
        raise ValueError(f"count: expected at least one scenario, got {len(bank) if count is None else count}")
    settings = dict(environment or {})
    numbers = list(range(len(bank) if count is None else min(count, len(bank))))
    episodes: list[Episode] = []
    with tqdm(total=len(numbers), desc=label, unit="episode", disable=not progress) as bar:
        for first in range(0, len(numbers), ROBOTS):
            episodes += _play(policy, bank, numbers[first : first + ROBOTS], settings, seed, bar.update)
    return Evaluation(tuple(episodes), _time(policy, bank, settings) if timed else math.nan)


def _play(
    entrant: Entrant,
    bank: ScenarioBank,
    numbers: Sequence[int],
    settings: Mapping[str, Any],
    seed: int,
    on_episode: Callable[[], Any],
) -> list[Episode]:
    """Plays scenarios of a bank side by side."""
    count = len(numbers)
    venv = NavigateVectorEnv(count, bank=bank, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
    policy = _made(entrant, venv, venv.single_observation_space)
    observations, _ = venv.reset(seed=seed, options={"index": list(numbers)})
    poses, totals, clearances = [venv.poses], np.zeros(count), np.full(count, np.inf)
    found: list[Episode | None] = [None] * count
    state, starts = None, np.ones(count, dtype=bool)
    while any(episode is None for episode in found):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, starts, _, infos = venv.step(actions)
        playing = np.array([episode is None for episode in found])
        totals += np.where(playing, rewards, 0.0)
        ended = starts & playing
        last = infos.get("final_info", infos)  # of the robots whose episode has ended; the others' are in `infos`
        reached = np.where(starts[:, None], last["pose"], infos["pose"])
        clearances = np.minimum(clearances, np.where(starts, last["clearance"], infos["clearance"]))
        poses.append(reached)
        for i in np.flatnonzero(ended).tolist():
            found[i] = _episode(
                bank,
                numbers[i],
                np.array([row[i] for row in poses]),
                bool(last["is_success"][i]),
                bool(last["collision"][i]),
                float(last["cost"][i]),
                float(totals[i]),
                float(clearances[i]),
            )
            on_episode()
    venv.close()
    return [episode for episode in found if episode is not None]


def _episode(
    bank: ScenarioBank,
    number: int,
    states: np.ndarray,
    success: bool,
    collision: bool,
    cost: float,
    episode_return: float,
    clearance: float,
) -> Episode:
    scenario, reference = bank[number], bank.reference(number)
    return Episode(
        family=bank.family,
        index=number,
        scenario=scenario.name,
        success=success,
        collision=collision,
        cost=cost,
        episode_return=episode_return,
        reference_cost=reference.cost,
        reached_reference=_reference_to(scenario, reference, states[-1]) if success else math.nan,
        clearance=clearance,
        reference_clearance=reference.certificate[3],
        reversing=bool(reference.controls[:, 0].min() < -REVERSING),
        states=states,
    )


def _reference_to(scenario: Scenario, reference: Reference, pose: np.ndarray) -> float:
    """J* of the scenario with a pose near its goal as the goal, solved from its optimum; NaN if that fails."""
    heading = None if scenario.goal[2] is None else math.remainder(float(pose[2]), 2 * math.pi)
    task = scenario.model_copy(update={"goal": (float(pose[0]), float(pose[1]), heading)})
    guess = Path(reference.times, reference.states.astype(float), reference.costates.astype(float))
    extremal = solve(task, "multiple_shooting", guess=guess)
    return extremal.cost if extremal.success else math.nan


def _time(entrant: Entrant, bank: ScenarioBank, settings: Mapping[str, Any]) -> float:
    """Median milliseconds for one action, on the bank's first scenario."""
    env = NavigateEnv(bank=bank, **settings)
    policy = _made(entrant, env, env.observation_space)
    observation, _ = env.reset(seed=0, options={"index": 0})
    seconds, state, start = [], None, True
    for _ in range(TIMED):
        begun = time.perf_counter()
        action, state = policy.predict(observation, state, np.array([start]), deterministic=True)
        seconds.append(time.perf_counter() - begun)
        observation, _, start, _, _ = env.step(action.reshape(2))
        if start:
            break
    env.close()
    return 1e3 * float(np.median(seconds))


def _made(entrant: Entrant, env: Any, space: Any) -> Policy:
    """The policy for an environment."""
    made: Any = entrant
    policy: Policy = made if hasattr(made, "predict") and not isinstance(made, type) else made(env)
    if not hasattr(policy, "predict"):
        raise TypeError(f"policy: expected one with `predict`, got {type(policy).__name__}")
    learned = getattr(policy, "observation_space", None)
    if learned is not None and learned != space:
        raise ValueError(
            f"policy: it observes {learned.shape or 'a dict'}, the environment shows {space.shape or 'a dict'}, or "
            "with other bounds; pass the environment's arguments that it was trained with"
        )
    return policy
