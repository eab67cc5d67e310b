"""The included policies: training, and scores in fresh scenarios of their families.

python studies/included_policies/run.py                   # scores all included policies
python studies/included_policies/run.py clutter crossing  # scores only these; clutter-hard: among hard obstacles
python studies/included_policies/run.py clutter --train   # trains and includes them first; resumes unfinished runs

`configurations/` contains the complete settings of each policy, in the format of `config.json` of a training run, and
`results/` the episodes. The scenarios and their optima are built once in runs/studies/fresh. `--tiny` trains and scores
with a tiny budget, to try the script; it needs `--out`.
"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

from leapnav.envs import NavigateEnv
from leapnav.envs.scenarios.families import families_of
from leapnav.training import DAggerRunConfig, load_policy, policy_environment, read_episodes, save_policy, score
from leapnav.training.config import read_config
from leapnav.training.policies.architecture import with_symmetries
from leapnav.training.policies.files import read_description
from leapnav.training.policies.symmetries import symmetries
from leapnav.training.scoring.reports import markdown_cells

sys.path.append(str(Path(__file__).parents[1]))
from common import fresh_bank, load, play, read_arguments, train

HERE = Path(__file__).parent
INCLUDED = HERE.parents[1] / "training/policies/pretrained"  # the sources, which an editable installation links to
HARD = {"clutter-hard": "clutter"}  # results of policies among hard obstacles, for which they were not trained
NAMES = (*sorted(path.stem for path in (HERE / "configurations").glob("*.json")), *HARD)
# Policies that were trained without the means over the symmetries of the robot; the means were added afterwards.
AVERAGED = ("car-clutter", "polygons-lidar", "rooms-lidar", "slalom-lidar")
SCENARIOS = 4000  # of each bank of fresh scenarios
TABLES = {"included-policies": "docs/results.md"}  # with the files that contain them


def include(run: Path, included: Path, *, average: bool) -> None:
    """Write the actor of a run, in half precision, into the directory of the policies."""
    training, environment, policy = read_description(run)["training"], policy_environment(run), load_policy(run)
    if average:
        env = NavigateEnv(training["family"], split="fresh", **environment)
        policy = with_symmetries(policy, symmetries(env.settings, [env.source.robot]))
    shutil.rmtree(included, ignore_errors=True)
    save_policy(policy, included, environment, training=training, half=True)


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    lines = [
        "| policy | scenarios | success (%) | collision (%) | SOC | regret, pose reached (%) | unknown |",
        "|---|---|---|---|---|---|---|",
    ]
    for path in sorted(results.glob("*.jsonl.gz"), key=lambda path: path.name.partition(".")[0]):
        for name, (evaluation,) in read_episodes(path).items():
            families = list(dict.fromkeys(episode.family for episode in evaluation))
            for family in families:
                episodes = tuple(episode for episode in evaluation if episode.family == family)
                row = score(name, replace(evaluation, episodes=episodes))
                label = f"`{name}`" if len(families) == 1 else f"`{name}` on {family}"
                label = f"`{HARD[name]}`, hard obstacles" if name in HARD else label
                lines.append(f"| {label} | {row.episodes:,} | {markdown_cells(row)} | {row.unknown} |")
    return {"included-policies": "\n".join(lines) + "\n"}


def main() -> None:
    """Train and score the named policies."""
    arguments = read_arguments(__doc__, NAMES, HERE, train="train the policies first, and include them")
    tiny, count = arguments.tiny, 4 if arguments.tiny else SCENARIOS
    for name in arguments.names:
        policy = HARD.get(name, name)
        is_trained = arguments.train and name not in HARD
        folder = arguments.results / "policies" if tiny and is_trained else INCLUDED
        settings = HERE / "configurations" / f"{policy}.json"
        _, config = read_config(settings)
        assert isinstance(config, DAggerRunConfig)
        if is_trained:
            run = train(settings, arguments.runs / "included_policies" / name, tiny=tiny)
            include(run, folder / name, average=name in AVERAGED)
        obstacles = "hard" if name in HARD else config.obstacles
        task = {"robot": config.robot, "horizon": config.horizon, "obstacles": obstacles}
        banks = [fresh_bank(arguments.runs, one, count, tiny=tiny, **task) for one in families_of(config.family)]
        play([load(folder / policy)], banks, arguments.results, name, progress=not tiny)
    print(tables(arguments.results)["included-policies"])


if __name__ == "__main__":
    main()
