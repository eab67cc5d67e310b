"""Checks of what a bank stores, before anything else uses it.

Checksums detect damage, but anybody can edit a bank and compute them again. Scenarios are validated as those from files
are. Optima are compared with their scenarios as far as that takes milliseconds: a false value within the tolerances
below is not noticed. To solve the problem again from the stored path is the complete check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.field.layout import read_header
from leapnav.envs.field.proximity import footprint_value
from leapnav.envs.kernels.types import constant
from leapnav.envs.robots.footprints import arm_of
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.validation import is_integer

MAX_POINT_INTERVAL = 0.1  # s between the stored points of an optimum
# Largest residual and defect of a certified optimum, `Certificate.TOLERANCE` of `leapnav.experts`.
CERTIFIED = 1e-8
ROUNDING = 1e-9  # relative error of costs and bounds by rounding
# Error of a float32 number after four roundings, relative to the number, or absolute if that is below 1 (m, rad).
PRECISION = 4 * float(np.finfo(np.float32).eps)
# The motion under the mean of the controls at two successive points ends at the second point, except for this fraction
# of the largest difference of successive states. In the included banks that is at most 0.05.
MOTION_TOLERANCE = 0.5
# The trapezoidal rule yields the cost with this relative error: in the included banks at most 0.004, except in one
# narrow passage, where the proximity cost has peaks between the points. With this number of points per interval,
# interpolated by splines, the error is 0.009 there.
COST_TOLERANCE, INTERPOLATED = 0.05, 8
# Duration (s) of the motion whose difference quotient is the direction in which a control acts. The relative error of
# its product with the costates is at most 6e-5 in the included banks.
ACTION_TIME, ACTION_TOLERANCE = 1e-4, 1e-3


@dataclass(frozen=True, eq=False)
class Reference:
    """The certified optimum of a scenario in a bank.

    Attributes:
        cost: J*.
        second_cost: J of the second-best local optimum found, None if there is none.
        certificate: boundary residual, defect, drift of H, clearance (m).
        times (N,): times of the points (s), from 0 to the duration of the optimum.
        states (N, n): x, y (m), heading (rad, unwrapped) and further states, float32.
        controls (N, m): the robot's controls, float32.
        costates (N, n): gradient of the cost-to-go, float32.
        lower_bound: no collision-free path costs less; None if nothing is proved.

    """

    cost: float
    second_cost: float | None
    certificate: tuple[float, float, float, float]
    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    costates: np.ndarray
    lower_bound: float | None = None


def count_points(durations: np.ndarray) -> np.ndarray:
    """Return the numbers of stored points of optima with given durations (s)."""
    return np.maximum(np.ceil(durations / MAX_POINT_INTERVAL - 1e-6), 1) + 1


def check_lengths(arrays: Mapping[str, np.ndarray], contents: Mapping[str, tuple[str, ...]]) -> None:
    """Check the numbers of entries of all datasets.

    Args:
        arrays: the datasets by name.
        contents: for each dataset of ends, the datasets that it divides.

    Raises:
        ValueError: they do not fit each other; the message names a dataset.

    """
    count, divided = len(arrays["costs"]), {name for names in contents.values() for name in names}
    for name, array in arrays.items():
        if name not in divided and len(array) != count:
            raise ValueError(f"{name}: {len(array)} entries for {count} scenarios")
    for name, parts in contents.items():
        ends = arrays[name]
        _check(name, "increasing numbers > 0", np.append(ends[:1] > 0, ends[1:] > ends[:-1]), ends)
        if any(len(arrays[part]) != (ends[-1] if count else 0) for part in parts):
            raise ValueError(f"{name}: not the ends of {' and '.join(parts)}")


def check_values(arrays: Mapping[str, np.ndarray], drawn: int) -> None:
    """Check the numbers of each optimum, and their relations.

    Args:
        arrays: the datasets by name; those of `ADDED` in `leapnav.envs.scenarios.bank` are optional.
        drawn: number of scenarios drawn.

    Raises:
        ValueError: a number is impossible; the message names the dataset, the index and the number.

    """
    costs, durations, draws = arrays["costs"], arrays["horizons"], arrays["draws"]
    _check("draws", "increasing numbers >= 0", np.append(draws[:1] >= 0, draws[1:] > draws[:-1]), draws)
    _check("draws", f"numbers < {drawn}, the number of draws", draws < drawn, draws)
    _check("costs", "finite numbers >= 0", np.isfinite(costs) & (costs >= 0), costs)
    second = arrays["second_costs"]
    is_second = np.isfinite(second) & (second >= costs * (1 - ROUNDING))
    _check("second_costs", "NaN or numbers of at least the cost", np.isnan(second) | is_second, second)
    if (bounds := arrays.get("lower_bounds")) is not None:
        is_bound = np.isfinite(bounds) & (bounds <= costs * (1 + ROUNDING))
        _check("lower_bounds", "NaN or numbers of at most the cost", np.isnan(bounds) | is_bound, bounds)
    for name in ("shortest_lengths", "shortest_times"):
        if (values := arrays.get(name)) is not None:
            _check(name, "NaN or finite numbers >= 0", np.isnan(values) | (np.isfinite(values) & (values >= 0)), values)
    certificates = arrays["certificates"]
    if certificates.shape[1] != 4:
        raise ValueError(f"certificates: expected 4 columns, got {certificates.shape[1]}")
    errors, (drift, clearance) = certificates[:, :2].T, certificates[:, 2:].T
    certified = (errors >= 0).all(axis=0) & (errors <= CERTIFIED).all(axis=0) & (drift >= 0) & (clearance > 0)
    expected = f"residual and defect from 0 to {CERTIFIED:g}, drift >= 0, clearance > 0, all finite"
    _check("certificates", expected, certified & np.isfinite(certificates).all(axis=1), certificates)
    _check("horizons", "finite numbers > 0", np.isfinite(durations) & (durations > 0), durations)
    fits = np.diff(arrays["path_ends"], prepend=0) == count_points(durations)
    _check("horizons", f"durations with points at most {MAX_POINT_INTERVAL:g} s apart", fits, durations)


def _check(name: str, expected: str, valid: np.ndarray, values: np.ndarray) -> None:
    if not valid.all():
        index = int(np.argmin(valid))
        raise ValueError(f"{name}[{index}]: expected {expected}, got {values[index].tolist()}")


def check_attributes(attributes: Mapping[str, Any], rejected: Any, given: Any, count: int) -> None:
    """Check the attributes of a file.

    Args:
        attributes: the attributes by name.
        rejected, given: the content of those attributes; `given` is None if there is none.
        count: number of scenarios.

    Raises:
        ValueError: an attribute has another type or value; the message names it.

    """
    for name in ("family", "software"):
        if not isinstance(attributes[name], str):
            raise ValueError(f"{name}: expected text, got {attributes[name]!r}")
    seed, drawn = attributes["seed"], attributes["drawn"]
    if not (is_integer(seed) and seed >= 0):
        raise ValueError(f"seed: expected an integer >= 0, got {seed!r}")
    if not isinstance(rejected, dict) or not all(is_integer(n) and n >= 0 for n in rejected.values()):
        raise ValueError(f"rejected: expected numbers of scenarios by reason, got {rejected!r}")
    if not (is_integer(drawn) and drawn == count + sum(rejected.values())):
        raise ValueError(f"drawn: expected the number of admitted and rejected scenarios, got {drawn!r}")
    if given is None:
        return
    reasons = ("rejected", "doubtful")  # by name
    valid = isinstance(given, dict) and "rejected" in given
    if valid:
        valid = all(isinstance(value, dict if name in reasons else str) for name, value in given.items())
    if not valid or not all(isinstance(text, str) for name in reasons for text in given.get(name, {}).values()):
        raise ValueError(f"given: expected texts, and reasons by name, got {given!r}")


def check_optimum(scenario: Scenario, reference: Reference) -> None:
    """Compare the optimum of a scenario with the scenario.

    Raises:
        ValueError: they do not fit each other; the message names the dataset.

    """
    arrays = reference.states, reference.controls, reference.costates
    for name, array in zip(("states", "controls", "costates"), arrays, strict=True):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers")
    states, controls, costates = (array.astype(float) for array in arrays)
    with np.errstate(all="ignore"):  # large numbers are refused, since no comparison with the result holds
        _check_states(scenario, states, reference.times, reference.certificate[3])
        _check_motion(scenario, states, controls, float(reference.times[1]))
        _check_costates(scenario, states, controls, costates)
        _check_cost(scenario, np.column_stack([states, reference.times]), controls, reference.cost)


def _check_states(scenario: Scenario, states: np.ndarray, times: np.ndarray, certified: float) -> None:
    """Check start, goal and clearance of a path."""
    rounding = PRECISION * np.maximum(np.abs(states), 1.0)
    is_heading = np.isin(scenario.robot.state_names, ("heading", *scenario.robot.heading_states))
    for name, k, ends in (("start", 0, scenario.start_state), ("goal", -1, scenario.goal_state)):
        errors = states[k] - np.array(ends, dtype=float)  # NaN where the goal is free
        errors[is_heading] -= 2 * math.pi * np.round(errors[is_heading] / (2 * math.pi))
        if not (np.isnan(errors) | (np.abs(errors) <= rounding[k] + CERTIFIED)).all():
            raise ValueError(f"states: expected the {name} {ends}, got {states[k].tolist()}")
    # Before the kernels, which read the cells of a grid.
    x_min, y_min, x_max, y_max = scenario.arena
    if not ((states[:, :2] >= (x_min, y_min)) & (states[:, :2] <= (x_max, y_max))).all():
        raise ValueError("states: expected positions in the arena")
    outline, field = scenario.outline, scenario.field
    found = float(footprint_clearances(np.column_stack([states, times]), outline, field).min())
    # Every point of the outline is always within half of this of its position at a stored point, and so are the points
    # of the certificate.
    steps, arm, joint = np.abs(np.diff(states, axis=0)), arm_of(outline), int(outline[:, 4].max())
    turns = steps[:, 2] + (steps[:, joint] if joint else 0.0)
    moved = float(read_header(field)["top_speed"]) * float(times[1])  # by obstacles in the same time
    step = float((np.hypot(steps[:, 0], steps[:, 1]) + arm * turns).max()) + moved
    if not abs(found - certified) <= step + float(rounding[:, :3].max()):
        raise ValueError(f"states: expected a smallest clearance of {certified:.3g} m, got {found:.3g} m")


def _check_motion(scenario: Scenario, states: np.ndarray, controls: np.ndarray, interval: float) -> None:
    """Check that the states are the motion of the robot under the controls, and that these are within the limits."""
    robot = scenario.robot
    bounds, parameters = robot.control_bounds(), constant(robot.parameters(scenario.cost))
    slack = PRECISION * np.abs(bounds).max(axis=1)
    if not ((controls >= bounds[:, 0] - slack) & (controls <= bounds[:, 1] + slack)).all():
        raise ValueError(f"controls: expected values within {bounds.tolist()}, the limits of the robot")
    moved = np.empty_like(states[1:])
    for k, control in enumerate((controls[:-1] + controls[1:]) / 2):
        type(robot).advance(states[k], control, interval, parameters, moved[k])
    tolerance = MOTION_TOLERANCE * np.abs(np.diff(states, axis=0)).max(axis=0)
    if not (np.abs(moved - states[1:]) <= tolerance + PRECISION * np.maximum(np.abs(states[1:]), 1.0)).all():
        raise ValueError("states: not the motion of the robot with these controls")


def _check_costates(scenario: Scenario, states: np.ndarray, controls: np.ndarray, costates: np.ndarray) -> None:
    """Check that the controls minimise the Hamiltonian: u = -b(q)' lambda / weights, within the limits."""
    robot = scenario.robot
    (low, high), weights = robot.control_bounds().T, np.array(robot.control_weight(scenario.cost))
    parameters = constant(robot.parameters(scenario.cost))
    held = np.vstack([np.zeros(len(low)), np.eye(len(low))])
    moved = np.empty((len(states), len(held), states.shape[1]))
    for state, ends in zip(states, moved, strict=True):
        for action, end in zip(held, ends, strict=True):
            type(robot).advance(state, action, ACTION_TIME, parameters, end)
    slopes = np.einsum("kjn,kn->kj", moved[:, 1:] - moved[:, :1], costates) / ACTION_TIME
    errors = np.abs(np.clip(-slopes / weights, low, high) - controls) * weights
    if not (errors <= ACTION_TOLERANCE * (1 + np.abs(costates).max(axis=1, keepdims=True))).all():
        raise ValueError("costates: not those of an extremal with these states and controls")


def _check_cost(scenario: Scenario, states: np.ndarray, controls: np.ndarray, cost: float) -> None:
    """Check that the cost is that of the path (N, n + 1) with the time; with hard obstacles, without the barrier."""
    total = _path_cost(scenario, states, controls)
    if not abs(cost - total) <= COST_TOLERANCE * total:
        from scipy.interpolate import CubicSpline  # imported here because that takes time, and it is rarely used

        at = np.arange(len(states)), np.linspace(0, len(states) - 1, INTERPOLATED * (len(states) - 1) + 1)
        fine = [CubicSpline(at[0], values)(at[1]) for values in (states, controls)]
        total = _path_cost(scenario, fine[0], fine[1])
    if not abs(cost - total) <= COST_TOLERANCE * total:
        raise ValueError(f"costs: expected {total:.4g}, the cost of the path, got {cost:.4g}")


def _path_cost(scenario: Scenario, states: np.ndarray, controls: np.ndarray) -> float:
    """Return the cost of a path by the trapezoidal rule."""
    robot = scenario.robot
    parameters = constant(robot.parameters(scenario.cost))
    running = np.square(controls) @ np.array(robot.control_weight(scenario.cost)) / 2 + scenario.cost.time_weight
    state_cost = type(robot).state_cost
    for k, state in enumerate(states):
        running[k] += footprint_value(constant(state), scenario.outline, scenario.field)
        running[k] += 0.0 if state_cost is None else state_cost(state, parameters)
    return float(np.trapezoid(running, states[:, -1]))
