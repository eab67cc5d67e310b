"""d3rlpy: BC on recorded episodes, scored by its own evaluator."""

import gymnasium as gym
import numpy as np
from common import ID, one_scenario, report, return_of
from d3rlpy.algos import BCConfig
from d3rlpy.dataset import MDPDataset
from d3rlpy.metrics import evaluate_qlearning_with_environment

from leapnav.experts import rollout
from leapnav.experts.data.datasets import open_dataset

if __name__ == "__main__":
    arguments = one_scenario()
    rollout("open", 20, "demonstrations", seed=2, progress=False)
    episodes = list(open_dataset("demonstrations"))
    data = MDPDataset(
        np.concatenate([episode.observations[:-1] for episode in episodes]),
        np.concatenate([episode.actions for episode in episodes]),
        np.concatenate([episode.rewards for episode in episodes]).astype(np.float32),
        np.concatenate([episode.terminations for episode in episodes]).astype(np.float32),
    )
    algorithm = BCConfig().create()
    algorithm.fit(data, n_steps=200, n_steps_per_epoch=200, show_progress=False, save_interval=10)
    found = evaluate_qlearning_with_environment(algorithm, gym.make(ID, **arguments), n_trials=1)
    report("`BC` on recorded episodes", found, return_of(lambda observation: algorithm.predict(observation[None])[0]))
