"""The peers of the benchmark: SciPy's solve_bvp, and CasADi with IPOPT or fatrop, on the same problem.

They are used as their documentation recommends. solve_bvp gets a vectorised right-hand side in NumPy or, in a second
variant, leapnav's compiled flow with its analytic Jacobian. IPOPT solves the trapezoidal transcription with exact
derivatives, built by CasADi's Opti stack for each scenario or, in a second variant, prebuilt with the numbers of the
scenario as parameters, which is not timed. Fatrop, an interior-point method for optimal control problems, solves a
multiple-shooting transcription, prebuilt as well.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi
import numpy as np
from scipy.integrate import solve_bvp

from leapnav.envs import Scenario, Unicycle
from leapnav.envs.field.clearance import clearances
from leapnav.experts import Status, Trajectory, certify
from leapnav.experts.problem.problem import OptimalControlProblem
from leapnav.experts.solvers.nodes import default_segments, start_nodes

MAX_NODES = 5000
TOLERANCE = 1e-6
POINTS = 4000  # of the dense path that is checked for collisions


@dataclass(frozen=True)
class Result:
    """The result of a solver.

    Attributes:
        success: whether the solver reports success and the path is collision-free.
        cost: cost of the path.
        seconds: time of the solve (s).
        certified: whether the path passes leapnav's certificate.

    """

    success: bool
    cost: float
    seconds: float
    certified: bool = False


def bvp(scenario: Scenario, states: np.ndarray, costates: np.ndarray, tol: float, compiled: bool = False) -> Result:
    """Solve by solve_bvp from a guess on a uniform mesh."""
    problem = OptimalControlProblem.from_scenario(scenario).with_winding_of(states)
    goal, start_state = np.array(problem.goal), np.array(problem.start)
    rates, jacobian = _compiled(problem) if compiled else (_in_numpy(scenario), None)

    def ends(first: np.ndarray, last: np.ndarray) -> np.ndarray:
        return np.concatenate([first[:3] - start_state, last[:3] - goal])

    def end_jacobians(*_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at_start, at_end = np.zeros((6, 6)), np.zeros((6, 6))
        at_start[:3, :3] = at_end[3:, :3] = np.eye(3)
        return at_start, at_end

    mesh = np.linspace(0.0, _horizon(scenario), len(states))
    guess = np.concatenate([states, costates], axis=1).T
    start = time.perf_counter()
    with np.errstate(all="ignore"):
        found = solve_bvp(
            rates,
            ends,
            mesh,
            guess,
            fun_jac=jacobian,
            bc_jac=end_jacobians if compiled else None,
            tol=tol,
            max_nodes=MAX_NODES,
        )
    seconds = time.perf_counter() - start
    dense = np.linspace(0.0, _horizon(scenario), POINTS)
    z = np.nan_to_num(found.sol(dense))
    clear = clearances(np.ascontiguousarray(z[:2].T), scenario.field).min() > 0
    cost = float(np.trapezoid(_running_cost(problem, np.ascontiguousarray(z.T)), dense))
    certified = found.success and certify(problem, found.x, np.ascontiguousarray(found.y.T), Status.SUCCESS).success
    return Result(bool(found.success) and bool(clear), cost, seconds, certified)


def path_guess(scenario: Scenario, path: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """States of a path and costates estimated along it, the initial guess of leapnav's methods."""
    problem = OptimalControlProblem.from_scenario(scenario).with_winding_of(path.states)
    _, nodes = start_nodes(problem, path, default_segments(path))
    return nodes[:, :3], nodes[:, 3:]


def line_guess(scenario: Scenario, points: int = 33) -> tuple[np.ndarray, np.ndarray]:
    """The straight line, with the costates -r v (cos, sin, 0) of driving along it at constant speed."""
    problem = OptimalControlProblem.from_scenario(scenario)
    states = problem.with_winding_of(np.array([scenario.start])).straight_line(points).states
    displacement = np.subtract(scenario.goal[:2], scenario.start[:2])
    costates = np.zeros_like(states)
    costates[:, :2] = -scenario.cost.speed_weight * displacement / _horizon(scenario)
    return states, costates


def _horizon(scenario: Scenario) -> float:
    assert scenario.horizon is not None
    return scenario.horizon


def _unicycle(scenario: Scenario) -> Unicycle:
    assert isinstance(scenario.robot, Unicycle)
    return scenario.robot


def _discs(scenario: Scenario) -> np.ndarray:
    """Return x, y and radius of each obstacle."""
    rows = []
    for obstacle in scenario.obstacles:
        assert obstacle.circle is not None
        rows.append((*obstacle.circle.center, obstacle.circle.radius))
    return np.array(rows)


def _in_numpy(scenario: Scenario):
    """The extremal flow of a scenario with discs, vectorised over the mesh as a user would write it."""
    cost, robot = scenario.cost, _unicycle(scenario)
    discs = _discs(scenario)
    centers, rims = discs[:, :2, None], discs[:, 2:] + robot.radius
    x_min, y_min, x_max, y_max = scenario.arena
    sigma, k = cost.proximity_scale, cost.proximity_weight

    def rates(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        x, y, theta, lx, ly, lt = z
        cos, sin = np.cos(theta), np.sin(theta)
        v = np.clip(-(lx * cos + ly * sin) / cost.speed_weight, -robot.max_speed, robot.max_speed)
        w = np.clip(-lt / cost.turn_weight, -robot.max_turn_rate, robot.max_turn_rate)
        dx, dy = x - centers[:, 0], y - centers[:, 1]
        distance = np.sqrt(dx**2 + dy**2 + 1e-6)
        term = k * np.exp(-(distance - rims) / sigma)
        phi_x = -(term * dx / distance).sum(axis=0) / sigma
        phi_y = -(term * dy / distance).sum(axis=0) / sigma
        for sign, d in ((1, x - x_min), (-1, x_max - x)):
            phi_x -= sign * k * np.exp(-(d - robot.radius) / sigma) / sigma
        for sign, d in ((1, y - y_min), (-1, y_max - y)):
            phi_y -= sign * k * np.exp(-(d - robot.radius) / sigma) / sigma
        return np.stack([v * cos, v * sin, w, -phi_x, -phi_y, v * (lx * sin - ly * cos)])

    return rates


def _compiled(problem: OptimalControlProblem):
    """Leapnav's compiled flow and its Jacobian, column by column."""
    arrays = problem.arrays
    none, dz, identity, block = np.empty((6, 0)), np.empty(6), np.eye(6), np.empty((6, 6))

    def rates(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        out = np.empty_like(z)
        for k, column in enumerate(np.ascontiguousarray(z.T)):
            arrays.flow.function(column, arrays.data, arrays.field, none, dz, none)
            out[:, k] = dz
        return out

    def jacobian(_: np.ndarray, z: np.ndarray) -> np.ndarray:
        out = np.empty((6, 6, z.shape[1]))
        for k, column in enumerate(np.ascontiguousarray(z.T)):
            arrays.flow.function(column, arrays.data, arrays.field, identity, dz, block)
            out[:, :, k] = block
        return out

    return rates, jacobian


def _running_cost(problem: OptimalControlProblem, z: np.ndarray) -> np.ndarray:
    arrays, none, dz = problem.arrays, np.empty((6, 0)), np.empty(6)
    return np.array([arrays.flow.function(row, arrays.data, arrays.field, none, dz, none) for row in z])


def _model(numbers: casadi.SX, obstacles: int) -> Callable[[casadi.SX, casadi.SX], tuple[casadi.SX, casadi.SX]]:
    """The function from states (3, N) and controls (2, N) to rates (3, N) and running costs (1, N) in a scenario."""
    sigma, weight, radius, speed_weight, turn_weight = casadi.vertsplit(numbers[1:6])
    arena, discs = numbers[6:10], casadi.reshape(numbers[16:], 3, obstacles)

    def evaluate(q: casadi.SX, u: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
        v, w = u[0, :], u[1, :]
        proximity = 0
        for d in (q[0, :] - arena[0], arena[2] - q[0, :], q[1, :] - arena[1], arena[3] - q[1, :]):
            proximity += casadi.exp(-(d - radius) / sigma)
        for i in range(obstacles):
            d = casadi.sqrt((q[0, :] - discs[0, i]) ** 2 + (q[1, :] - discs[1, i]) ** 2 + 1e-6) - discs[2, i] - radius
            proximity += casadi.exp(-d / sigma)
        rates = casadi.vertcat(v * casadi.cos(q[2, :]), v * casadi.sin(q[2, :]), w)
        return rates, (speed_weight * v**2 + turn_weight * w**2) / 2 + weight * proximity

    return evaluate


def _numbers(scenario: Scenario, goal: np.ndarray) -> list[float]:
    """The numbers of a scenario with discs, in the order of `_model`; the heading of the goal has its winding."""
    robot, cost = _unicycle(scenario), scenario.cost
    weights = [cost.proximity_scale, cost.proximity_weight, robot.radius, cost.speed_weight, cost.turn_weight]
    return [_horizon(scenario), *weights, *scenario.arena, *scenario.start, *goal, *_discs(scenario).ravel()]


@functools.cache
def transcription(obstacles: int, intervals: int) -> tuple[casadi.Function, int]:
    """An IPOPT solver for scenarios with this number of discs, whose parameters are inputs; number of constraints."""
    q, u = casadi.SX.sym("q", 3, intervals + 1), casadi.SX.sym("u", 2, intervals + 1)
    numbers = casadi.SX.sym("numbers", 16 + 3 * obstacles)
    rates, running = _model(numbers, obstacles)(q, u)
    h = numbers[0] / intervals
    steps = q[:, 1:] - q[:, :-1] - h / 2 * (rates[:, 1:] + rates[:, :-1])
    constraints = casadi.vertcat(casadi.vec(steps), q[:, 0] - numbers[10:13], q[:, -1] - numbers[13:16])
    program = {
        "x": casadi.vertcat(casadi.vec(q), casadi.vec(u)),
        "p": numbers,
        "f": h * (casadi.sum2(running) - (running[0] + running[-1]) / 2),
        "g": constraints,
    }
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE}}
    return casadi.nlpsol("solver", "ipopt", program, options), constraints.shape[0]


@functools.cache
def staged_transcription(obstacles: int, intervals: int) -> tuple[casadi.Function, int]:
    """A fatrop solver, see `transcription`.

    Fatrop requires explicit dynamics, and variables and constraints in the order of time, so the controls are constant
    on each interval, over which states and cost are integrated by one Runge-Kutta step of order 4.
    """
    numbers = casadi.SX.sym("numbers", 16 + 3 * obstacles)
    model, h, cost = _model(numbers, obstacles), numbers[0] / intervals, 0
    q = casadi.SX.sym("q0", 3)
    variables, constraints = [q], []
    for k in range(intervals):
        u, following = casadi.SX.sym(f"u{k}", 2), casadi.SX.sym(f"q{k + 1}", 3)
        k1, l1 = model(q, u)
        k2, l2 = model(q + h / 2 * k1, u)
        k3, l3 = model(q + h / 2 * k2, u)
        k4, l4 = model(q + h * k3, u)
        cost += h / 6 * (l1 + 2 * l2 + 2 * l3 + l4)
        constraints.append(following - q - h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        if k == 0:
            constraints.append(q - numbers[10:13])
        variables += [u, following]
        q = following
    constraints.append(q - numbers[13:16])
    equations = casadi.vertcat(*constraints)
    program = {"x": casadi.vertcat(*variables), "p": numbers, "f": cost, "g": equations}
    options = {
        "print_time": False,
        "structure_detection": "auto",
        "equality": [True] * equations.shape[0],
        "fatrop": {"print_level": 0, "tol": TOLERANCE},
    }
    return casadi.nlpsol("solver", "fatrop", program, options), equations.shape[0]


def ipopt(scenario: Scenario, path: Trajectory, intervals: int, prebuilt: bool = False) -> Result:
    """Solve by IPOPT on the trapezoidal transcription, from the states of a path and the speeds along it."""
    return _direct(_prebuilt if prebuilt else _opti, scenario, path, intervals)


def fatrop(scenario: Scenario, path: Trajectory, intervals: int) -> Result:
    """Solve by fatrop from the states of a path and the speeds along it."""
    return _direct(_staged, scenario, path, intervals)


Solution = tuple[np.ndarray, float, bool, float]


def _direct(solve: Callable[..., Solution], scenario: Scenario, path: Trajectory, intervals: int) -> Result:
    times = np.linspace(0.0, _horizon(scenario), intervals + 1)
    states = path.resample(times).states
    rates = np.gradient(states, times, axis=0)
    speed = rates[:, 0] * np.cos(states[:, 2]) + rates[:, 1] * np.sin(states[:, 2])
    values, cost, success, seconds = solve(scenario, times, states, np.stack([speed, rates[:, 2]], axis=1))
    dense = Trajectory(times, values).resample(np.linspace(0.0, _horizon(scenario), POINTS)).states
    clear = clearances(np.ascontiguousarray(dense), scenario.field).min() > 0
    return Result(success and bool(clear), cost, seconds)


def _prebuilt(scenario: Scenario, times: np.ndarray, states: np.ndarray, speeds: np.ndarray) -> Solution:
    solver = transcription(len(scenario.obstacles), len(times) - 1)
    bounds = np.vstack([_unbounded(states.size), np.tile(scenario.robot.control_bounds(), (len(times), 1))])
    values, cost, success, seconds = _solve(solver, scenario, states, np.append(states, speeds), bounds)
    return values[: states.size].reshape(-1, 3), cost, success, seconds


def _staged(scenario: Scenario, times: np.ndarray, states: np.ndarray, speeds: np.ndarray) -> Solution:
    solver = staged_transcription(len(scenario.obstacles), len(times) - 1)
    guess = np.append(np.hstack([states, speeds])[:-1], states[-1])
    stage = np.vstack([_unbounded(3), scenario.robot.control_bounds()])
    bounds = np.vstack([np.tile(stage, (len(times) - 1, 1)), _unbounded(3)])
    values, cost, success, seconds = _solve(solver, scenario, states, guess, bounds)
    return np.append(values, [0.0, 0.0]).reshape(-1, 5)[:, :3], cost, success, seconds


def _unbounded(count: int) -> np.ndarray:
    """Return the bounds (count, 2) of variables that have none."""
    return np.tile([-np.inf, np.inf], (count, 1))


def _solve(
    solver: tuple[casadi.Function, int], scenario: Scenario, states: np.ndarray, guess: np.ndarray, bounds: np.ndarray
) -> Solution:
    """Call a prebuilt solver, whose time is measured; `bounds` and the values are those of all variables."""
    function, count = solver
    numbers, zeros = _numbers(scenario, states[-1]), np.zeros(count)
    start = time.perf_counter()
    found = function(x0=guess, p=numbers, lbx=bounds[:, 0], ubx=bounds[:, 1], lbg=zeros, ubg=zeros)
    seconds = time.perf_counter() - start
    return np.array(found["x"]).ravel(), float(found["f"]), bool(function.stats()["success"]), seconds


def _opti(scenario: Scenario, times: np.ndarray, states: np.ndarray, speeds: np.ndarray) -> Solution:
    intervals, cost, robot = len(times) - 1, scenario.cost, _unicycle(scenario)
    h = _horizon(scenario) / intervals
    opti = casadi.Opti()
    q, u = opti.variable(3, intervals + 1), opti.variable(2, intervals + 1)
    v, w = u[0, :], u[1, :]
    rates = casadi.vertcat(v * casadi.cos(q[2, :]), v * casadi.sin(q[2, :]), w)
    opti.subject_to(q[:, 1:] == q[:, :-1] + h / 2 * (rates[:, 1:] + rates[:, :-1]))
    x_min, y_min, x_max, y_max = scenario.arena
    proximity = 0
    for d in (q[0, :] - x_min, x_max - q[0, :], q[1, :] - y_min, y_max - q[1, :]):
        proximity += casadi.exp(-(d - robot.radius) / cost.proximity_scale)
    for cx, cy, r in _discs(scenario):
        d = casadi.sqrt((q[0, :] - cx) ** 2 + (q[1, :] - cy) ** 2 + 1e-6) - r - robot.radius
        proximity += casadi.exp(-d / cost.proximity_scale)
    running = (cost.speed_weight * v**2 + cost.turn_weight * w**2) / 2 + cost.proximity_weight * proximity
    objective = h * (casadi.sum2(running) - (running[0] + running[-1]) / 2)
    opti.minimize(objective)
    opti.subject_to(q[:, 0] == np.array(scenario.start))
    opti.subject_to(q[:, -1] == states[-1])
    opti.subject_to(opti.bounded(-robot.max_speed, v, robot.max_speed))
    opti.subject_to(opti.bounded(-robot.max_turn_rate, w, robot.max_turn_rate))
    opti.set_initial(q, states.T)
    opti.set_initial(u, speeds.T)
    options = {"print_level": 0, "sb": "yes", "tol": TOLERANCE}
    opti.solver("ipopt", {"print_time": False, "expand": True}, options)
    # The time includes the derivatives and the solve, but not the construction of the expressions above.
    start = time.perf_counter()
    try:
        solution = opti.solve()
    except RuntimeError:
        return states, np.inf, False, time.perf_counter() - start
    seconds = time.perf_counter() - start
    return np.asarray(solution.value(q)).T, float(solution.value(objective)), True, seconds
