"""One control period of many robots (kernels): motion, running cost, reward, and end of the episode.

The kernels take the places of the arrays of `Simulation`, and read and write these arrays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import matrix_of, record_at
from leapnav.envs.kernels.types import FLAGS, INTEGERS, MATRIX, NOTHING, PLACES, VECTOR
from leapnav.envs.settings import MOTOR_TYPE
from leapnav.envs.simulation.paths import ADDRESSES, MOTION, Path, drive_path, motion_at
from leapnav.envs.simulation.state import SIMULATION, field_of, row_of

GRAVITY = 9.81  # m/s^2
# Of a graded miss: fraction of the penalty that any miss costs, without which a success would return hardly more than a
# close miss, and fraction per m of distance and per rad of heading error.
MIN_MISS_FRACTION, MISS_FRACTION_SLOPE = 0.2, 0.1


@kernel(MATRIX(SIMULATION, int64), forceinline=True)
def outline_of(sim, i):
    """Return the outline (K, 5) of robot i, a view."""
    rows, entries = sim.outlines.shape[1], sim.outlines.shape[2]
    return matrix_of(sim.outlines, rows * entries * i, rows, entries)


@kernel(float64(float64))
def wrapped(angle):
    """Return an angle (rad) between -pi and pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@kernel(float64(VECTOR, VECTOR))
def effort(weights, controls):
    """Return the running cost of the controls (m,)."""
    total = 0.0
    for j in range(len(controls)):
        total += weights[j] * controls[j] ** 2
    return 0.5 * total


@kernel(float64(int64, SIMULATION))
def potential(i, sim):
    """Return minus an estimate of the cost-to-go of robot i: following the reference path at constant speed.

    If the horizon is free, the speed is the one with the lowest cost. The estimate is at most the miss penalty. Any
    function of the state leaves the optimal policy unchanged (Ng, Harada and Russell, 1999); a good estimate makes it
    easier to learn.
    """
    episode, state, guides, settings = sim.episodes[i], row_of(sim.states, i), sim.guides, sim.settings[0]
    length = np.inf
    for k in range(guides.shape[1]):
        dx, dy = guides[i, k, 0] - state[0], guides[i, k, 1] - state[1]
        length = min(length, math.sqrt(dx * dx + dy * dy) + guides[i, k, 2])
    heading = sim.goals[i, 2]
    turn = 0.0 if math.isnan(heading) else wrapped(heading - state[2])
    square = episode.speed_weight * (length * length) + episode.turn_weight * (turn * turn)
    if settings.free_horizon:
        estimate = math.sqrt(2.0 * episode.time_weight * square)
    else:
        estimate = 0.5 * square / max(episode.horizon - episode.time, settings.control_period)
    return -min(estimate, settings.miss_penalty)


@kernel(NOTHING(int64, SIMULATION))
def measure_miss(i, sim):
    """Set how far the pose of robot i is from its goal."""
    state, goal, episode = row_of(sim.states, i), row_of(sim.goals, i), sim.episodes[i]
    episode.goal_distance = math.hypot(state[0] - goal[0], state[1] - goal[1])
    episode.heading_error = 0.0 if math.isnan(goal[2]) else abs(wrapped(state[2] - goal[2]))


@kernel(NOTHING(INTEGERS, PLACES))
def start_episodes(robots, places):
    """Start the episodes of robots, given by index, whose states and tasks are set."""
    sim = record_at(places, SIMULATION)
    settings = sim.settings[0]
    for i in robots:
        episode, state = sim.episodes[i], row_of(sim.states, i)
        # A remainder of less than 1e-6 periods is a rounding error of the horizon, not another period.
        episode.last_step = max(1, math.ceil(episode.horizon / settings.control_period - 1e-6))
        clearance, _ = footprint_clearance(state, outline_of(sim, i), field_of(sim.fields, i))
        episode.pose_clearance = episode.clearance = clearance
        measure_miss(i, sim)
        if settings.shaped:
            episode.potential = potential(i, sim)


@kernel(NOTHING(SIMULATION, int64, VECTOR), forceinline=True)
def _disturb(sim, i, controls):
    """Change the controls of robot i by actuation noise and slip.

    If the controls are speed and turn rate, the slip is that of two wheels, see `Disturbance`.
    """
    settings, m = sim.settings[0], len(controls)
    noise = sim.noise[i, sim.episodes[i].steps % sim.noise.shape[1]]
    slip = settings.disturbance.slip
    for j in range(m):
        controls[j] *= 1.0 + settings.disturbance.actuation * noise[j]
    if settings.commands_motion:
        half = settings.motor.track / 2
        right = (controls[0] + half * controls[1]) * (1.0 - min(slip * abs(noise[2]), 1.0))
        left = (controls[0] - half * controls[1]) * (1.0 - min(slip * abs(noise[3]), 1.0))
        controls[0], controls[1] = (right + left) / 2, (right - left) / (2 * half)
        return
    for j in range(m):
        controls[j] *= 1.0 - min(slip * abs(noise[m + j]), 1.0)


@kernel(int64(MATRIX, FLAGS, SIMULATION), forceinline=True)
def _begin_periods(actions, active, sim):
    """Begin a period, and set the controls; for robots that are not active, its duration is 0.

    Returns:
        See `drive`.

    """
    settings = sim.settings[0]
    for i in range(len(active)):
        if active[i]:
            for j in range(actions.shape[1]):
                if not math.isfinite(actions[i, j]):
                    return i
    for i in range(len(active)):
        episode, controls = sim.episodes[i], row_of(sim.controls, i)
        episode.in_contact, episode.remaining, episode.duration = False, 0.0, 0.0
        episode.effort = episode.proximity = episode.time_cost = episode.collision = episode.miss = 0.0
        episode.shaping = episode.reward = 0.0
        episode.clearance = episode.pose_clearance
        controls[:] = 0.0
        if not active[i]:
            continue
        episode.duration = max(min(settings.control_period, episode.horizon - episode.time), 0.0)
        for j in range(len(controls)):
            controls[j] = sim.middles[i, j] + min(max(actions[i, j], -1.0), 1.0) * sim.halves[i, j]
        if settings.disturbance.actuation != 0.0 or settings.disturbance.slip != 0.0:
            _disturb(sim, i, controls)
    return -1


@kernel(int64(MATRIX, FLAGS, PLACES))
def begin_periods(actions, active, places):
    """Begin a period of robots with motors, see `_begin_periods`."""
    return _begin_periods(actions, active, record_at(places, SIMULATION))


@kernel(float64(SIMULATION, int64, MOTION, VECTOR, float64, float64, MATRIX), forceinline=True)
def _follow(sim, i, motion, u, time, duration, scratch):
    """Move robot i with controls u for a duration (s), up to the first contact, and add the proximity and state cost.

    It begins at a time (s) of the episode. The rows of `scratch` (7 or more, n + 1) are those of `Path.samples`, and
    two for the states at both ends.

    Returns:
        The fraction of the duration before the contact, or 1.

    """
    episode, state, n = sim.episodes[i], row_of(sim.states, i), sim.states.shape[1]
    q, new = scratch[5], scratch[6]
    for k in range(n):
        q[k] = state[k]
    q[n] = time
    field = field_of(sim.fields, i)
    path = Path(motion, q, u, row_of(sim.parameters, i), outline_of(sim, i), field, duration, scratch)
    lowest, fraction, after, proximity, state_cost = drive_path(path, episode.pose_clearance, new)
    episode.in_contact = fraction < 1.0
    # A robot in contact does not reach the rest of the path.
    episode.clearance = after if episode.in_contact else min(episode.clearance, lowest)
    episode.pose_clearance = after
    episode.proximity += proximity
    episode.effort += state_cost
    for k in range(n):
        state[k] = new[k]
    return fraction


@kernel(boolean(int64, SIMULATION))
def at_goal(i, sim):
    """Return whether the state of robot i equals its goal, within the tolerances."""
    state, goal, settings = row_of(sim.states, i), row_of(sim.goals, i), sim.settings[0]
    if math.hypot(state[0] - goal[0], state[1] - goal[1]) > settings.position_tolerance:
        return False
    for k in range(3, len(goal)):
        difference = state[k] - goal[k]
        if settings.heading_states >> k & 1:
            difference = wrapped(difference)
        if not math.isnan(goal[k]) and abs(difference) > settings.motion_tolerance:
            return False
    return math.isnan(goal[2]) or abs(wrapped(state[2] - goal[2])) <= settings.heading_tolerance


@kernel(NOTHING(int64, SIMULATION), forceinline=True)
def _end_period(i, sim):
    """Complete a period of robot i: update time, cost and reward, and determine whether the episode has ended."""
    episode, settings = sim.episodes[i], sim.settings[0]
    episode.steps += 1
    episode.time = min(episode.steps * settings.control_period, episode.horizon)
    if settings.free_horizon:
        episode.time_cost = episode.time_weight * episode.duration
    episode.cost += episode.effort + episode.proximity + episode.time_cost
    if episode.in_contact and not episode.collided:
        episode.collision = settings.collision_penalty
        episode.collided = True
    last = episode.steps >= episode.last_step
    reached = (settings.free_horizon or last) and at_goal(i, sim)
    episode.success = reached and not episode.collided
    ended = (reached if settings.free_horizon else last) or (episode.collided and settings.terminate_on_collision)
    episode.terminated = ended
    episode.truncated = settings.free_horizon and last and not ended
    measure_miss(i, sim)
    if ended and not reached:
        away = episode.goal_distance + episode.heading_error
        graded = min(1.0, MIN_MISS_FRACTION + MISS_FRACTION_SLOPE * away)
        episode.miss = settings.miss_penalty * (graded if settings.graded_miss else 1.0)
    episode.reward = -episode.effort - episode.proximity - episode.collision - episode.miss - episode.time_cost
    if settings.shaped:
        after = 0.0 if ended else potential(i, sim)
        episode.shaping = settings.discount * after - episode.potential
        episode.potential = after
        episode.reward += episode.shaping
    episode.reward *= settings.reward_scale


@kernel(NOTHING(FLAGS, PLACES))
def end_periods(active, places):
    """Complete a period of robots with motors or in contact, see `_end_period`."""
    sim = record_at(places, SIMULATION)
    for i in range(len(active)):
        if active[i]:
            _end_period(i, sim)


@kernel(int64(MATRIX, FLAGS, PLACES, ADDRESSES))
def drive(actions, active, places, addresses):
    """Drive robots without motors for a period, up to the first contact, and add the running cost.

    The period is completed, see `_end_period`, except that of robots that continue in contact.

    Args:
        actions (count, m): from -1 to 1, the lowest to the highest controls.
        active (count,): the robots that drive.
        places: of the episodes, see `places_of`.
        addresses: see `motion_at`.

    Returns:
        -1, or the index of the first active robot whose action is not finite; nothing is changed then.

    """
    sim = record_at(places, SIMULATION)
    invalid = _begin_periods(actions, active, sim)
    if invalid >= 0:
        return invalid
    scratch, motion, settings = np.empty((7, sim.states.shape[1] + 1)), motion_at(addresses), sim.settings[0]
    for i in range(len(active)):
        episode, controls = sim.episodes[i], row_of(sim.controls, i)
        if episode.duration > 0.0:
            fraction = _follow(sim, i, motion, controls, episode.time, episode.duration, scratch)
            episode.effort += effort(row_of(sim.weights, i), controls) * episode.duration * fraction
            episode.remaining = episode.duration * (1.0 - fraction)
        if active[i] and (settings.terminate_on_collision or not episode.remaining > 0.0):
            _end_period(i, sim)
    return -1


@kernel(types.UniTuple(float64, 3)(VECTOR, float64, VECTOR, float64, MOTOR_TYPE))
def wheel_forces(velocity, heading, controls, duration, motor):
    """Return the force (x, y) (N) and the torque (N m) on a robot whose motors track the commanded wheel speeds.

    The motors reduce the deviation from the commanded motion, each with at most its maximum force. The tyres remove the
    lateral velocity with at most their grip.

    Args:
        velocity (3,): vx, vy (m/s) and turn rate (rad/s).
        heading: rad.
        controls (2,): commanded speed (m/s) and turn rate (rad/s).
        duration: of the step (s).
        motor: see `leapnav.envs.settings.Motor`.

    """
    vx, vy, spin = velocity[0], velocity[1], velocity[2]
    cos, sin = math.cos(heading), math.sin(heading)
    mass, half, limit = motor.mass, motor.track / 2, motor.wheel_force
    response = max(motor.response, duration)
    ahead, aside = cos * vx + sin * vy, cos * vy - sin * vx
    push = mass * (controls[0] - ahead) / response / 2
    twist = motor.moment * (controls[1] - spin) / response / (2 * half)
    right, left = min(max(push + twist, -limit), limit), min(max(push - twist, -limit), limit)
    grip = motor.grip * mass * GRAVITY
    across = min(max(-mass * aside / duration, -grip), grip)
    along = right + left
    return cos * along - sin * across, sin * along + cos * across, half * (right - left)


@kernel(NOTHING(MATRIX, SIMULATION, int64), forceinline=True)
def _read_bodies(bodies, sim, substeps):
    """Read the poses and velocities of bodies after a substep; those of a robot in contact are unchanged."""
    for i in range(len(bodies)):
        episode = sim.episodes[i]
        step = episode.duration / substeps
        if step > 0.0 and not episode.in_contact:
            for k in range(3):
                sim.states[i, k] = bodies[i, k]
            episode.vx, episode.vy, episode.spin = bodies[i, 3] / step, bodies[i, 4] / step, bodies[i, 5] / step


@kernel(NOTHING(MATRIX, PLACES, ADDRESSES, int64, int64))
def push_bodies(bodies, places, addresses, substep, substeps):
    """Read the bodies of robots with motors after the last substep, and set their velocities and forces for the next.

    Contacts are searched along the motion of the next substep, and the running cost is added.

    Args:
        bodies (count, 9): see `MotorBodies`.
        places: of the episodes, see `places_of`.
        addresses: see `motion_at`; of `coast`.
        substep, substeps: number of the next substep, and of all in a period; after the last one both are equal.

    """
    sim, motion = record_at(places, SIMULATION), motion_at(addresses)
    if substep > 0:
        _read_bodies(bodies, sim, substeps)
    if substep == substeps:
        return
    settings, scratch = sim.settings[0], np.empty((9, 4))
    velocity, moved = scratch[7, :3], scratch[8, :2]
    for i in range(len(bodies)):
        episode, body = sim.episodes[i], row_of(bodies, i)
        step = episode.duration / substeps
        for k in range(3):
            body[k], body[3 + k], body[6 + k] = sim.states[i, k], 0.0, 0.0
        if step == 0.0 or episode.in_contact:
            continue
        velocity[0], velocity[1], velocity[2] = episode.vx, episode.vy, episode.spin
        fraction = _follow(sim, i, motion, velocity, episode.time + substep * step, step, scratch)
        moved[0], moved[1] = math.sqrt(episode.vx**2 + episode.vy**2), episode.spin
        episode.effort += effort(row_of(sim.weights, i), moved) * step * fraction
        for k in range(3):
            body[3 + k] = sim.states[i, k] - body[k]
        if episode.in_contact:
            episode.remaining = episode.duration - step * (substep + fraction)
            continue
        force = wheel_forces(velocity, body[2], row_of(sim.controls, i), step, settings.motor)
        body[6], body[7], body[8] = force[0] * step * step, force[1] * step * step, force[2] * step * step
