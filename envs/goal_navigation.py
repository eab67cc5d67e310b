"""The environment `leapnav/NavigateGoal-v0`, for goal-conditioned learners."""

from __future__ import annotations

from typing import Any

import numpy as np

from leapnav.envs.goals import GoalConditioned
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.simulation.state import Episode


class NavigateGoalEnv(GoalConditioned, NavigateEnv):
    """`NavigateEnv` for goal-conditioned learners, such as hindsight experience replay.

    ## Observation space
    A `Dict` of three boxes, as in Gymnasium-Robotics:

    | Key | Index | Observation | Unit | Range |
    |---|---|---|---|---|
    | `achieved_goal` | 0, 1 | position | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the heading | 1 | -1 to 1 |
    | `desired_goal` | 0, 1 | goal position | m | -1000 to 1000 |
    | | 2, 3 | cosine and sine of the goal heading; 0, 0 if the goal heading is free | 1 | -1 to 1 |
    | `observation` | 0 | time left, with a fixed horizon only | s | 0 to 10000 |
    | | following | the parts of `NavigateEnv` without `goal` | | |

    ## Rewards
    | `reward` | Value |
    |---|---|
    | `"sparse"` (the default) | 1 for each step that ends at the goal, within the tolerances; otherwise 0 |
    | `"cost"` | that of `NavigateEnv`; `compute_reward` then needs the infos of the steps |

    `env.unwrapped.compute_reward(achieved_goal, desired_goal, info)` returns it for any goal, as in Gymnasium-Robotics.

    The sensing noise of a `Disturbance` affects the lidar but not the goals, which determine the reward. The `info`
    also contains `terminated` and `at_horizon`. Everything else is the same as in `NavigateEnv`.
    """

    _goal_conditioned = True

    def __init__(self, *args: Any, reward: str = "sparse", **arguments: Any) -> None:
        super().__init__(*args, reward=reward, **arguments)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold an action for one control period, see `NavigateEnv.step`; the reward is that of `compute_reward`."""
        observation, _, terminated, truncated, info = super().step(action)
        reward = float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info))
        return observation, reward, terminated, truncated, info

    def _info(self, episode: Episode) -> dict[str, Any]:
        ends = {"terminated": episode.terminated, "at_horizon": episode.steps >= episode.last_step}
        return {**super()._info(episode), **ends}
