"""Policies with momentum, for a free horizon: an undecided action continues in the direction of the last one.

On an optimum with a free horizon the Hamiltonian is 0. For a robot without drift this is 1/2 u'Ru = c + Phi, so the
effort 1/2 u'Ru of an optimal control is at least the time weight c. Between two paths of similar cost, or where
obstacles are hidden, a network that was fitted to optimal actions returns smaller ones. Without memory and without the
time left in the observation, the robot would stay there. The missing effort is therefore added in the
direction of the last action.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.sac.policies import SACPolicy

from leapnav.envs.scenarios.scenario import Scenario

# Weight of the last action, per missing unit of the norm. In 500 scenarios of clutter, weights of 0, 1/2, 1, 2 and 4
# gave a policy 96.4, 98.2, 98.4, 99.2 and 98.8 % success.
MOMENTUM = 2.0
MIN_NORM = 1e-6  # of an action that is scaled


def effort_weights(scenario: Scenario) -> tuple[float, ...] | None:
    """Return the weights (m,) w of the squared actions with which an optimal action a has sum(w a^2) >= 1.

    None if the horizon is fixed, or if the robot has drift or a state cost.
    """
    robot, cost = scenario.robot, scenario.cost
    dynamics = type(robot).dynamics()
    if scenario.horizon is not None or any(dynamics.drift) or dynamics.state_cost != 0:
        return None
    largest = [r * u**2 for r, u in zip(robot.control_weight(cost), robot.limits(), strict=True)]
    # If a limit is below the optimal speed, the effort at that limit is smaller.
    least = min(2.0 * cost.time_weight, *largest)
    return tuple(value / least for value in largest)


def add_momentum(actions: th.Tensor, previous: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """Return actions (B, m) whose effort is that of an optimal action at least.

    Args:
        actions: (B, m), of the network.
        previous: (B, m), the last actions, 0 at the start of an episode.
        weights: (m,), see `effort_weights`.

    """
    norm = (weights * actions.square()).sum(dim=-1, keepdim=True).sqrt()
    moved = actions + MOMENTUM * (1.0 - norm).clamp(min=0.0) * previous
    reached = (weights * moved.square()).sum(dim=-1, keepdim=True).sqrt()
    return th.where(norm < 1.0, moved / reached.clamp(min=MIN_NORM, max=1.0), actions).clamp(-1.0, 1.0)


class _WithMomentum(BasePolicy):
    """A policy with momentum, whose state is the last action.

    Args:
        args, kwargs: arguments of the class without momentum.
        effort_weights: see the function `effort_weights`; None: without momentum.

    """

    def __init__(self, *args: Any, effort_weights: Sequence[float] | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.effort_weights = None if effort_weights is None else tuple(map(float, effort_weights))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "effort_weights": self.effort_weights}

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions for an observation or a batch of them, and the state for the next call.

        Args:
            observation: observations (d,) or (N, d).
            state: the state that the last call returned; None at the start of an episode.
            episode_start: (N,), bool, the episodes that start with these observations.
            deterministic: whether to return the mean action.

        """
        actions, _ = super().predict(observation, None, episode_start, deterministic)
        if self.effort_weights is None:
            return actions, state
        previous = np.zeros_like(actions) if state is None else state[0]
        if episode_start is not None:
            starts = np.asarray(episode_start, dtype=bool).reshape(-1, 1)
            previous = np.where(starts, 0.0, np.atleast_2d(previous)).astype(actions.dtype).reshape(actions.shape)
        weights = th.tensor(self.effort_weights)
        moved = add_momentum(th.as_tensor(actions), th.as_tensor(previous), weights).numpy()
        return moved, (moved,)


class MomentumPolicy(_WithMomentum, ActorCriticPolicy):
    """An actor-critic policy with momentum: the arguments of `ActorCriticPolicy`, and `effort_weights`."""


class MomentumSACPolicy(_WithMomentum, SACPolicy):
    """A policy of SAC with momentum: the arguments of `SACPolicy`, and `effort_weights`."""
