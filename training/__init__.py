"""Learning from the optimum, and the score that says how near a policy comes to it."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leapnav.training.cloning import EpochLoss, behaviour_clone
    from leapnav.training.config import CloningConfig
    from leapnav.training.evaluation import (
        Episode,
        Interval,
        Policy,
        RandomPolicy,
        Score,
        evaluate,
        run_episodes,
        score,
    )
    from leapnav.training.policies import NavigationFeatures, load_policy, make_policy, save_policy
    from leapnav.training.vec_env import NavigateVecEnv, make_vec_env

__all__ = [
    "CloningConfig",
    "Episode",
    "EpochLoss",
    "Interval",
    "NavigateVecEnv",
    "NavigationFeatures",
    "Policy",
    "RandomPolicy",
    "Score",
    "behaviour_clone",
    "evaluate",
    "load_policy",
    "make_policy",
    "make_vec_env",
    "run_episodes",
    "save_policy",
    "score",
]

# Loaded when first used: torch takes seconds, which `leapnav solve` and `leapnav --help` need not spend.
_MODULES = {
    "cloning": ("EpochLoss", "behaviour_clone"),
    "config": ("CloningConfig",),
    "evaluation": ("Episode", "Interval", "Policy", "RandomPolicy", "Score", "evaluate", "run_episodes", "score"),
    "policies": ("NavigationFeatures", "load_policy", "make_policy", "save_policy"),
    "vec_env": ("NavigateVecEnv", "make_vec_env"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"leapnav.training.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
