"""`leapnav demo`: every step from random scenarios to the score of a learned policy."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from leapnav.training.fit_settings import CloningConfig

RESULTS = (
    ("demonstrations", "training data, a Minari dataset"),
    ("policy", "the clone"),
    ("scores.json", "the table, and every episode"),
    ("scores.png", "picture of the table, and the performance profiles"),
    ("episodes.png", "test scenarios: the optimum dashed, the clone's path blue (success) or red (failure)"),
)


@dataclass(frozen=True)
class Demo:
    """Run every step on clutter scenarios: optima, demonstrations, a clone, and its score against the optimum."""

    out: Path = Path("runs/demo")
    """Output directory; existing results in it are used again."""

    resumption = "the same command resumes; finished steps are not repeated"

    def run(self) -> int:
        """Run the demo."""
        run_demo(self.out)
        return 0


@dataclass(frozen=True)
class DemoSettings:
    """Settings of the demo, stored with its results."""

    family: str = "clutter"
    training_scenarios: int = 1000
    training_seed: int = 1000
    recoveries: int = 2
    lidar_beams: int = 64
    test_scenarios: int = 100
    workers: int = 2
    # Half of the default number: the fit is the longest step of the demo.
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(epochs=6))


def run_demo(out: Path, settings: DemoSettings | None = None) -> None:
    """Run the demo and print the scores. Steps whose results exist are not repeated.

    Args:
        out: output directory.
        settings: see `DemoSettings`; None for its defaults.

    Raises:
        ValueError: the directory contains results of other settings.

    """
    from rich.console import Console

    from leapnav.envs.scenarios.bank import ScenarioBank
    from leapnav.envs.utils.files import write_text
    from leapnav.envs.utils.json_utils import encode
    from leapnav.training.policies.files import SHIPPED, shipped_policies
    from leapnav.training.scoring.comparison import compare_policies
    from leapnav.training.scoring.policy_specs import load_policy_spec
    from leapnav.training.scoring.reports import plot_episodes, plot_scores, print_scores, write_scores

    settings = settings or DemoSettings()
    out.mkdir(parents=True, exist_ok=True)
    record, content = out / "settings.json", encode(asdict(settings), indent=1) + "\n"
    if record.exists() and record.read_text(encoding="utf-8") != content:
        raise ValueError(f"{out}: contains results of other settings; remove it or choose another directory")
    write_text(record, content)

    console = Console()
    demonstrations, policy = out / "demonstrations", out / "policy"
    if any(demonstrations.glob("**/metadata.json")):
        console.print(f"Using {demonstrations}")
    else:
        _demonstrate(settings, demonstrations)
    if (policy / "policy.json").exists():
        console.print(f"Using {policy}")
    else:
        _clone(settings, demonstrations, policy)

    names = ["expert"]
    if settings.family in shipped_policies():
        names.append(f"shipped={SHIPPED / settings.family}")
    specs = [load_policy_spec(name) for name in (*names, f"clone={policy}", "go-to-goal", "random")]
    bank = ScenarioBank.shipped(settings.family, "test")
    comparison = compare_policies(specs, [bank], count=settings.test_scenarios)
    write_scores(comparison, out / "scores.json")
    plot_scores(comparison, out / "scores.png")
    plot_episodes([bank], comparison.runs["clone"][0].episodes, out / "episodes.png")
    print_scores(comparison)
    console.print(f"Results in {out}:")
    for name, description in RESULTS:
        console.print(f"  {name:<15} {description}", soft_wrap=True)


def _demonstrate(settings: DemoSettings, out: Path) -> None:
    from leapnav.experts.data.rollouts import rollout

    rollout(
        settings.family,
        settings.training_scenarios,
        out,
        seed=settings.training_seed,
        recoveries=settings.recoveries,
        workers=settings.workers,
    )


def _clone(settings: DemoSettings, demonstrations: Path, out: Path) -> None:
    from leapnav.envs.navigation import NavigateEnv
    from leapnav.training.learning.cloning import behaviour_clone
    from leapnav.training.learning.dataset import Dataset
    from leapnav.training.policies.files import save_policy
    from leapnav.training.policies.network import make_policy

    env = NavigateEnv(settings.family, lidar_beams=settings.lidar_beams)
    policy = make_policy(env.observation_space, env.action_space, settings.cloning.seed)
    behaviour_clone(policy, Dataset.of(demonstrations).observed(env.settings), settings.cloning)
    save_policy(policy, out, {"lidar_beams": settings.lidar_beams})
