"""PPO in a single file, after CleanRL's ppo_continuous_action.py, on leapnav's vector environment.

S. Huang et al., CleanRL: High-quality single-file implementations of deep RL algorithms, JMLR 23 (2022).

python examples/cleanrl_ppo.py --total-timesteps 1000000
python examples/cleanrl_ppo.py --family clutter --levels regret
"""

from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Normal

from leapnav.envs import ScenarioBank
from leapnav.envs.vector import AutoresetMode
from leapnav.training import NavigationFeatures, PrioritizedSampler, evaluate, make_sampler


def layers(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network with two hidden layers of 64 units and orthogonal initial weights."""
    sizes, gains, modules = (inputs, 64, 64, outputs), (2**0.5, 2**0.5, gain), []
    for i, layer_gain in enumerate(gains):
        linear = nn.Linear(sizes[i], sizes[i + 1])
        nn.init.orthogonal_(linear.weight, layer_gain)
        nn.init.zeros_(linear.bias)
        modules += [linear, nn.Tanh()]
    return nn.Sequential(*modules[:-1])


class Agent(nn.Module):
    """Actor and critic, with the method `predict` of a policy that leapnav can evaluate."""

    def __init__(self, envs: gym.vector.VectorEnv) -> None:
        super().__init__()
        # Scaled and transformed observations; raw metres and seconds are hard to learn from.
        self.features = NavigationFeatures(envs.single_observation_space)
        inputs, actions = self.features.features_dim, envs.single_action_space.shape[0]
        self.critic, self.actor = layers(inputs, 1, 1.0), layers(inputs, actions, 0.01)
        self.log_std = nn.Parameter(torch.full((actions,), -1.2))

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the values of observations."""
        return self.critic(self.features(observation))[:, 0]

    def distribution(self, observation: torch.Tensor) -> Normal:
        """Return the distribution of the actions."""
        return Normal(self.actor(self.features(observation)), self.log_std.exp())

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        """Return the mean action for an observation, or the actions for a batch of observations."""
        batch = torch.as_tensor(observation).reshape(-1, np.shape(observation)[-1])
        actions = self.distribution(batch).mean.clamp(-1, 1).numpy()
        return actions.reshape(*np.shape(observation)[:-1], -1), state


def main(
    family: str = "open",
    total_timesteps: int = 300_000,
    num_envs: int = 64,
    num_steps: int = 64,
    seed: int = 0,
    levels: Literal["fresh", "uniform", "plr", "learnability", "regret"] = "fresh",
    test_scenarios: int | None = None,
) -> float:
    """Train a policy from scratch, and score it against the optimum.

    Args:
        family: Family of the scenarios: open, clutter, polygons, rooms or slalom.
        total_timesteps: Environment steps of all robots together.
        num_envs: Number of robots.
        num_steps: Environment steps of each robot between two updates.
        seed: Random seed.
        levels: Scenarios of the episodes: fresh ones, or those of the training split that a level sampler chooses.
        test_scenarios: Number of test scenarios of the score; by default all.

    """
    gamma, gae_lambda, clip, epochs, batch = 0.99, 0.95, 0.2, 5, 512
    torch.manual_seed(seed)
    environment = {"reward": "shaped", "control_period": 0.2}
    scenarios: dict[str, Any] = {"family": family, "split": "fresh"}
    sampler = None
    if levels != "fresh":
        bank = ScenarioBank.shipped(family, "train")
        sampler = make_sampler(levels, bank)
        scenarios = {"bank": bank, "sampler": sampler}
    envs = gym.make_vec(
        "leapnav/Navigate-v0",
        num_envs,
        "vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        discount=gamma,
        graded_miss=True,  # a constant penalty of a miss would not indicate where the goal is
        reward_scale=0.1,  # brings returns to order 1
        **scenarios,
        **environment,
    )
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    following = torch.as_tensor(envs.reset(seed=seed)[0])
    updates = max(1, total_timesteps // (num_envs * num_steps))
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = 1e-3 * (1 - update / updates)
        rows: dict[str, list[torch.Tensor]] = {name: [] for name in ("x", "a", "logp", "value", "reward", "done")}
        successes: list[float] = []
        played = []
        for _ in range(num_steps):
            with torch.no_grad():
                distribution = agent.distribution(following)
                action, value = distribution.sample(), agent.value(following)
            observed = following
            played.append(envs.unwrapped.indices)
            # The episode terminates at the horizon, so there is no value after it.
            observation, reward, done, _, info = envs.step(action.clamp(-1, 1).numpy())
            following = torch.as_tensor(observation)
            if done.any():
                successes += info["final_info"]["is_success"][done].tolist()
            step = (observed, action, distribution.log_prob(action).sum(1), value, reward, done)
            for row, entry in zip(rows.values(), step, strict=True):
                row.append(torch.as_tensor(entry, dtype=torch.float32))
        x, a, logp, value, reward, done = (torch.stack(row) for row in rows.values())
        with torch.no_grad():
            values = torch.cat([value, agent.value(following)[None]])
        advantage, last = torch.zeros_like(reward), torch.zeros(num_envs)
        for t in reversed(range(num_steps)):
            alive = 1 - done[t]
            last = reward[t] + gamma * alive * values[t + 1] - values[t] + gamma * gae_lambda * alive * last
            advantage[t] = last
        if isinstance(sampler, PrioritizedSampler):
            columns = (column.numpy() for column in (value, advantage, reward, done))
            sampler.score_rollout(np.array(played), *columns)
        flat = [column.flatten(0, 1) for column in (x, a, logp, advantage, advantage + value)]
        for _ in range(epochs):
            for chosen in torch.randperm(num_envs * num_steps).split(batch):
                x_, a_, logp_, advantage_, return_ = (column[chosen] for column in flat)
                distribution = agent.distribution(x_)
                ratio = (distribution.log_prob(a_).sum(1) - logp_).exp()
                advantage_ = (advantage_ - advantage_.mean()) / (advantage_.std() + 1e-8)
                policy_loss = -torch.min(ratio * advantage_, ratio.clamp(1 - clip, 1 + clip) * advantage_).mean()
                value_loss = 0.5 * (agent.value(x_) - return_).square().mean()
                optimizer.zero_grad()
                (policy_loss + 0.5 * value_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        if successes and update % 10 == 0:
            steps = (update + 1) * num_envs * num_steps
            print(f"{steps:9,} steps: training success {100 * np.mean(successes):.0f} %", flush=True)
    score = evaluate(agent, family, count=test_scenarios, environment=environment)
    print(f"success {100 * score.success:.1f} %, collision {100 * score.collision:.1f} %, SOC {score.soc:.3f}")
    return score.soc


if __name__ == "__main__":
    tyro.cli(main)
