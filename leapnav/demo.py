"""`leapnav demo`: the whole way, from random scenarios to the score of a learned policy."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.console import Console

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.navigation import NavigateEnv
from leapnav.experts.rollouts import rollout
from leapnav.training.cloning import behaviour_clone
from leapnav.training.config import CloningConfig
from leapnav.training.contest import contest
from leapnav.training.dataset import Dataset
from leapnav.training.entrants import load_entrant
from leapnav.training.policies import SHIPPED, make_policy, save_policy, shipped_policies
from leapnav.training.reports import plot_episodes, plot_scores, print_scores, write_scores


@dataclass(frozen=True)
class DemoSettings:
    """What the demo does; written beside its results."""

    family: str = "clutter"
    training_scenarios: int = 1000
    training_seed: int = 1000
    recoveries: int = 4
    lidar_beams: int = 128
    test_scenarios: int = 200
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
    demonstrations, folder = out / "demonstrations", out / "policy"
    if any(demonstrations.glob("**/metadata.json")):
        console.print(f"Using {demonstrations}")
    else:
        rollout(
            settings.family,
            settings.training_scenarios,
            demonstrations,
            seed=settings.training_seed,
            recoveries=settings.recoveries,
            workers=settings.workers,
        )
    if (folder / "policy.json").exists():
        console.print(f"Using {folder}")
    else:
        env = NavigateEnv(settings.family, lidar_beams=settings.lidar_beams)
        policy = make_policy(env.observation_space, env.action_space, settings.cloning.seed)
        behaviour_clone(policy, Dataset.of(demonstrations).observed(env.settings), settings.cloning)
        save_policy(policy, folder, {"lidar_beams": settings.lidar_beams})

    names = ["expert"]
    if settings.family in shipped_policies():
        names.append(f"shipped={SHIPPED / settings.family}")
    entrants = [load_entrant(name) for name in (*names, f"clone={folder}", "go-to-goal", "random")]
    bank = ScenarioBank.shipped(settings.family, "test")
    found = contest(entrants, [bank], count=settings.test_scenarios)
    write_scores(found, out / "scores.json")
    plot_scores(found, out / "scores.png")
    plot_episodes([bank], found.runs["clone"][0].episodes, out / "episodes.png")
    print_scores(found, console)
    console.print(f"Results in {out}:")
    for name, what in (
        ("demonstrations", "the training data, a Minari dataset"),
        ("policy", "the clone"),
        ("scores.json", "the table, and every episode"),
        ("scores.png", "the table as a picture, and the performance profiles"),
        ("episodes.png", "test scenarios: the optimum dashed, the clone's path in blue, red where it failed"),
    ):
        console.print(f"  {name:<15} {what}", soft_wrap=True)
