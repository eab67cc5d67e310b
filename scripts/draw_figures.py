"""Draw the figures of the README and the documentation that show scenarios, optima and episodes.

python scripts/draw_figures.py            # writes docs/images/*.png, except overview, play, decisions and curricula
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from leapnav.envs import (
    Car,
    Circle,
    DifferentialDrive,
    DynamicCar,
    DynamicUnicycle,
    NavigateEnv,
    Obstacle,
    Scenario,
    ScenarioBank,
    Trailer,
    Unicycle,
    sample_scenario,
)
from leapnav.envs.scenarios.families import ALL_FAMILIES
from leapnav.envs.utils.colors import OPTIMUM
from leapnav.experts import ExpertPolicy, find_optimum, lower_bound, plot_extremal, solve
from leapnav.experts.bounds.plotting import plot_tube
from leapnav.experts.plotting.animation import plot_moments
from leapnav.experts.plotting.scenes import draw_robot, draw_scenario
from leapnav.training import evaluate, load_policy, plot_episodes, policy_environment

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
ROBOT_SCENARIOS = (("clutter", 11), ("rooms", 12), ("open", 4))  # families and seeds
FAMILY_ROWS, FAMILY_INDICES = 3, (0, 1, 2)
TUBE = 1  # index in the test bank of clutter
# Family, index in the test bank, and number of steps of the expert, of the three frames.
FRAMES = (("clutter", 7, 124), ("polygons", 0, 110), ("slalom", 0, 364))


def draw_families() -> None:
    """Draw three test scenarios of each family with their optima."""
    figure = Figure(figsize=(10.4, 6.5), layout="constrained")
    axes = figure.subplots(FAMILY_ROWS, len(ALL_FAMILIES))
    for column, family in enumerate(ALL_FAMILIES):
        bank = ScenarioBank.shipped(family, "test")
        axes[0, column].set_title(family)
        for row, index in enumerate(FAMILY_INDICES):
            draw_scenario(axes[row, column], bank[index])
            axes[row, column].plot(*bank.states(index)[:, :2].T, color=OPTIMUM, linewidth=1.5)
    figure.savefig(IMAGES / "families.png", dpi=100)


def draw_robots() -> None:
    """Draw three scenarios with the optima of each robot."""
    for model in (Unicycle, DifferentialDrive, Car, DynamicCar, DynamicUnicycle, Trailer):
        figure = Figure(figsize=(9.6, 3.3), layout="constrained")
        for axes, (family, seed) in zip(figure.subplots(1, 3), ROBOT_SCENARIOS, strict=True):
            scenario = sample_scenario(family, seed, model())
            optimum = find_optimum(scenario)
            draw_scenario(axes, scenario)
            for pose in optimum.evaluate(np.linspace(0.0, scenario.horizon, 12))[0][1:-1]:
                draw_robot(axes, pose, scenario.outline, OPTIMUM, alpha=0.3)
            axes.plot(*optimum.states[:, :2].T, color=OPTIMUM, linewidth=1.5)
            axes.set_title(f"{family}, J = {optimum.cost:.2f}")
        figure.savefig(IMAGES / f"robot_{model.name()}.png", dpi=100)


def draw_before_or_behind() -> None:
    """Draw the two optima of a disc that crosses the way, over time."""
    disc = Obstacle(circle=Circle(center=(5.0, 1.4), radius=0.6), velocity=(0.0, 0.8))
    street = Scenario(name="street", arena=(0, 2, 10, 8), start=(1, 5, 0), goal=(9, 5, 0), horizon=8, obstacles=(disc,))
    best = find_optimum(street)
    other = next(one for one in best.alternatives if one.path_class != best.path_class)
    by_side = {one.path_class[0]: one for one in (best, other)}
    # In front of the disc, which comes from the right: it passes on the right.
    plots = {"before": by_side["right"], "behind": by_side["left"]}
    titles = [f"{name}: J = {one.cost:.2f}" for name, one in plots.items()]
    plot_moments(street, list(plots.values()), IMAGES / "before_or_behind.png", titles=titles)


def draw_frames() -> None:
    """Draw frames of three episodes of the expert in progress."""
    frames = []
    for family, index, steps in FRAMES:
        env = NavigateEnv(family, split="test", render_mode="rgb_array", show_optimum=True)
        observation, _ = env.reset(options={"index": index})
        expert = ExpertPolicy(env)
        for _ in range(steps):
            observation, *_ = env.step(expert.predict(observation)[0])
        frame = env.render()
        assert frame is not None
        frames.append(frame)
    figure = Figure(figsize=(18, 6.4))
    figure.figimage(np.concatenate(frames, axis=1))
    figure.savefig(IMAGES / "frames.png", dpi=100)


def main() -> None:
    """Write all figures."""
    draw_families()
    draw_robots()
    draw_frames()
    scenario = sample_scenario("clutter", 910065)
    plot_extremal(find_optimum(scenario), IMAGES / "solution.png", scenario)
    scenario = sample_scenario("clutter", 9)
    draw_before_or_behind()
    plot_extremal(solve(scenario, method="leapfrog", polish=False), IMAGES / "leapfrog.png", scenario)
    bank = ScenarioBank.shipped("clutter", "test")
    optimum = find_optimum(bank[TUBE])
    plot_tube(lower_bound(bank[TUBE], optimum, time_limit=600.0), IMAGES / "tube.png", optimum)
    evaluation = evaluate(load_policy("clutter"), bank, environment=policy_environment("clutter"), timed=False)
    plot_episodes([bank], evaluation.episodes, IMAGES / "episodes.png")


if __name__ == "__main__":
    main()
