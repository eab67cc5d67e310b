"""Offline reinforcement learning on the expert's demonstrations, with d3rlpy's TD3+BC, scored against the optimum.

pip install leapnav d3rlpy
python examples/offline_rl.py --scenarios 500 --steps 20000
"""

from pathlib import Path
from typing import Any

import d3rlpy
import numpy as np
import tyro

from leapnav.experts.rollouts import rollout
from leapnav.training import Dataset, evaluate


class Learned:
    """A d3rlpy algorithm as a policy that leapnav can score."""

    def __init__(self, algorithm: Any) -> None:
        self.algorithm = algorithm

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Actions for a batch of observations, or for one."""
        actions = self.algorithm.predict(np.atleast_2d(observation))
        return (actions if np.ndim(observation) > 1 else actions[0]), state


def main(family: str = "open", scenarios: int = 500, steps: int = 20_000, demos: Path = Path("demos")) -> None:
    """Makes demonstrations, learns from them alone, and scores what was learned.

    Args:
        family: of the scenarios.
        scenarios: to demonstrate.
        steps: of gradient descent.
        demos: folder of the demonstrations; what is there already is used again.

    """
    # Noise, so that there is something to learn beside the expert's own way: actions driven are not the expert's.
    rollout(family, scenarios, demos, noise=0.1)
    data = Dataset.of(demos)
    last = np.append(np.diff(data.episodes) != 0, True)  # of its episode
    dataset = d3rlpy.dataset.MDPDataset(
        data.observations, data.executed, data.rewards.astype(np.float32), last.astype(np.float32)
    )
    algorithm = d3rlpy.algos.TD3PlusBCConfig(gamma=0.999, alpha=2.5).create(device="cpu:0")
    algorithm.fit(dataset, n_steps=steps, n_steps_per_epoch=min(steps, 5000), show_progress=False, save_interval=10**9,
                  logger_adapter=d3rlpy.logging.NoopAdapterFactory())  # fmt: skip
    found = evaluate(Learned(algorithm), family)
    print(f"success {100 * found.success:.1f} %, collision {100 * found.collision:.1f} %, SOC {found.soc:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
