"""Draw the overview figure of the README: Leapfrog's sweeps, the optimum and a learned policy; scores of policies.

python scripts/draw_overview.py            # writes docs/images/overview.png
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from leapnav.envs import NavigateEnv, Scenario, ScenarioBank
from leapnav.envs.episodes import act_with, play_episode
from leapnav.envs.utils.colors import OPTIMUM, POLICY
from leapnav.experts import Trajectory, find_optimum, solve
from leapnav.experts.plotting.scenes import draw_robot, draw_scenario
from leapnav.experts.solvers.feasible_path import dense_path
from leapnav.training import load_policy, policy_environment, read_episodes

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "images" / "overview.png"
SWEEPS = (0, 16, 48, 96, 160)
FAMILY = "clutter"
STUDIES = Path(__file__).resolve().parent.parent / "studies"
# Results on the test split of the family, from the studies.
RESULTS = {
    "go-to-goal": "planners/results/go-to-goal.jsonl.gz",
    "PPO from scratch,\n0.5 M steps": "methods/results/clutter-ppo.jsonl.gz",
    "MPPI on the map": "planners/results/mppi.jsonl.gz",
    "clone, lidar": "methods/results/clutter-bc.jsonl.gz",
    "DAgger, lidar": "transfer/results/clutter-lidar.jsonl.gz",
    "DAgger, geodesic": "transfer/results/clutter.jsonl.gz",
}
INDEX = 150  # in the test bank
VIA_POINTS = [(0.9, 6.3), (3.6, 6.1), (6.2, 6.5)]  # m, of an initial guess that is far from the optimum


def success_weighted_by_cost(path: Path) -> float:
    """Return the mean SOC of the runs in a file of results, in the scenarios of the family."""
    runs = next(iter(read_episodes(path).values()))
    parts = [tuple(episode for episode in run if episode.family == FAMILY) for run in runs]
    return float(np.mean([replace(run, episodes=part).soc for run, part in zip(runs, parts, strict=True)]))


def initial_guess(scenario: Scenario) -> Trajectory:
    """Return straight lines through the via-points at constant speed, with headings along the path."""
    corners = np.array([scenario.start[:2], *VIA_POINTS, scenario.goal[:2]])
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    distances = np.linspace(0.0, lengths[-1], 65)
    points = np.stack([np.interp(distances, lengths, column) for column in corners.T], axis=1)
    headings = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    headings[[0, -1]] = scenario.start[2], scenario.goal[2]
    return Trajectory(np.linspace(0.0, scenario.horizon, 65), np.column_stack([points, np.unwrap(headings)]))


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=PICTURE, help="output file")
    arguments = parser.parse_args()
    scenario = ScenarioBank.shipped(FAMILY, "test")[INDEX]
    optimum = find_optimum(scenario)
    figure = Figure(figsize=(11, 4.9), layout="constrained")
    plane, bars = figure.subplots(1, 2, width_ratios=(1.5, 1))
    draw_scenario(plane, scenario)
    leapfrog = solve(scenario, "leapfrog", guess=initial_guess(scenario), polish=False)
    rows = [row for row in leapfrog.history if row.times is not None]
    shown = [k for k in SWEEPS if k < len(rows)]
    for k, color in zip(shown, colormaps["viridis_r"](np.linspace(0.1, 0.8, len(shown))), strict=True):
        times, nodes = rows[k].times, rows[k].nodes
        assert times is not None and nodes is not None
        _, states = dense_path(leapfrog.problem, times, nodes, 400)
        plane.plot(states[:, 0], states[:, 1], color=color, linewidth=1.2, label=f"Leapfrog, iteration {k}")
        plane.plot(nodes[:, 0], nodes[:, 1], ".", color=color, markersize=3)
    path = optimum.interpolate(np.linspace(0.0, scenario.horizon, 400))
    plane.plot(path[:, 0], path[:, 1], color=OPTIMUM, linewidth=2.5, label=f"optimum, J* = {optimum.cost:.3f}")
    env = NavigateEnv(scenario=scenario, **policy_environment("clutter"))
    _, info, steps = play_episode(env, act_with(load_policy("clutter")), seed=0)
    poses = [scenario.start]
    for step in steps:
        info = step.info
        poses.append(info["pose"])
    driven = np.array(poses)
    label = f"learned policy, J = {info['cost']:.3f}"
    plane.plot(driven[:, 0], driven[:, 1], "--", color=POLICY, linewidth=1.8, label=label)
    for fraction in np.linspace(0.0, 1.0, 9)[1:-1]:
        pose = path[round(fraction * 399), :3]
        draw_robot(plane, pose, scenario.outline, OPTIMUM, alpha=0.5)
    plane.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=9)
    plane.set_title("Leapfrog finds a local optimum, the search the best one", fontsize=10)
    scores = {name: success_weighted_by_cost(STUDIES / file) for name, file in RESULTS.items()} | {"optimum": 1.0}
    names = list(scores)
    colors = ["#b9bec6"] * (len(names) - 1) + [OPTIMUM]
    drawn = bars.barh(names, list(scores.values()), color=colors)
    bars.bar_label(drawn, fmt="%.2f", padding=4, fontsize=9)
    bars.set_xlim(0.0, 1.15)
    bars.spines[["top", "right"]].set_visible(False)
    bars.set_title("Success weighted by optimal cost,\n200 unseen scenarios", fontsize=10)
    figure.savefig(arguments.out, dpi=130)
    print(f"wrote {arguments.out}: success {info['is_success']}, SOC {scores}")


if __name__ == "__main__":
    main()
