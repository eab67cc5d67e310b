"""sb3-contrib: its algorithms, evaluated by Stable-Baselines3 and by `leapnav evaluate` from their files."""

import json
import subprocess
import sys

import gymnasium as gym
from common import BANK, ID, one_scenario, report
from sb3_contrib import ARS, TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3.common.evaluation import evaluate_policy

STEPS = 256
SETTINGS = {
    TQC: {"learning_starts": 200},
    CrossQ: {"learning_starts": 200},
    TRPO: {"n_steps": 64, "batch_size": 64},
    RecurrentPPO: {"n_steps": 64, "batch_size": 64},
    ARS: {"n_delta": 1, "n_top": 1},
}

if __name__ == "__main__":
    env = gym.make(ID, **one_scenario())
    for algorithm, settings in SETTINGS.items():
        name = algorithm.__name__
        model = algorithm("MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy", env, seed=0, **settings)
        model.learn(STEPS)
        model.save(name)
        command = [sys.executable, "-m", "leapnav", "evaluate", f"{name}.zip", "--trust", "--family", BANK]
        subprocess.run([*command, "--json", f"{name}.json"], check=True, capture_output=True)
        with open(f"{name}.json", encoding="utf-8") as file:
            (row,) = json.load(file)["banks"][0]["scores"]
        report(name, evaluate_policy(model, env, 1, warn=False)[0], row["mean_return"]["value"])
