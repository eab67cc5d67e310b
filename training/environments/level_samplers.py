"""Level samplers: which scenario of a bank an episode of the vector environment plays.

A curriculum by unsupervised environment design plays the levels from which the policy can learn most. The regret of a
level, which the literature approximates, is exact here, because the bank contains the optimum of each level.

Sources:
    M. Jiang, E. Grefenstette and T. Rocktaschel, "Prioritized level replay" (ICML 2021);
    M. Jiang et al., "Replay-guided adversarial environment design" (NeurIPS 2021): positive value loss and MaxMC;
    A. Rutherford et al., "No regrets: investigating and improving regret approximations for curriculum discovery"
    (NeurIPS 2024, arXiv 2408.15099): learnability.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, cast, get_args

import gymnasium as gym
import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.sources import LevelOutcome
from leapnav.envs.utils.validation import check_choice, check_fraction, check_positive

ScoreName = Literal["positive_value_loss", "max_mc", "learnability", "regret"]
SCORES: tuple[str, ...] = get_args(ScoreName)
VALUE_SCORES = ("positive_value_loss", "max_mc")  # those that need the values of a critic, see `score_rollout`
SAMPLERS = ("uniform", "plr", "learnability", "regret")
MAX_AGE = 64  # draws after which the probabilities are computed again ...
MAX_GROWTH = 1.1  # ... or, earlier, growth of the number of levels with a score
PLAYS_WITHOUT_SCORE = 5  # mean number of episodes of a level after which missing scores are reported


class UniformSampler:
    """Draw all levels of a bank with the same probability: domain randomisation.

    Args:
        bank: the levels.

    Attributes:
        bank: the levels.
        plays (N,): number of finished episodes of each level.
        success (N,): success rate of each level, a moving average; NaN without an episode.
        regrets (N,): regret of the last episode of each level; NaN without an episode. It refers to the optimum of the
            level, while `regret` uses that of the pose reached, so that of a success can be slightly negative.

    Raises:
        TypeError: `bank` is not a bank.
        ValueError: the bank is empty.

    """

    RATE = 0.3  # weight of the last episode in the moving average

    def __init__(self, bank: ScenarioBank) -> None:
        if not isinstance(cast(object, bank), ScenarioBank):
            raise TypeError(f"bank: expected a ScenarioBank, got {type(bank).__name__}")
        count = len(bank)
        if count == 0:
            raise ValueError("bank: expected at least one scenario, got none")
        self.bank = bank
        self.plays = np.zeros(count, dtype=np.int64)
        self.success, self.regrets = np.full(count, np.nan), np.full(count, np.nan)

    def draw(self, rng: np.random.Generator) -> int:
        """Return the index of the level of the next episode."""
        return int(rng.integers(len(self.plays)))

    def record(self, outcome: LevelOutcome) -> None:
        """Store the outcome of an episode; the environment calls it."""
        i = outcome.index
        known = self.plays[i] > 0
        self.plays[i] += 1
        self.success[i] = (
            (1 - self.RATE) * self.success[i] + self.RATE * outcome.success if known else float(outcome.success)
        )
        self.regrets[i] = outcome.regret


class PrioritizedSampler(UniformSampler):
    """Prioritized level replay: draw levels by the rank of their score, and by the time since they were drawn.

    A level is drawn with the probability (1 - staleness) P_S + staleness P_C. P_S is proportional to
    rank^(-1 / temperature), with rank 1 for the highest score and the mean rank for equal scores, and P_C to the number
    of draws since the level was drawn.

    Args:
        bank: the levels.
        score: "regret": regret of the last episode; "learnability": p (1 - p) with the success rate p;
            "positive_value_loss" or "max_mc": from the critic's values, set by `score_rollout`.
        replay: probability of a level with a score; otherwise one that has none yet is drawn, as long as there are any.
        temperature: the smaller, the more the highest scores are preferred. With 0.3, as in the literature for levels
            from a generator, a few levels of a bank are played most of the time, and PPO learns more slowly.
        staleness: see above.

    Attributes:
        scores (N,): score of each level; NaN without one.

    Raises:
        ValueError: an argument is invalid.

    """

    def __init__(
        self,
        bank: ScenarioBank,
        score: ScoreName = "positive_value_loss",
        *,
        replay: float = 0.5,
        temperature: float = 1.0,
        staleness: float = 0.3,
    ) -> None:
        super().__init__(bank)
        check_choice("score", score, SCORES)
        check_fraction("replay", replay)
        check_fraction("staleness", staleness)
        check_positive("temperature", temperature)
        self.score, self._replay, self._temperature, self._staleness = score, replay, temperature, staleness
        self.scores = np.full(len(self.plays), np.nan)
        self._best_returns = np.full(len(self.plays), -np.inf)  # as the critic sees them, for "max_mc"
        self._earned: np.ndarray | None = None  # reward of each robot's episode so far, between two rollouts
        self._drawn = np.zeros(len(self.plays), dtype=np.int64)  # the draw at which a level was drawn last
        self._draws, self._age = 0, MAX_AGE
        self._levels, self._cumulative = np.empty(0, dtype=np.int64), np.empty(0)
        self._reported = False

    def draw(self, rng: np.random.Generator) -> int:
        """Return the index of the level of the next episode."""
        unscored = np.flatnonzero(np.isnan(self.scores))
        n_scored = len(self.scores) - len(unscored)
        if n_scored == 0:
            self._check_scoring()
        if len(unscored) and not (n_scored and rng.random() < self._replay):
            # Those that have never been drawn, then those drawn the longest ago: their episodes may have been aborted.
            drawn = self._drawn[unscored]
            level = int(rng.choice(unscored[drawn == drawn.min()]))
        else:
            level = self._draw_scored(rng, n_scored)
        self._draws += 1
        self._drawn[level] = self._draws
        return level

    def _check_scoring(self) -> None:
        """Warn once if the scores of the critic are never set."""
        if not self._reported and self.plays.sum() >= PLAYS_WITHOUT_SCORE * len(self.plays):
            self._reported = True
            gym.logger.warn(
                f"the levels have no scores {self.score!r}, so all are equally likely; use LevelScoring, or "
                "call score_rollout after each rollout"
            )

    def _draw_scored(self, rng: np.random.Generator, n_scored: int) -> int:
        if self._age >= MAX_AGE or n_scored > MAX_GROWTH * len(self._levels):
            self._levels = np.flatnonzero(~np.isnan(self.scores))
            self._cumulative, self._age = np.cumsum(self.probabilities[self._levels]), 0
        self._age += 1
        k = np.searchsorted(self._cumulative, rng.random() * self._cumulative[-1], side="right")
        return int(self._levels[min(k, len(self._levels) - 1)])

    @property
    def probabilities(self) -> np.ndarray:
        """Probabilities (N,) with which the levels that have a score are replayed."""
        result = np.zeros(len(self.plays))
        known = np.flatnonzero(~np.isnan(self.scores))
        if len(known) == 0:
            return result
        from scipy.stats import rankdata  # takes half a second to load

        by_score = rankdata(-self.scores[known]) ** (-1.0 / self._temperature)
        by_age = (self._draws - self._drawn[known] + 1).astype(float)
        result[known] = (1 - self._staleness) * by_score / by_score.sum() + self._staleness * by_age / by_age.sum()
        return result

    def record(self, outcome: LevelOutcome) -> None:
        """Store the outcome of an episode, and the score that follows from it; the environment calls it."""
        super().record(outcome)
        i = outcome.index
        if self.score == "regret":
            self.scores[i] = self.regrets[i]
        elif self.score == "learnability":
            self.scores[i] = self.success[i] * (1 - self.success[i])

    def score_rollout(
        self, levels: np.ndarray, values: np.ndarray, advantages: np.ndarray, rewards: np.ndarray, ends: np.ndarray
    ) -> None:
        """Set the scores of the levels in a rollout of T steps of N robots from the values of a critic.

        Call it after each rollout with "positive_value_loss", the mean of the positive generalised advantages of the
        steps of a level, or "max_mc", the mean of G - (R + V): highest return G of the level so far, reward R of the
        episode until the step, value V. (In the literature R = 0, since rewards come at the end of an episode.) It does
        nothing with the other scores.

        Args:
            levels (T, N): index of the level of each step.
            values (T, N): values of the critic before each step.
            advantages (T, N): generalised advantage estimates.
            rewards (T, N): the rewards that the critic learns from.
            ends (T, N): whether an episode ends with the step.

        """
        if self.score not in VALUE_SCORES:
            return
        levels = np.asarray(levels)
        if self.score == "positive_value_loss":
            terms = np.maximum(advantages, 0.0)
        else:
            earned = self._sum_rewards(levels, np.asarray(rewards), np.asarray(ends, dtype=bool))
            terms = self._best_returns[levels] - (earned + values)  # -inf in a level that has not been finished
        played, inverse = np.unique(levels.ravel(), return_inverse=True)
        means = np.bincount(inverse, weights=terms.ravel()) / np.bincount(inverse)
        finite = np.isfinite(means)
        self.scores[played[finite]] = means[finite]

    def discard_episodes(self) -> None:
        """Forget the rewards of unfinished episodes; call it after a reset of the environment, for "max_mc"."""
        self._earned = None

    def _sum_rewards(self, levels: np.ndarray, rewards: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return the reward (T, N) of the episode before each step, and update the highest returns."""
        before = np.empty(rewards.shape)
        total = np.zeros(levels.shape[1]) if self._earned is None else self._earned
        for t, (playing, ended) in enumerate(zip(levels, ends, strict=True)):
            before[t] = total
            total = total + rewards[t]
            np.maximum.at(self._best_returns, playing[ended], total[ended])
            total = np.where(ended, 0.0, total)
        self._earned = total
        return before


class LearnabilitySampler(PrioritizedSampler):
    """Draw levels by their learnability p (1 - p); arguments as for `PrioritizedSampler`, without `score`."""

    def __init__(self, bank: ScenarioBank, **options: Any) -> None:
        super().__init__(bank, "learnability", **options)


class RegretSampler(PrioritizedSampler):
    """Draw levels by the regret of the policy; arguments as for `PrioritizedSampler`, without `score`."""

    def __init__(self, bank: ScenarioBank, **options: Any) -> None:
        super().__init__(bank, "regret", **options)


def make_sampler(name: str, bank: ScenarioBank, **options: Any) -> UniformSampler:
    """Make a level sampler.

    Args:
        name: "uniform", "plr" (with the option `score`), "learnability" or "regret".
        bank: the levels.
        options: options of `PrioritizedSampler`; none for "uniform".

    Raises:
        ValueError: the name or an option is invalid.

    """
    check_choice("name", name, SAMPLERS)
    kinds: tuple[Callable[..., UniformSampler], ...] = (
        UniformSampler,
        PrioritizedSampler,
        LearnabilitySampler,
        RegretSampler,
    )
    return kinds[SAMPLERS.index(name)](bank, **options)
