"""Install leapnav in fresh environments and run a smoke test there (`make test-all`).

    python scripts/check_installations.py [wheel] [lowest] [newest]

- wheel: the built wheel with the pinned versions; the whole test suite runs against it, without the source directories.
- lowest: the lowest versions that `pyproject.toml` declares (direct dependencies).
- newest: the newest versions that it allows.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
TORCH = "torch==2.13.0"  # elsewhere the newest torch would bring gigabytes of CUDA
SMOKE = """
import gymnasium as gym
from stable_baselines3 import PPO
from leapnav.envs import ScenarioBank
from leapnav.experts import ExpertPolicy, find_optimum, rollout
from leapnav.training import CloningConfig, Dataset, behaviour_clone, evaluate, load_policy, make_vec_env, network

bank = ScenarioBank.shipped("clutter", "test")
assert abs(find_optimum(bank[7]).cost / bank.costs[7] - 1) < 1e-9
env = gym.make("leapnav/Navigate-v0", family="clutter", split="test")
observation, info = env.reset(options={"index": 7})
expert, done = ExpertPolicy(env), False
while not done:
    observation, _, done, _, info = env.step(expert.predict(observation)[0])
assert info["is_success"], info
rollout("open", 20, "demos", progress=False)
model = PPO("MlpPolicy", make_vec_env(n_envs=4, family="open"), n_steps=16, policy_kwargs=network((32, 32)), seed=0,
            tensorboard_log="logs")
behaviour_clone(model, "demos", CloningConfig(epochs=2, batch_size=256), progress=False)
model.learn(128)
assert evaluate(load_policy("open"), "open", count=5, progress=False).success > 0.5
print("smoke test passed")
"""


def environment(folder: Path) -> Path:
    """A fresh virtual environment; returns its Python."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    install(python, "--upgrade", "pip", "uv")
    return python


def install(python: Path, *arguments: object) -> None:
    subprocess.run([python, "-m", "pip", "install", "--quiet", *map(str, arguments)], check=True)


def build(folder: Path) -> Path:
    """The wheel of this tree."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT]
    subprocess.run(command, check=True)
    return next(folder.glob("leapnav-*.whl"))


def lowest() -> list[str]:
    """The direct dependencies at their declared minimum; torch as pinned, since older versions need an older NumPy."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found = []
    for line in project["dependencies"]:
        name, version = re.match(r"([\w\-\[\]]+)>=([\w.]+)", line).groups()
        found.append(TORCH if name == "torch" else f"{name}=={version}")
    return found


def smoke(python: Path, folder: Path) -> None:
    subprocess.run([python, "-W", "ignore", "-c", SMOKE], cwd=folder, check=True)


def main() -> int:
    chosen = sys.argv[1:] or ["wheel", "lowest", "newest"]
    for name in chosen:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            wheel, python = build(folder), environment(folder / "environment")
            if name == "wheel":
                install(python, "--constraint", ROOT / "constraints.txt", f"{wheel}[dev]")
                shutil.copytree(ROOT / "tests", folder / "tests")
                pages = "README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md"
                for extra in (*pages, "pyproject.toml", "docs", "examples", "scripts", "studies", "mkdocs.yml"):
                    source = ROOT / extra
                    (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / extra)
                variables = {**os.environ, "OMP_NUM_THREADS": "1"}
                subprocess.run([python, "-m", "pytest", "-n", "auto", "-q"], cwd=folder, env=variables, check=True)
            elif name == "lowest":
                install(python, *lowest(), wheel)
                smoke(python, folder)
            else:
                install(python, TORCH, wheel)
                smoke(python, folder)
        print(f"{name}: passed", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
