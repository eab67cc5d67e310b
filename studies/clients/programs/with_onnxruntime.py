"""onnxruntime: an exported policy drives."""

import subprocess
import sys

import gymnasium as gym
import onnxruntime
from common import ID, NAME, included, report

if __name__ == "__main__":
    arguments, _, expected = included()
    subprocess.run([sys.executable, "-m", "leapnav", "export", NAME, "--onnx", "policy.onnx"], check=True)
    session, env, total, ended = onnxruntime.InferenceSession("policy.onnx"), gym.make(ID, **arguments), 0.0, False
    name = session.get_inputs()[0].name
    observation, _ = env.reset(seed=0)
    while not ended:
        (actions, *_) = session.run(None, {name: observation[None]})
        observation, reward, terminated, truncated, _ = env.step(actions[0])
        total, ended = total + float(reward), terminated or truncated
    report("an exported policy", total, expected)
