import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from helpers import best_known, published_problems
from matplotlib.image import imread

from leapnav.experts import ControlAffineSystem, OptimalControlProblem, solve
from leapnav.experts.plotting.extremals import MAX_SWEEPS, plot_extremal, plot_solution
from leapnav.experts.problem.certificate import failure
from leapnav.experts.problem.extremal import Status

SCENARIOS = {scenario.name: scenario for scenario, _ in best_known()}
OVER_TIME = ["states", "controls", "costates", "Hamiltonian"]


@pytest.fixture(scope="module")
def swept():
    """A scenario and its Leapfrog solve, whose history is sweeps to the end."""
    scenario = SCENARIOS["clutter-9"]
    return scenario, solve(scenario, method="leapfrog", polish=False)


def axes_of(figure):
    return {axes.get_ylabel(): axes for axes in figure.axes}


def labelled(axes):
    return {line.get_label(): line for line in axes.get_lines() if not line.get_label().startswith("_")}


def sweep_paths(axes):
    return [line for label, line in labelled(axes).items() if label.startswith("sweep ")]


def test_a_leapfrog_solve_shows_the_plane_its_sweeps_and_their_costs(swept):
    scenario, extremal = swept
    figure = plot_extremal(extremal, scenario=scenario)
    axes = axes_of(figure)
    assert list(axes) == ["", "$|J_k - J|$", "segments", *OVER_TIME]
    paths = sweep_paths(axes[""])
    assert len(extremal.history) > len(paths) == MAX_SWEEPS
    numbers = [int(line.get_label().split()[1]) for line in paths]
    assert numbers[:4] == [0, 1, 2, 3]
    assert numbers[-1] == len(extremal.history) - 1
    # From light to dark.
    lightness = [np.dot(line.get_color()[:3], (0.3, 0.6, 0.1)) for line in paths]
    assert lightness == sorted(lightness, reverse=True)
    costs = labelled(axes["$|J_k - J|$"])
    assert len(costs["nodes removed"].get_xdata()) == sum(row.phase == "reduce" for row in extremal.history)
    falling = costs["sweep (colour of its path)"].get_ydata()
    assert len(falling) == len(extremal.history)
    assert falling[0] == pytest.approx(extremal.history[0].cost - extremal.cost)
    assert np.diff(falling).max() <= 1e-10
    assert axes[""].get_aspect() == 1.0
    assert scenario.name in figure.get_suptitle()


def test_a_failure_that_ended_above_its_sweeps_shows_their_costs_as_they_are(swept):
    failed = replace(swept[1], status=Status.STALLED, cost=swept[1].cost + 0.1)
    axes = axes_of(plot_extremal(failed))["$J_k$"]
    assert axes.get_yscale() == "linear"
    costs = labelled(axes)["sweep (colour of its path)"].get_ydata()
    assert list(costs) == [row.cost for row in failed.history]


def test_the_drawn_sweeps_are_feasible_and_end_in_the_extremal(swept):
    scenario, extremal = swept
    axes = axes_of(plot_extremal(extremal, scenario=scenario))[""]
    paths = sweep_paths(axes)
    for line in paths:
        row = extremal.history[int(line.get_label().split()[1])]
        points = line.get_xydata()
        # The arcs are connected without defects, and all nodes lie on them.
        speed = np.linalg.norm(np.diff(points, axis=0), axis=1).max() / (scenario.horizon / len(points))
        assert speed < 2 * scenario.robot.max_speed
        for node in row.nodes[:, :2]:
            assert np.linalg.norm(points - node, axis=1).min() < 1e-6
    known = extremal.evaluate(np.linspace(0, scenario.horizon, 50))[0][:, :2]
    last = paths[-1].get_xydata()
    assert max(np.linalg.norm(last - point, axis=1).min() for point in known) < 0.05


def test_the_polished_solve_shows_newton_after_the_sweeps():
    scenario = SCENARIOS["clutter-0"]
    extremal = solve(scenario, method="leapfrog")
    axes = axes_of(plot_extremal(extremal, scenario=scenario))
    phases = [row.phase for row in extremal.history]
    assert len(sweep_paths(axes[""])) == phases.count("sweep")
    steps = labelled(axes["$|J_k - J|$"])["Newton step"]
    assert list(steps.get_xdata()) == [k for k, phase in enumerate(phases) if phase == "newton"]


@pytest.mark.parametrize("polish", [True, False])
@pytest.mark.parametrize("name", published_problems())
def test_every_published_problem_can_be_drawn(name, polish):
    problem = published_problems()[name][0]
    extremal = solve(problem, method="leapfrog", polish=polish)
    axes = axes_of(plot_extremal(extremal))
    assert set(OVER_TIME) < set(axes)
    for panel, names in (("states", problem.system.state), ("controls", problem.system.fields)):
        assert len(labelled(axes[panel])) == len(names)
    first, second = (f"${sp.latex(symbol)}$" for symbol in problem.system.state[:2])
    assert axes[second].get_xlabel() == first
    assert labelled(axes["costates"]).keys() == {rf"$\lambda_{{{sp.latex(s)}}}$" for s in problem.system.state}
    assert sweep_paths(axes[second])


def test_a_method_without_sweeps_and_a_system_without_a_position_leave_four_panels():
    problem = published_problems()["double-integrator-energy"][0]
    extremal = solve(problem, method="multiple_shooting")
    axes = axes_of(plot_extremal(extremal))
    assert list(axes) == OVER_TIME
    # u = 6 - 12 t
    line = labelled(axes["controls"])["$u_{1}$"]
    assert len(line.get_xdata()) >= 400
    assert line.get_ydata() == pytest.approx(6 - 12 * line.get_xdata(), abs=1e-6)
    line = labelled(axes["costates"])[r"$\lambda_{x}$"]
    assert line.get_ydata() == pytest.approx(-12.0)


def test_a_system_of_one_state_is_drawn_over_time():
    x = sp.Symbol("x")
    system = ControlAffineSystem(state=(x,), drift=(-x,), fields=((1,),))
    problem = OptimalControlProblem(
        system, start=(0,), goal=(1,), horizon=1.0, control_weight=(1,), control_bounds=((-np.inf, 4.0),)
    )
    axes = axes_of(plot_extremal(solve(problem, method="leapfrog")))
    assert axes["$x$"].get_xlabel() == "time"
    bounds = [line for line in axes["controls"].get_lines() if np.ptp(line.get_ydata()) == 0]
    assert [line.get_ydata()[0] for line in bounds] == [4.0]


def test_the_hamiltonian_is_drawn_about_its_mean(swept):
    axes = axes_of(plot_extremal(swept[1]))["Hamiltonian"]
    hamiltonian = swept[1].hamiltonian
    (label,) = labelled(axes)
    line = labelled(axes)[label]
    assert line.get_ydata() + hamiltonian.mean() == pytest.approx(hamiltonian, abs=1e-14)
    assert float(label.split("=")[1].strip("$ ")) == pytest.approx(hamiltonian.mean(), rel=1e-4)
    low, high = axes.get_ylim()
    assert low == -high
    assert high >= max(1e-9, np.abs(line.get_ydata()).max())


def test_rounding_does_not_fill_the_axes_of_the_hamiltonian():
    extremal = solve(published_problems()["double-integrator-energy"][0], method="multiple_shooting")
    assert extremal.certificate.hamiltonian_drift < 1e-10
    assert axes_of(plot_extremal(extremal))["Hamiltonian"].get_ylim()[1] >= 1e-9


def test_obstacles_and_bounds_are_drawn_without_the_scenario_too(swept):
    scenario, extremal = swept
    axes = axes_of(plot_extremal(extremal))
    plane, controls = axes["$y$ (m)"], axes["controls"]
    filled = plane.collections[0].get_paths()
    (x_min, x_max), (y_min, y_max) = plane.get_xlim(), plane.get_ylim()
    centers = [obstacle.circle.center for obstacle in scenario.obstacles]
    visible = [(x, y) for x, y in centers if x_min < x < x_max and y_min < y < y_max]
    assert visible
    for center in visible:
        assert any(path.contains_point(center) for path in filled)
    assert not any(path.contains_point(point) for path in filled for point in extremal.states[:, :2])
    drawn = {line.get_ydata()[0] for line in controls.get_lines() if np.ptp(line.get_ydata()) == 0}
    v, omega = scenario.robot.max_speed, scenario.robot.max_turn_rate
    assert drawn == {-v, v, -omega, omega}


def test_pictures_are_written_with_their_title(swept, tmp_path):
    scenario, extremal = swept
    assert plot_extremal(extremal, tmp_path / "plot.png", title="A title").get_suptitle() == "A title"
    plot_solution(scenario, extremal, tmp_path / "solution.png")
    for name in ("plot.png", "solution.png"):
        height, width, _ = imread(tmp_path / name).shape
        assert (height, width) == (1110, 1725)
    with pytest.raises(ValueError, match="xyz"):
        plot_extremal(extremal, tmp_path / "plot.xyz")


def test_a_failure_without_a_path_cannot_be_drawn(swept, tmp_path):
    scenario, extremal = swept
    failed = failure(extremal.problem, Status.NO_PATH)
    with pytest.raises(ValueError, match="no path to draw: no path from start to goal"):
        plot_extremal(failed)
    with pytest.raises(ValueError, match="no path to draw"):
        plot_solution(scenario, failed, tmp_path / "plot.png")
    assert not (tmp_path / "plot.png").exists()


def test_only_drawing_loads_matplotlib():
    code = """
import sys, sympy
import leapnav.experts
from leapnav.experts import ControlAffineSystem, OptimalControlProblem, solve
x = sympy.Symbol("x")
system = ControlAffineSystem(state=(x,), drift=(0,), fields=((1,),))
extremal = solve(OptimalControlProblem(system, (0,), (1,), 1.0, (1,)), method="single_shooting")
assert not {"matplotlib", "minari", "torch"} & sys.modules.keys()
leapnav.experts.plot_extremal(extremal)
assert "matplotlib" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
