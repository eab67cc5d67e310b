"""RLlib: PPO trains for one iteration, and the policy of its checkpoint is evaluated."""

from pathlib import Path

import gymnasium as gym
import torch
from common import ID, one_scenario, report, return_of
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module import RLModule
from ray.tune.registry import register_env

if __name__ == "__main__":
    arguments = one_scenario()
    register_env("navigate", lambda _: gym.make(ID, **arguments))
    config = PPOConfig().environment("navigate").env_runners(num_env_runners=0)
    config.training(train_batch_size_per_learner=512, minibatch_size=128, num_epochs=1).debugging(seed=0)
    config.evaluation(
        evaluation_interval=1,
        evaluation_duration=1,
        evaluation_config=PPOConfig.overrides(explore=False),
    )
    algorithm = config.build_algo()
    algorithm.train()
    found = algorithm.evaluate()["env_runners"]["episode_return_mean"]
    checkpoint = Path("checkpoint").absolute()
    algorithm.save_to_path(str(checkpoint))
    module = RLModule.from_checkpoint(str(checkpoint / "learner_group" / "learner" / "rl_module" / "default_policy"))

    def act(observation):
        """Return the action of the mean of the distribution, as RLlib's own evaluation executes it."""
        with torch.no_grad():
            inputs = module.forward_inference({"obs": torch.as_tensor(observation[None])})["action_dist_inputs"]
        return inputs[0, : inputs.shape[1] // 2].clamp(-1.0, 1.0).numpy()

    report("RLlib: PPO and its checkpoint", found, return_of(act))
