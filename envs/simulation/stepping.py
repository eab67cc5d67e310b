"""One control period of many robots (kernels): motion, running cost, reward, and end of the episode.

The kernels take all episodes as one `SimulationState`, or as a plain tuple if Python calls them, and read and write its
arrays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT_MATRIX, FLAGS, INTEGERS, MATRIX, NOTHING, VECTOR
from leapnav.envs.robots.arcs import sinc
from leapnav.envs.robots.base import ARCS, GENERAL, WHEELS
from leapnav.envs.scenarios.scenario import GOAL, HORIZON, LIMITS, START
from leapnav.envs.settings import (
    ACTUATION_NOISE,
    COLLISION_PENALTY,
    DISCOUNT,
    DRIVE,
    FREE_HORIZON,
    GRIP,
    HEADING_TOLERANCE,
    MASS,
    MISS_PENALTY,
    MOMENT,
    MOTION_TOLERANCE,
    N_CONTROLS,
    N_MOTION,
    PERIOD,
    POSITION_TOLERANCE,
    RESPONSE,
    SHAPED,
    SLIP,
    TERMINATE_ON_COLLISION,
    TRACK,
    WHEEL_FORCE,
)
from leapnav.envs.shapes.clearance import footprint_clearance
from leapnav.envs.simulation.arcs import arc_proximity, follow_arc
from leapnav.envs.simulation.paths import (
    MOTION,
    NODES,
    SAMPLED_FRACTIONS,
    HeldPath,
    follow_path,
    path_costs,
    sample_path,
)
from leapnav.envs.simulation.state import (
    CLEARANCE,
    COLLIDED,
    COLLISION,
    COST,
    DURATION,
    EFFORT,
    IN_CONTACT,
    LAST_STEP,
    MISS,
    PACKED_STATE,
    PLACES,
    POSE_CLEARANCE,
    POTENTIAL,
    PROXIMITY,
    REMAINING,
    REWARD,
    SHAPING,
    SIMULATION_STATE,
    SPEED,
    SPIN,
    STEPS,
    SUCCESS,
    TERMINATED,
    TIME,
    TIME_COST,
    TIME_WEIGHT,
    TRUNCATED,
    TURN_RATE,
    VX,
    VY,
    SimulationState,
    field_of,
)

GRAVITY = 9.81  # m/s^2


@kernel(float64(MATRIX, int64, float64, float64))
def effort(tasks, i, speed_squared, turn_rate_squared):
    """Return the running cost of the motion of robot i, a unicycle, without the proximity cost."""
    return 0.5 * (tasks[i, LIMITS + 2] * speed_squared + tasks[i, LIMITS + 3] * turn_rate_squared)


@kernel(float64(MATRIX, VECTOR, int64))
def control_effort(tasks, controls, i):
    """Return the running cost of the controls (m,) of robot i."""
    m = len(controls)
    total = 0.0
    for j in range(m):
        total += tasks[i, LIMITS + m + j] * controls[j] ** 2
    return 0.5 * total


@kernel(float64(int64, SIMULATION_STATE))
def potential(i, sim):
    """Return minus an estimate of the cost-to-go of robot i: following the reference path at constant speed.

    If the horizon is free, the speed is the one with the lowest cost. The estimate is at most the miss penalty. Any
    function of the state leaves the optimal policy unchanged (Ng, Harada and Russell, 1999); a good estimate makes it
    easier to learn.
    """
    bodies, tasks, guides = sim.bodies, sim.tasks, sim.guides
    length = np.inf
    for k in range(guides.shape[1]):
        dx, dy = guides[i, k, 0] - bodies[i, 0], guides[i, k, 1] - bodies[i, 1]
        length = min(length, math.sqrt(dx * dx + dy * dy) + guides[i, k, 2])
    heading = tasks[i, GOAL + 2]
    turn = 0.0 if math.isnan(heading) else (heading - bodies[i, 2] + math.pi) % (2 * math.pi) - math.pi
    time = max(tasks[i, HORIZON] - sim.state[i, TIME], sim.settings[PERIOD])
    weights = int(sim.settings[N_MOTION] + sim.settings[N_CONTROLS])
    square = sim.robots[i, weights] * (length * length) + sim.robots[i, weights + 1] * (turn * turn)
    if sim.settings[FREE_HORIZON] != 0.0:
        estimate = math.sqrt(2.0 * sim.state[i, TIME_WEIGHT] * square)
    else:
        estimate = 0.5 * square / time
    return -min(estimate, sim.settings[MISS_PENALTY])


@kernel(NOTHING(INTEGERS, PACKED_STATE))
def start_episodes(robots, packed):
    """Place robots, given by index, at the start of their tasks."""
    sim = SimulationState(*packed)
    bodies, state, tasks, settings = sim.bodies, sim.state, sim.tasks, sim.settings
    n_motion, n_controls = int(settings[N_MOTION]), int(settings[N_CONTROLS])
    further, first_disc = LIMITS + 2 * n_controls, n_motion + n_controls + 3
    for i in robots:
        for column in range(bodies.shape[1]):
            bodies[i, column] = tasks[i, START + column] if column < 3 else 0.0
        for k in range(n_motion):
            sim.robots[i, k] = tasks[i, further + k]
        for column in range(state.shape[1]):
            state[i, column] = 0.0
        # A remainder of less than 1e-6 periods is a rounding error of the horizon, not another period.
        state[i, LAST_STEP] = max(1.0, math.ceil(tasks[i, HORIZON] / settings[PERIOD] - 1e-6))
        state[i, POSE_CLEARANCE] = footprint_clearance(
            bodies[i, 0],
            bodies[i, 1],
            bodies[i, 2],
            sim.robots[i, first_disc:].reshape((-1, 2)),
            field_of(sim.fields, i),
        )[0]
        state[i, CLEARANCE] = state[i, POSE_CLEARANCE]
        if settings[FREE_HORIZON] != 0.0:
            state[i, TIME_WEIGHT] = sim.robots[i, first_disc - 1]
        if settings[SHAPED] != 0.0:
            state[i, POTENTIAL] = potential(i, sim)


@kernel(int64(MATRIX, FLAGS, PACKED_STATE))
def command(actions, active, packed):
    """Set the controls of a period, with actuation noise, and the speed and turn rate of a robot that follows arcs.

    For robots that are not active, the duration of the period is 0.

    Returns:
        -1, or the index of the first active robot whose action is not finite; the state is unchanged then.

    """
    sim = SimulationState(*packed)
    state, tasks, settings, robots = sim.state, sim.tasks, sim.settings, sim.robots
    first, m, drive = int(settings[N_MOTION]), int(settings[N_CONTROLS]), settings[DRIVE]
    for i in range(len(state)):
        if active[i]:
            for j in range(m):
                if not math.isfinite(actions[i, j]):
                    return i
    disturbed = settings[ACTUATION_NOISE] != 0.0 or settings[SLIP] != 0.0
    for i in range(len(state)):
        for column in (IN_CONTACT, REMAINING, SPEED, TURN_RATE, DURATION):
            state[i, column] = 0.0
        for column in (EFFORT, PROXIMITY, TIME_COST, COLLISION, MISS, SHAPING, REWARD):
            state[i, column] = 0.0
        state[i, CLEARANCE] = state[i, POSE_CLEARANCE]
        if not active[i]:
            continue
        state[i, DURATION] = max(min(settings[PERIOD], tasks[i, HORIZON] - state[i, TIME]), 0.0)
        if drive == ARCS:
            speed = min(max(actions[i, 0], -1.0), 1.0) * tasks[i, LIMITS]
            turn_rate = min(max(actions[i, 1], -1.0), 1.0) * tasks[i, LIMITS + 1]
            if disturbed:
                noise, row = sim.noise, sim.noise_rows[i]
                speed *= 1.0 + settings[ACTUATION_NOISE] * noise[i, row, 0]
                turn_rate *= 1.0 + settings[ACTUATION_NOISE] * noise[i, row, 1]
                half = settings[TRACK] / 2
                right = (speed + half * turn_rate) * (1.0 - min(settings[SLIP] * abs(noise[i, row, 2]), 1.0))
                left = (speed - half * turn_rate) * (1.0 - min(settings[SLIP] * abs(noise[i, row, 3]), 1.0))
                speed, turn_rate = (right + left) / 2, (right - left) / (2 * half)
            state[i, SPEED], state[i, TURN_RATE] = speed, turn_rate
            continue
        for j in range(m):
            value = min(max(actions[i, j], -1.0), 1.0) * tasks[i, LIMITS + j]
            if disturbed:
                noise, row = sim.noise, sim.noise_rows[i]
                value *= 1.0 + settings[ACTUATION_NOISE] * noise[i, row, j]
                value *= 1.0 - min(settings[SLIP] * abs(noise[i, row, m + j]), 1.0)
            robots[i, first + j] = value
        if drive == WHEELS:
            track = tasks[i, LIMITS + 2 * m]
            state[i, SPEED] = 0.5 * (robots[i, 0] + robots[i, 1])
            state[i, TURN_RATE] = (robots[i, 1] - robots[i, 0]) / track
    return -1


@kernel(boolean(CONSTANT_MATRIX))
def is_one_disc(discs):
    """Return whether a footprint is one disc around the robot's position, as all are in an array of one disc each."""
    return discs[0, 0] == 0.0 and (len(discs) == 1 or discs[1, 1] <= 0.0)


@kernel(NOTHING(PACKED_STATE, MOTION))
def drive_paths(packed, motion):
    """Set velocity and force of each body, and the further states, for the period, up to the first contact.

    A body moves by the displacement of the robot, and its force then changes its velocity to that of the robot. For
    robots that `drive_arcs` has left out, and those whose controls do not lead to arcs; `command` is called before.
    """
    sim = SimulationState(*packed)
    bodies, state, settings = sim.bodies, sim.state, sim.settings
    general, m, n = settings[DRIVE] == GENERAL, int(settings[N_CONTROLS]), 3 + int(settings[N_MOTION])
    first = LIMITS + 2 * m + 2 * (n - 3)
    q, new, samples, poses = np.empty(n), np.empty(n), np.empty((len(SAMPLED_FRACTIONS), n)), np.empty((NODES, 4))
    for i in range(len(state)):
        if general:
            bodies[i, 3] = bodies[i, 4] = bodies[i, 5] = 0.0
        robot, field, duration = sim.robots[i], field_of(sim.fields, i), state[i, DURATION]
        discs = robot[n + m :].reshape((-1, 2))
        if duration == 0.0 or (not general and is_one_disc(discs)):
            continue
        parameters, u = sim.tasks[i, first:], robot[n - 3 : n - 3 + m]
        if settings[DRIVE] == ARCS:
            u[0], u[1] = state[i, SPEED], state[i, TURN_RATE]
        for k in range(n):
            q[k] = bodies[i, k] if k < 3 else robot[k - 3]
        path = HeldPath(motion, q, u, parameters, discs)
        total = sample_path(path, duration, samples)
        for k in range(n):
            new[k] = samples[NODES, k]
        before = state[i, POSE_CLEARANCE]
        lowest, fraction, after = follow_path(path, duration, field, before, total, new)
        state[i, CLEARANCE], state[i, POSE_CLEARANCE] = lowest, after
        if fraction < 1.0:
            state[i, IN_CONTACT] = 1.0
            state[i, CLEARANCE] = after  # the robot does not reach the rest of the path
            state[i, REMAINING] = duration * (1.0 - fraction)
        driven = duration * fraction
        if driven > 0.0:
            if fraction < 1.0:
                total = sample_path(path, driven, samples)
            proximity, state_cost = path_costs(path, driven, field, total, lowest, samples, poses)
            state[i, EFFORT] += (control_effort(sim.tasks, u, i) + state_cost) * driven
            state[i, PROXIMITY] += proximity * driven
        for k in range(3):
            bodies[i, 3 + k] = new[k] - bodies[i, k]
        for k in range(n - 3):
            robot[k] = new[3 + k]


@kernel(int64(MATRIX, FLAGS, PACKED_STATE))
def drive_arcs(actions, active, packed):
    """Set the velocity of each body for its period, up to the first contact, and add the running cost.

    The chord of the arc that a command produces has the length v h sinc(omega h / 2) and the mean heading. A body whose
    velocity is the chord ends at the end of the arc, because Chipmunk moves bodies by an explicit Euler step.
    Robots with a footprint of several discs are left to `drive_paths`.

    Returns:
        As `command`, which is called first.

    """
    sim = SimulationState(*packed)
    bodies, state = sim.bodies, sim.state
    wheels, all_discs = sim.settings[DRIVE] == WHEELS, sim.robots.shape[1] == 7
    invalid = command(actions, active, packed)
    if invalid >= 0:
        return invalid
    for i in range(len(state)):
        bodies[i, 3] = bodies[i, 4] = bodies[i, 5] = 0.0
        if state[i, DURATION] == 0.0 or not (all_discs or is_one_disc(sim.robots[i, 5:].reshape((-1, 2)))):
            continue
        x, y, heading, field = bodies[i, 0], bodies[i, 1], bodies[i, 2], field_of(sim.fields, i)
        distance, turn = state[i, SPEED] * state[i, DURATION], state[i, TURN_RATE] * state[i, DURATION]
        lowest, fraction, after = follow_arc(x, y, heading, distance, turn, state[i, POSE_CLEARANCE], field)
        state[i, CLEARANCE], state[i, POSE_CLEARANCE] = lowest, after
        if fraction < 1.0:
            state[i, IN_CONTACT] = 1.0
            state[i, CLEARANCE] = after  # the robot does not reach the rest of the arc
            state[i, REMAINING] = state[i, DURATION] * (1.0 - fraction)
            distance *= fraction
            turn *= fraction
        driven = state[i, DURATION] * fraction
        if wheels:
            state[i, EFFORT] += control_effort(sim.tasks, sim.robots[i, :2], i) * driven
        else:
            state[i, EFFORT] += effort(sim.tasks, i, state[i, SPEED] ** 2, state[i, TURN_RATE] ** 2) * driven
        if driven > 0.0:
            state[i, PROXIMITY] += arc_proximity(x, y, heading, distance, turn, lowest, field) * driven
        chord, middle = distance * sinc(turn / 2), heading + turn / 2
        bodies[i, 3], bodies[i, 4], bodies[i, 5] = chord * math.cos(middle), chord * math.sin(middle), turn
    return -1


@kernel(types.UniTuple(float64, 3)(float64, float64, float64, float64, float64, float64, float64, VECTOR))
def wheel_forces(vx, vy, heading, spin, speed, turn_rate, duration, settings):
    """Return the force (x, y) (N) and the torque (N m) on a robot whose motors track the commanded wheel speeds.

    The motors reduce the deviation from the commanded motion, each with at most its maximum force. The tyres remove the
    lateral velocity with at most their grip.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    mass, half = settings[MASS], settings[TRACK] / 2
    response = max(settings[RESPONSE], duration)
    ahead, aside = cos * vx + sin * vy, cos * vy - sin * vx
    push = mass * (speed - ahead) / response / 2
    twist = settings[MOMENT] * (turn_rate - spin) / response / (2 * half)
    limit = settings[WHEEL_FORCE]
    right, left = min(max(push + twist, -limit), limit), min(max(push - twist, -limit), limit)
    grip = settings[GRIP] * mass * GRAVITY
    across = min(max(-mass * aside / duration, -grip), grip)
    along = right + left
    return cos * along - sin * across, sin * along + cos * across, half * (right - left)


# The kernels of a substep take the arrays that they use: Numba takes twice as long to receive a tuple from Python.
@kernel(NOTHING(MATRIX, MATRIX, int64))
def read_velocities(bodies, state, substeps):
    """Read the velocities after a substep; those of a robot in contact are unchanged."""
    for i in range(len(state)):
        step = state[i, DURATION] / substeps
        if step > 0.0 and state[i, IN_CONTACT] == 0.0:
            state[i, VX], state[i, VY], state[i, SPIN] = bodies[i, 3] / step, bodies[i, 4] / step, bodies[i, 5] / step


@kernel(NOTHING(MATRIX, MATRIX, MATRIX, PLACES, VECTOR, int64, int64))
def drive_motors(bodies, state, tasks, fields, settings, substep, substeps):
    """Set velocity and force of each body for one substep, up to the first contact, and add the running cost.

    The velocities after the previous substep are read first.
    """
    if substep > 0:
        read_velocities(bodies, state, substeps)
    for i in range(len(state)):
        for column in range(3, 9):
            bodies[i, column] = 0.0
        step = state[i, DURATION] / substeps
        if step == 0.0 or state[i, IN_CONTACT] != 0.0:
            continue
        dx, dy, turn = state[i, VX] * step, state[i, VY] * step, state[i, SPIN] * step
        x, y, heading, field = bodies[i, 0], bodies[i, 1], bodies[i, 2], field_of(fields, i)
        distance, course = math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)
        lowest, fraction, after = follow_arc(x, y, course, distance, 0.0, state[i, POSE_CLEARANCE], field)
        state[i, CLEARANCE], state[i, POSE_CLEARANCE] = min(state[i, CLEARANCE], lowest), after
        speed_squared = state[i, VX] ** 2 + state[i, VY] ** 2
        state[i, EFFORT] += effort(tasks, i, speed_squared, state[i, SPIN] ** 2) * step * fraction
        state[i, PROXIMITY] += arc_proximity(x, y, course, distance * fraction, 0.0, lowest, field) * step * fraction
        bodies[i, 3], bodies[i, 4], bodies[i, 5] = dx * fraction, dy * fraction, turn * fraction
        if fraction < 1.0:
            state[i, IN_CONTACT] = 1.0
            state[i, CLEARANCE] = after  # the robot does not reach the rest of the path
            state[i, REMAINING] = state[i, DURATION] - step * (substep + fraction)
            continue
        wheels = state[i, SPEED], state[i, TURN_RATE]
        fx, fy, torque = wheel_forces(state[i, VX], state[i, VY], heading, state[i, SPIN], *wheels, step, settings)
        bodies[i, 6], bodies[i, 7], bodies[i, 8] = fx * step * step, fy * step * step, torque * step * step


@kernel(boolean(int64, SIMULATION_STATE))
def at_goal(i, sim):
    """Return whether the pose of robot i equals its goal, within the tolerances."""
    bodies, tasks, settings = sim.bodies, sim.tasks, sim.settings
    dx, dy = bodies[i, 0] - tasks[i, GOAL], bodies[i, 1] - tasks[i, GOAL + 1]
    if math.hypot(dx, dy) > settings[POSITION_TOLERANCE]:
        return False
    n_motion = int(settings[N_MOTION])
    further = LIMITS + 2 * int(settings[N_CONTROLS]) + n_motion
    for k in range(n_motion):
        goal = tasks[i, further + k]
        if not math.isnan(goal) and abs(sim.robots[i, k] - goal) > settings[MOTION_TOLERANCE]:
            return False
    heading = tasks[i, GOAL + 2]
    if math.isnan(heading):
        return True
    turn = (bodies[i, 2] - heading + math.pi) % (2 * math.pi) - math.pi
    return abs(turn) <= settings[HEADING_TOLERANCE]


@kernel(NOTHING(FLAGS, PACKED_STATE))
def end_periods(active, packed):
    """Complete a period: update time, cost and reward, and determine whether the episode has ended."""
    sim = SimulationState(*packed)
    state, settings = sim.state, sim.settings
    free = settings[FREE_HORIZON] != 0.0
    for i in range(len(state)):
        if not active[i]:
            continue
        state[i, STEPS] += 1.0
        state[i, TIME] = min(state[i, STEPS] * settings[PERIOD], sim.tasks[i, HORIZON])
        state[i, COST] += state[i, EFFORT] + state[i, PROXIMITY]
        if free:
            state[i, TIME_COST] = state[i, TIME_WEIGHT] * state[i, DURATION]
            state[i, COST] += state[i, TIME_COST]
        if state[i, IN_CONTACT] != 0.0 and state[i, COLLIDED] == 0.0:
            state[i, COLLISION] = settings[COLLISION_PENALTY]
            state[i, COLLIDED] = 1.0
        last = state[i, STEPS] >= state[i, LAST_STEP]
        reached = (free or last) and at_goal(i, sim)
        state[i, SUCCESS] = 1.0 if reached and state[i, COLLIDED] == 0.0 else 0.0
        ended = (reached if free else last) or (state[i, COLLIDED] != 0.0 and settings[TERMINATE_ON_COLLISION] != 0.0)
        state[i, TERMINATED] = 1.0 if ended else 0.0
        state[i, TRUNCATED] = 1.0 if free and last and not ended else 0.0
        if ended and not reached:
            state[i, MISS] = settings[MISS_PENALTY]
        reward = -state[i, EFFORT] - state[i, PROXIMITY] - state[i, COLLISION] - state[i, MISS]
        if free:
            reward -= state[i, TIME_COST]
        if settings[SHAPED] != 0.0:
            after = 0.0 if ended else potential(i, sim)
            state[i, SHAPING] = settings[DISCOUNT] * after - state[i, POTENTIAL]
            state[i, POTENTIAL] = after
            reward += state[i, SHAPING]
        state[i, REWARD] = reward
