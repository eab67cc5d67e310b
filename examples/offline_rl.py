"""Offline reinforcement learning with d3rlpy, scored against the optimum: BC, TD3+BC or IQL on recorded episodes.

pip install leapnav
pip install --no-deps -r examples/requirements.txt
python examples/offline_rl.py --policies random open --episodes 500 --algorithm iql --steps 20000
"""

from pathlib import Path
from typing import Any, Literal

import d3rlpy
import minari
import numpy as np
import tyro

from leapnav.training import evaluate, record

ALGORITHMS: dict[str, Any] = {
    "bc": d3rlpy.algos.BCConfig(),
    "td3+bc": d3rlpy.algos.TD3PlusBCConfig(gamma=0.999, alpha=2.5),
    "iql": d3rlpy.algos.IQLConfig(gamma=0.999, expectile=0.9, weight_temp=3.0),
}


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


def load(folder: Path) -> tuple[d3rlpy.dataset.MDPDataset, dict[str, Any], list[float]]:
    """Return the transitions, the metadata and the returns of the Minari dataset below a directory."""
    (metadata,) = folder.glob("**/data/metadata.json")
    dataset = minari.MinariDataset(metadata.parent)
    episodes = list(dataset.iterate_episodes())
    transitions = d3rlpy.dataset.MDPDataset(
        np.concatenate([episode.observations[:-1] for episode in episodes]),
        np.concatenate([episode.actions for episode in episodes]),
        np.concatenate([episode.rewards for episode in episodes]).astype(np.float32),
        np.concatenate([episode.terminations for episode in episodes]).astype(np.float32),
        np.concatenate([episode.truncations for episode in episodes]).astype(np.float32),
    )
    return transitions, dataset.storage.metadata, [float(np.sum(episode.rewards)) for episode in episodes]


def fit(transitions: d3rlpy.dataset.MDPDataset, algorithm: str, steps: int) -> Any:
    """Return a d3rlpy algorithm that has learned from transitions in a number of gradient steps."""
    learner = ALGORITHMS[algorithm].create(device="cpu:0")
    learner.fit(
        transitions,
        n_steps=steps,
        n_steps_per_epoch=min(steps, 5000),
        show_progress=False,
        save_interval=10**9,  # epochs: save nothing
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )
    return learner


def main(
    family: str = "open",
    policies: tuple[str, ...] = ("expert",),
    episodes: int = 500,
    noise: float = 0.1,
    algorithm: Literal["bc", "td3+bc", "iql"] = "td3+bc",
    steps: int = 20_000,
    data: Path = Path("offline-data"),
    test_scenarios: int | None = None,
) -> None:
    """Record episodes of policies, learn from them, and score the result.

    Args:
        family: Family of the scenarios: open, clutter, polygons, rooms or slalom.
        policies: Policies that are recorded in turn: expert, random, go-to-goal, dwa, mppi, lattice, freespace, an
            included policy or a training run. They must observe the default, 32 lidar beams.
        episodes: Number of recorded episodes.
        noise: Standard deviation of the noise on the recorded actions, which are in [-1, 1].
        algorithm: Algorithm that learns.
        steps: Number of gradient steps.
        data: Directory of the recorded episodes; an existing dataset is used again.
        test_scenarios: Number of test scenarios of the score; by default all.

    """
    if not data.exists():
        record(policies, family, episodes, data, noise=noise)
    transitions, metadata, returns = load(data)
    score = evaluate(OfflinePolicy(fit(transitions, algorithm, steps)), family, count=test_scenarios)
    low, high = metadata["ref_min_score"], metadata["ref_max_score"]
    achieved = np.mean([episode.episode_return for episode in score])
    print(f"normalised return: data {(np.mean(returns) - low) / (high - low):.3f}, ", end="")
    print(f"{algorithm} {(achieved - low) / (high - low):.3f}")
    print(f"success {100 * score.success:.1f} %, collision {100 * score.collision:.1f} %, SOC {score.soc:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
