"""Motors and disturbances: the included policy of `clutter`, for the ideal robot, and PPO from it, in several runs.

python studies/motors/run.py        # trains and scores
python studies/motors/run.py ideal  # scores only the policy of the ideal robot

`configurations/ppo.json` contains the complete settings, in the format of `config.json` of a training run, and
`results/` the episodes in fresh scenarios. A finished run is not repeated, an interrupted one resumes. `--tiny` trains
with a tiny budget, to try the script; it needs `--out`.
"""

import sys
from pathlib import Path
from typing import Any

from stable_baselines3.common.policies import BasePolicy

from leapnav.envs import NavigateEnv
from leapnav.training import make_policy
from leapnav.training.policies.actors import copy_actor

sys.path.append(str(Path(__file__).parents[1]))
from common import fresh_bank, load, play, read_arguments, score_tables, train

HERE = Path(__file__).parent
FAMILY, START, SCENARIOS, SEEDS = "clutter", "clutter", 1000, 3
HIDDEN = (256, 256, 256)  # of the included policy
DISTURBANCES = (0.2, 0.1, 0.0)  # of the evaluations; that of the training is the first
ROWS = {"ideal": "of the ideal robot", "ppo": "PPO from it"}
NAMES = tuple(ROWS)
TABLES = {"motors": "docs/results.md", "motors-runs": "docs/results.md"}


def load_ideal() -> tuple[BasePolicy, dict[str, Any]]:
    """Return the policy of the ideal robot, for the observations of the robot with motors, and the environment."""
    policy, environment = load(Path(START))
    environment |= {"actuation": "motor"}
    env = NavigateEnv(FAMILY, split="fresh", **environment)
    adapted = make_policy(env.observation_space, env.action_space, hidden=HIDDEN)
    copy_actor(policy, adapted)
    return adapted, environment


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    labels = {f"{name}-{size}": f"{size:g} | {label}" for size in DISTURBANCES for name, label in ROWS.items()}
    return dict(zip(TABLES, score_tables(results, "disturbance | policy", labels), strict=True))


def main() -> None:
    """Train, and score the policies with each disturbance."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, settings = arguments.tiny, HERE / "configurations/ppo.json"
    bank = fresh_bank(arguments.runs, FAMILY, 2 if tiny else SCENARIOS, tiny=tiny)
    for name in arguments.names:
        policies = [load_ideal()]
        if name == "ppo":
            runs = [arguments.runs / "motors" / f"ppo-{seed}" for seed in range(2 if tiny else SEEDS)]
            policies = [load(train(settings, run, tiny=tiny, seed=i, hidden=HIDDEN)) for i, run in enumerate(runs)]
        for disturbance in DISTURBANCES:
            disturbed = [(policy, {**environment, "disturbance": disturbance}) for policy, environment in policies]
            play(disturbed, [bank], arguments.results, f"{name}-{disturbance}", progress=not tiny)
    print("\n".join(tables(arguments.results).values()))


if __name__ == "__main__":
    main()
