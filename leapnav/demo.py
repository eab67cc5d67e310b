"""`leapnav demo`: the whole way, from random scenarios to the score of a learned policy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import gymnasium as gym
from rich.console import Console

from leapnav.experts.demonstrations import load_demonstrations
from leapnav.experts.rollouts import rollout
from leapnav.training.cloning import behaviour_clone
from leapnav.training.config import CloningConfig
from leapnav.training.evaluation import evaluate
from leapnav.training.policies import make_policy, save_policy
from leapnav.training.reports import plot_gallery, print_scores, write_scores


@dataclass(frozen=True)
class DemoSettings:
    """What the demo does; written beside its results."""

    family: str = "clutter"
    training_scenarios: int = 1000
    training_seed: int = 0
    recoveries: int = 4
    test_scenarios: int = 200
    test_seed: int = 1_000_000
    workers: int = 2
    cloning: CloningConfig = field(default_factory=CloningConfig)


def run_demo(out: Path, settings: DemoSettings | None = None) -> None:
    """Runs the demo into a folder and prints the table; steps whose results are there already are not repeated.

    Raises:
        ValueError: the folder holds the results of other settings.

    """
    settings = settings or DemoSettings()
    out.mkdir(parents=True, exist_ok=True)
    record, now = out / "settings.json", json.dumps(asdict(settings), indent=1) + "\n"
    if record.exists() and record.read_text() != now:
        raise ValueError(f"{out}: holds the results of other settings; remove it or choose another folder")
    record.write_text(now)

    console = Console()
    training, test, policy_folder = out / "demonstrations", out / "references", out / "policy"
    for folder, count, seed, recoveries in (
        (training, settings.training_scenarios, settings.training_seed, settings.recoveries),
        (test, settings.test_scenarios, settings.test_seed, 0),
    ):
        if any(folder.glob("**/metadata.json")):
            console.print(f"Using {folder}")
        else:
            rollout(settings.family, count, folder, seed=seed, recoveries=recoveries, workers=settings.workers)
    if (policy_folder / "policy.json").exists():
        console.print(f"Using {policy_folder}")
    else:
        env = gym.make("leapnav/Navigate-v0", family=settings.family)
        policy = make_policy(env.observation_space, env.action_space, settings.cloning.seed)
        behaviour_clone(policy, load_demonstrations(training), settings.cloning)
        save_policy(policy, policy_folder, {"id": "leapnav/Navigate-v0"})

    references = load_demonstrations(test)
    names = {"expert": "expert", str(policy_folder): "clone", "random": "random"}
    scores, episodes = evaluate(list(names), references)
    table = [type(row)(**{**row.__dict__, "policy": names[row.policy]}) for row in scores]
    played = {names[name]: found for name, found in episodes.items()}
    write_scores(table, played, out / "scores.json")
    plot_gallery(references[:8], played["clone"][:8], out / "episodes.png")
    print_scores(table, console)
    console.print(f"Results in {out}:")
    for name, what in (
        ("demonstrations", "the training data, a Minari dataset"),
        ("references", "the test scenarios with their optima, a Minari dataset"),
        ("policy", "the clone"),
        ("scores.json", "the table, and every episode"),
        ("episodes.png", "test scenarios: the optimum dashed, the clone's path in blue, red where it failed"),
    ):
        console.print(f"  {name:<15} {what}", soft_wrap=True)
