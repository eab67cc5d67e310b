"""Offline reinforcement learning on the expert's demonstrations, with TD3+BC of d3rlpy, scored against the optimum.

pip install leapnav d3rlpy
python examples/offline_rl.py --scenarios 500 --steps 20000
"""

from pathlib import Path
from typing import Any

import d3rlpy
import numpy as np
import tyro

from leapnav.experts import rollout
from leapnav.training import Dataset, evaluate


class OfflinePolicy:
    """A d3rlpy algorithm as a policy that leapnav can evaluate."""

    def __init__(self, algorithm: Any) -> None:
        self.algorithm = algorithm

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action for an observation, or the actions for a batch of observations."""
        actions = self.algorithm.predict(np.atleast_2d(observation))
        return (actions if np.ndim(observation) > 1 else actions[0]), state


def main(
    family: str = "open",
    scenarios: int = 500,
    steps: int = 20_000,
    demos: Path = Path("demos"),
    test_scenarios: int | None = None,
) -> None:
    """Record demonstrations, learn from them, and score the policy.

    Args:
        family: Family of the scenarios: open, clutter, polygons, rooms or slalom.
        scenarios: Number of scenarios to demonstrate.
        steps: Number of gradient steps.
        demos: Directory of the demonstrations; an existing dataset is used again.
        test_scenarios: Number of test scenarios of the score; by default all.

    """
    # With noise the executed actions differ from the expert's, and their rewards show which are better.
    rollout(family, scenarios, demos, noise=0.1)
    data = Dataset.of(demos)
    is_last = np.append(np.diff(data.episodes) != 0, True)  # step of an episode
    dataset = d3rlpy.dataset.MDPDataset(
        data.observations, data.executed, data.rewards.astype(np.float32), is_last.astype(np.float32)
    )
    algorithm = d3rlpy.algos.TD3PlusBCConfig(gamma=0.999, alpha=2.5).create(device="cpu:0")
    algorithm.fit(
        dataset,
        n_steps=steps,
        n_steps_per_epoch=min(steps, 5000),
        show_progress=False,
        save_interval=10**9,  # epochs: save nothing
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )
    score = evaluate(OfflinePolicy(algorithm), family, count=test_scenarios)
    print(f"success {100 * score.success:.1f} %, collision {100 * score.collision:.1f} %, SOC {score.soc:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
