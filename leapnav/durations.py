"""Estimates of the durations of long commands, printed before they start.

The rates are rounded from runs on two cores without a GPU, those of scenarios partly from the time of the search alone.
They differ by a factor of about 2 between machines.
"""

from __future__ import annotations

from collections.abc import Sequence

from leapnav.training.config import DEFAULT_EPOCHS, BCConfig, DAggerRunConfig, PPOConfig, RunConfig, SACConfig

# Seconds of one core to find, execute and store the optimum of a scenario.
SECONDS_PER_SCENARIO = {
    "open": 0.03,
    "clutter": 0.05,
    "polygons": 0.06,
    "rooms": 0.08,
    "slalom": 0.15,
    "maze": 0.4,
    "corridors": 0.4,
    "all": 0.08,
}
SECONDS_PER_SECOND_OPINION = 4.0
SECONDS_PER_EXPERT_EPISODE, SECONDS_PER_EPISODE = 0.1, 0.01  # of an evaluation
SECONDS_OF_DEMO = 300.0
SAMPLES_PER_SCENARIO, CLONED_SAMPLES_PER_SECOND = 170, 40_000
SECONDS_PER_DAGGER_ROUND = 300.0
PPO_STEPS_PER_SECOND, SAC_STEPS_PER_SECOND = 3_000, 20
MIN_ANNOUNCED = 60.0  # s; shorter work is not announced


def announce(seconds: float, what: str) -> None:
    """Print an estimate of the duration of some work, if it is more than a minute."""
    if seconds >= MIN_ANNOUNCED:
        print(f"{what} takes about {in_words(seconds)}; the progress bar has a better estimate", flush=True)


def in_words(seconds: float) -> str:
    """Return a duration in minutes or hours, rounded to one or two digits."""
    minutes = seconds / 60
    if minutes >= 90:
        return f"{minutes / 60:.2g} hours"
    return f"{minutes:.0f} min" if minutes >= 1.5 else "1 min"


def of_scenarios(family: str, count: int, workers: int) -> float:
    """Return the duration of finding the optima of `count` scenarios (s)."""
    return SECONDS_PER_SCENARIO.get(family, 0.08) * count / max(workers, 1)


def of_evaluation(policies: Sequence[str], count: int) -> float:
    """Return the duration of an evaluation of policies, given by their names, on `count` scenarios (s)."""
    n_experts = sum(name.rpartition("=")[2] == "expert" for name in policies)
    return count * (n_experts * SECONDS_PER_EXPERT_EPISODE + (len(policies) - n_experts) * SECONDS_PER_EPISODE)


def of_training(config: RunConfig, workers: int) -> float:
    """Return the duration of a training run, without that of its final evaluation (s)."""
    if isinstance(config, (BCConfig, DAggerRunConfig)):
        epochs = config.cloning.epochs or DEFAULT_EPOCHS
        samples = config.scenarios * SAMPLES_PER_SCENARIO * epochs
        seconds = samples / CLONED_SAMPLES_PER_SECOND
        if not config.demos:
            seconds += of_scenarios(config.family, config.scenarios, workers)
        return seconds + (config.dagger.rounds * SECONDS_PER_DAGGER_ROUND if isinstance(config, DAggerRunConfig) else 0)
    if isinstance(config, PPOConfig):
        return config.total_timesteps / PPO_STEPS_PER_SECOND
    return config.total_timesteps / SAC_STEPS_PER_SECOND if isinstance(config, SACConfig) else 0.0
