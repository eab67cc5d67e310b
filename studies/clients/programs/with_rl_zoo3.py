"""RL Zoo: training with `--gym-packages leapnav` and normalised observations, and `leapnav evaluate` of its files."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
from common import BANK, ID, one_scenario, report
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

SETTINGS = f"""
{ID}:
  normalize: "dict(norm_obs=True, norm_reward=False)"
  n_envs: 2
  n_timesteps: 256
  policy: MlpPolicy
  n_steps: 64
  batch_size: 64
"""

if __name__ == "__main__":
    arguments = one_scenario()
    Path("ppo.yml").write_text(SETTINGS, encoding="utf-8")
    words = ["--algo", "ppo", "--env", ID, "--gym-packages", "leapnav", "--conf-file", "ppo.yml", "-f", "logs"]
    train = [sys.executable, "-m", "rl_zoo3.train", *words, "--eval-freq", "-1", "--env-kwargs", f"family:'{BANK}'"]
    subprocess.run(train, check=True, capture_output=True)
    (model,), (statistics,) = Path("logs").glob("**/leapnav-Navigate-v0.zip"), Path("logs").glob("**/vecnormalize.pkl")
    command = [sys.executable, "-m", "leapnav", "evaluate", model, "--vecnormalize", statistics, "--trust"]
    subprocess.run([*command, "--family", BANK, "--json", "zoo.json"], check=True, capture_output=True)
    (row,) = json.loads(Path("zoo.json").read_text(encoding="utf-8"))["banks"][0]["scores"]
    envs = VecNormalize.load(str(statistics), DummyVecEnv([lambda: gym.make(ID, **arguments)]))
    envs.training = False
    report("`rl_zoo3.train`", evaluate_policy(PPO.load(model), envs, 1, warn=False)[0], row["mean_return"]["value"])
