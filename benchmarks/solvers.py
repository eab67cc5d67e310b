"""From one path to a certified extremal: our methods beside scipy's solve_bvp and CasADi + IPOPT.

All start from the same lattice path of the same scenarios, in the same process, and take turns. solve_bvp gets the
path's states, costates consistent with the minimum principle, and the analytic Jacobian; IPOPT gets the path's states
and solves the direct transcription (trapezoidal rule, 50 intervals). A solve counts as a success if the path that it
returns meets the goal and is clear of every obstacle on its dense path.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import casadi
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_bvp

from leapnav.envs import Scenario, sample_scenario
from leapnav.envs.obstacles import clearances
from leapnav.experts import Path, find_optimum, solve
from leapnav.experts.lattice import Lattice
from leapnav.experts.nodes import default_segments, start_nodes
from leapnav.experts.problem import OptimalControlProblem

INTERVALS = 50
TOLERANCE = 1e-6  # of the peers; ours are certified to 1e-8
Result = tuple[bool, float]


def ours(method: str) -> Callable[[Scenario, Path], Result]:
    def run(scenario: Scenario, path: Path) -> Result:
        extremal = solve(scenario, method=method, guess=path)
        return extremal.success, extremal.cost

    return run


def with_solve_bvp(scenario: Scenario, path: Path) -> Result:
    problem = OptimalControlProblem.from_scenario(scenario).with_winding_of(path.states)
    arrays = problem.arrays
    times, nodes = start_nodes(problem, path, default_segments(path))
    empty, dz, identity, jacobian = np.empty((6, 0)), np.empty(6), np.eye(6), np.empty((6, 6))

    def rates(_, z):
        out = np.empty_like(z)
        for k, column in enumerate(np.ascontiguousarray(z.T)):
            arrays.flow(column, arrays.data, arrays.field, empty, dz, empty)
            out[:, k] = dz
        return out

    def jacobians(_, z):
        out = np.empty((6, 6, z.shape[1]))
        for k, column in enumerate(np.ascontiguousarray(z.T)):
            arrays.flow(column, arrays.data, arrays.field, identity, dz, jacobian)
            out[:, :, k] = jacobian
        return out

    def ends(start, end):
        return np.concatenate([start[:3] - arrays.start, end[:3] - arrays.goal])

    def end_jacobians(*_):
        at_start, at_end = np.zeros((6, 6)), np.zeros((6, 6))
        at_start[:3, :3] = at_end[3:, :3] = np.eye(3)
        return at_start, at_end

    found = solve_bvp(
        rates, ends, times, nodes.T, fun_jac=jacobians, bc_jac=end_jacobians, tol=TOLERANCE, max_nodes=5000
    )
    dense = np.linspace(0, scenario.horizon, 2000)
    states = np.ascontiguousarray(found.sol(dense)[:3].T)
    values = [
        arrays.flow(np.ascontiguousarray(z), arrays.data, arrays.field, empty, dz, empty) for z in found.sol(dense).T
    ]
    cost = float(np.trapezoid(values, dense))
    return bool(found.success) and clearances(states, scenario.field).min() > 0, cost


def with_ipopt(scenario: Scenario, path: Path) -> Result:
    times = np.linspace(0, scenario.horizon, INTERVALS + 1)
    guess = path.resample(times).states
    h, cost = scenario.horizon / INTERVALS, scenario.cost
    opti = casadi.Opti()
    q, u = opti.variable(3, INTERVALS + 1), opti.variable(2, INTERVALS + 1)
    v, w = u[0, :], u[1, :]
    rates = casadi.vertcat(v * casadi.cos(q[2, :]), v * casadi.sin(q[2, :]), w)
    opti.subject_to(q[:, 1:] == q[:, :-1] + h / 2 * (rates[:, 1:] + rates[:, :-1]))
    x_min, y_min, x_max, y_max = scenario.arena
    near = 0
    for d in (q[0, :] - x_min, x_max - q[0, :], q[1, :] - y_min, y_max - q[1, :]):
        near += casadi.exp(-(d - scenario.robot.radius) / cost.proximity_scale)
    for obstacle in scenario.obstacles:
        (cx, cy), r = obstacle.circle.center, obstacle.circle.radius
        d = casadi.sqrt((q[0, :] - cx) ** 2 + (q[1, :] - cy) ** 2 + 1e-6) - r - scenario.robot.radius
        near += casadi.exp(-d / cost.proximity_scale)
    running = (cost.speed_weight * v**2 + cost.turn_weight * w**2) / 2 + cost.proximity_weight * near
    objective = h * (casadi.sum2(running) - (running[0] + running[-1]) / 2)
    opti.minimize(objective)
    opti.subject_to(q[:, 0] == np.array(scenario.start))
    opti.subject_to(q[:, -1] == guess[-1])
    opti.subject_to(opti.bounded(-scenario.robot.max_speed, v, scenario.robot.max_speed))
    opti.subject_to(opti.bounded(-scenario.robot.max_turn_rate, w, scenario.robot.max_turn_rate))
    opti.set_initial(q, guess.T)
    opti.solver("ipopt", {"print_time": False, "expand": True}, {"print_level": 0, "sb": "yes", "tol": TOLERANCE})
    start = time.perf_counter()
    try:
        solution = opti.solve()
    except RuntimeError:
        with_ipopt.seconds = time.perf_counter() - start
        return False, np.inf
    # Building the problem in Python is CasADi's set-up, not IPOPT's work, and is left out.
    with_ipopt.seconds = time.perf_counter() - start
    states = Path(times, solution.value(q).T).resample(np.linspace(0, scenario.horizon, 2000)).states
    return clearances(np.ascontiguousarray(states), scenario.field).min() > 0, float(solution.value(objective))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="clutter scenarios")
    count = parser.parse_args().count
    methods: dict[str, Callable[[Scenario, Path], Result]] = {
        "leapfrog": ours("leapfrog"),
        "multiple shooting": ours("multiple_shooting"),
        "solve_bvp": with_solve_bvp,
        f"IPOPT, {INTERVALS} intervals": with_ipopt,
    }
    scenarios = [sample_scenario("clutter", 20_000 + seed) for seed in range(count)]
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    successes = dict.fromkeys(methods, 0)
    search, optimum = [], []
    find_optimum(scenarios[0])
    for scenario in scenarios:
        start = time.perf_counter()
        candidate = next(Lattice(scenario).candidates())
        search.append(time.perf_counter() - start)
        start = time.perf_counter()
        find_optimum(scenario)
        optimum.append(time.perf_counter() - start)
        path = Path(candidate.times, candidate.poses)
        for name, run in methods.items():
            start = time.perf_counter()
            success, _ = run(scenario, path)
            spent = time.perf_counter() - start
            seconds[name].append(with_ipopt.seconds if run is with_ipopt else spent)
            successes[name] += success
    reference = statistics.median(seconds["leapfrog"])
    table = Table(title=f"Path to extremal, {count} clutter scenarios")
    for column in ("method", "success", "median ms", "times leapfrog's"):
        table.add_column(column, justify="right" if column != "method" else "left")
    for name, spent in seconds.items():
        middle = statistics.median(spent)
        table.add_row(name, f"{successes[name]} of {count}", f"{1e3 * middle:.1f}", f"{middle / reference:.2f}")
    Console().print(table)
    print(f"lattice search, median               {1e3 * statistics.median(search):8.1f} ms")
    print(f"find_optimum, everything, median     {1e3 * statistics.median(optimum):8.1f} ms")


with_ipopt.seconds = 0.0

if __name__ == "__main__":
    main()
