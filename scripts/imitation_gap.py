"""Measure which failures of a clone in rooms are due to what it cannot observe, and which to averaging over modes.

python scripts/imitation_gap.py                             # records 6,000 demonstrations, fits and scores four clones
python scripts/imitation_gap.py --only lidar mixture
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from leapnav.envs import NavigateEnv, ScenarioBank
from leapnav.envs.simulation.observations import GOAL_ENTRIES
from leapnav.experts import rollout
from leapnav.experts.data.banks import build_bank
from leapnav.training import CloningConfig, Dataset, NavigationFeatures, evaluate, make_policy, score
from leapnav.training.learning.cloning import _Fit
from leapnav.training.learning.samples import Batch
from leapnav.training.scoring.reports import markdown_cells
from leapnav.training.threads import limit_threads

FAMILY, DEMONSTRATIONS, DEMONSTRATION_SEED = "rooms", 6000, 60_000
SCENARIOS, BANK_SEED = 4000, 781
MAX_EPOCHS = 12
COMPONENTS = 4  # of the mixture density
MIN_STD = 0.02  # of a component
OBSTACLES, VERTICES, WALL_ENTRIES = 8, 4, 6  # of the map; a scenario of rooms has at most 8 rectangles
SENSORS: dict[str, dict[str, Any]] = {
    "lidar": {"lidar_beams": 128},
    "mixture": {"lidar_beams": 128},
    "map": {"observation": "map", "map_obstacles": OBSTACLES, "map_vertices": VERTICES},
    "geodesic": {"observation": "geodesic", "lidar_beams": 64},
}


class MixtureHead(nn.Module):
    """A mixture of Gaussians as the last layer; the action is the mean of the most probable component.

    C. M. Bishop, "Mixture density networks" (1994).
    """

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self._layer, self._actions = nn.Linear(inputs, COMPONENTS * (1 + 2 * actions)), actions

    def forward(self, latent: th.Tensor) -> th.Tensor:
        """Return the actions (B, m)."""
        logits, means, _ = self.parts(latent)
        return means[th.arange(len(means)), logits.argmax(dim=1)]

    def parts(self, latent: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return the logits (B, K), the means and the standard deviations (B, K, m) of the components."""
        logits, rest = self._layer(latent).split([COMPONENTS, 2 * COMPONENTS * self._actions], dim=1)
        means, stds = rest.unflatten(1, (COMPONENTS, 2, self._actions)).unbind(dim=2)
        return logits, means, nn.functional.softplus(stds - 1.0) + MIN_STD


class MixtureCloning(_Fit):
    """Behaviour cloning by the likelihood of the expert's actions under a mixture density."""

    def _loss(self, batch: Batch) -> th.Tensor:
        policy: Any = self._policy
        features = policy.extract_features(batch.observations, policy.pi_features_extractor)
        logits, means, stds = policy.action_net.parts(policy.mlp_extractor.forward_actor(features))
        components = th.distributions.Normal(means, stds).log_prob(batch.actions[:, None]).sum(dim=2)
        return -th.logsumexp(logits.log_softmax(dim=1) + components, dim=1).mean()


class MapFeatures(BaseFeaturesExtractor):
    """Features of the goal, the walls, and the maximum over the obstacles of a network of each."""

    WIDTH = 128

    def __init__(self, observation_space: spaces.Box) -> None:
        goal = NavigationFeatures(
            spaces.Box(observation_space.low[:GOAL_ENTRIES], observation_space.high[:GOAL_ENTRIES])
        )
        super().__init__(observation_space, goal.features_dim + 2 * WALL_ENTRIES + self.WIDTH)
        self.goal = goal
        inputs = 2 + 4 * VERTICES + goal.features_dim
        self.obstacle = nn.Sequential(
            nn.Linear(inputs, self.WIDTH), nn.ReLU(), nn.Linear(self.WIDTH, self.WIDTH), nn.ReLU()
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features (B, features_dim) of observations (B, d)."""
        parts = [GOAL_ENTRIES, WALL_ENTRIES, observations.shape[1] - GOAL_ENTRIES - WALL_ENTRIES]
        goal, walls, obstacles = observations.split(parts, dim=1)
        goal, obstacles = self.goal(goal), obstacles.unflatten(1, (OBSTACLES, -1))
        exists, vertices = obstacles[:, :, :1], obstacles[:, :, 2:]
        around = goal[:, None].expand(-1, OBSTACLES, -1)
        encoded = self.obstacle(th.cat([obstacles[:, :, :2], vertices / 5, th.tanh(vertices), around], dim=2)) * exists
        return th.cat([goal, walls / 5, th.exp(-walls.abs()), encoded.amax(dim=1)], dim=1)


def make_learner(name: str, env: NavigateEnv) -> ActorCriticPolicy:
    """Return the untrained policy of a row."""
    if name != "map":
        policy = make_policy(env.observation_space, env.action_space)
    else:
        with th.random.fork_rng(devices=[]):
            th.manual_seed(0)
            policy = ActorCriticPolicy(
                env.observation_space,
                env.action_space,
                lambda _: 3e-4,
                net_arch={"pi": [256, 256, 256], "vf": [256, 256, 256]},
                activation_fn=nn.ReLU,
                features_extractor_class=MapFeatures,
            )
    if name == "mixture":
        with th.random.fork_rng(devices=[]):
            th.manual_seed(0)
            policy.action_net = MixtureHead(256, 2)
    return policy


@limit_threads
def main() -> None:
    """Record, fit and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/imitation_gap"))
    parser.add_argument("--only", nargs="+", default=list(SENSORS), choices=SENSORS)
    parser.add_argument("--workers", type=int, default=2, help="number of processes that record demonstrations")
    arguments = parser.parse_args()
    folder, workers = arguments.runs, arguments.workers
    rollout(FAMILY, DEMONSTRATIONS, folder / "demonstrations", seed=DEMONSTRATION_SEED, workers=workers)
    if not (folder / "fresh.bank").exists():
        build_bank(FAMILY, SCENARIOS, folder / "fresh.bank", seed=BANK_SEED, workers=workers)
    demonstrations, bank = Dataset.of(folder / "demonstrations"), ScenarioBank(folder / "fresh.bank")
    for name in arguments.only:
        env = NavigateEnv(FAMILY, split="fresh", **SENSORS[name])
        policy, dataset = make_learner(name, env), demonstrations.observed(env.settings)
        # A map can be mirrored, too, but the symmetries of the samples are those of a lidar.
        config = CloningConfig(epochs=MAX_EPOCHS, augment=name != "map")
        fit = (MixtureCloning if name == "mixture" else _Fit)(policy, dataset, config, 0)
        while not fit.finished:
            loss = fit.run_epoch()
            print(f"{name}: epoch {loss.epoch}, losses {loss.training:.4f} {loss.validation:.4f}", flush=True)
        fit.finish()
        evaluation = evaluate(policy, bank, environment=SENSORS[name], timed=False)
        lowest = np.nanmin([loss.validation for loss in fit.losses])
        print(f"| {name} | {lowest:.3f} | {markdown_cells(score(name, evaluation))} |", flush=True)


if __name__ == "__main__":
    main()
