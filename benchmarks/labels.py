"""Labels of DAgger per second, compared with the expert as a policy in the environment, on the same takeovers.

    python benchmarks/labels.py [--episodes N] [--families NAME...]

Takeovers are at random times of episodes in which the go-to-goal policy collides. "in the environment": the expert
drives for 3 s and re-solves at each step, as DAgger did before. "along the optimum": the states of the optimum are
labelled (`leapnav.training.learning.takeovers`). The ratio is that of the times; both have the same number of labels.
One process, one thread.
"""

import argparse
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from leapnav.envs import NavigateEnv, Scenario, ScenarioBank
from leapnav.envs.episodes import play_episode
from leapnav.envs.settings import EnvironmentSettings
from leapnav.experts import ExpertPolicy, find_optimum
from leapnav.experts.acting.policy import NoOptimumError
from leapnav.training import GoToGoal, evaluate
from leapnav.training.learning.takeovers import MIN_TIME_LEFT, Labeller

FAMILIES = ("clutter", "polygons", "rooms", "slalom")
LEAD = 3.0  # s
SETTINGS = EnvironmentSettings(lidar_beams=128)
AGREEMENT = 0.02  # largest difference of the median action


def takeovers(family: str, count: int) -> list[Scenario]:
    """Return the rests of episodes of the go-to-goal policy from random times on, that have an optimum."""
    bank = ScenarioBank.shipped(family, "train")
    rng, found = np.random.default_rng(0), []
    for episode in evaluate(GoToGoal, bank, timed=False, progress=False):
        if len(found) == count:
            break
        scenario, step = bank[episode.index], int(rng.integers(1, len(episode.states) - 1))
        assert scenario.horizon is not None
        left = round(scenario.horizon - step * SETTINGS.control_period, 9)
        if episode.success or left < MIN_TIME_LEFT + LEAD:
            continue
        rest = scenario.model_copy(update={"start": tuple(episode.states[step].tolist()), "horizon": left})
        if find_optimum(rest, "low").success:
            found.append(rest)
    return found


def in_the_environment(env: NavigateEnv, scenario: Scenario) -> list[np.ndarray]:
    """Return the actions of the expert, which drives in the environment."""
    expert, actions = ExpertPolicy(env, effort="low", workers=1), []

    def act(observation, info):
        if info["time"] >= LEAD - 1e-9:
            return None
        actions.append(expert.predict(observation)[0])
        expert.labels()
        return actions[-1]

    try:
        for _ in play_episode(env, act, options={"scenario": scenario})[2]:
            pass
    except NoOptimumError:
        return []
    return actions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--families", nargs="*", choices=FAMILIES, default=FAMILIES)
    arguments = parser.parse_args()
    table = Table(title="labels per second of one core")
    for column in ("family", "takeovers", "labels", "in the environment", "along the optimum", "ratio"):
        table.add_column(column, justify="left" if column == "family" else "right")
    for family in arguments.families:
        scenarios = takeovers(family, arguments.episodes)
        env, labeller = NavigateEnv(split="fresh", lidar_beams=128), Labeller(SETTINGS, LEAD, "low")
        driven = labelled = 0.0
        count = 0
        for scenario in scenarios:
            start = time.perf_counter()
            actions = in_the_environment(env, scenario)
            middle = time.perf_counter()
            samples = labeller.samples(scenario, find_optimum(scenario, "low"))
            end = time.perf_counter()
            assert len(actions) == len(samples)
            assert np.median(np.abs(samples.actions - np.array(actions))) < AGREEMENT
            driven, labelled, count = driven + middle - start, labelled + end - middle, count + len(samples)
        cells = f"{count / driven:,.0f}", f"{count / labelled:,.0f}", f"{driven / labelled:.2f}"
        table.add_row(family, str(len(scenarios)), str(count), *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
