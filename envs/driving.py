"""A control period of many robots as compiled kernels: how they drive, what it costs, and how an episode ends.

Two arrays hold all episodes: `bodies`, as `FreeBodies` describes it, and `state`, whose columns are named here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, njit, types

from leapnav.envs.obstacles import clearance, follow_arc, proximity_value, sinc
from leapnav.envs.scenario import GOAL, HORIZON, MAX_SPEED, MAX_TURN_RATE, SPEED_WEIGHT, START, TURN_WEIGHT
from leapnav.envs.settings import (
    ACTUATION_NOISE,
    COLLISION_PENALTY,
    DISCOUNT,
    ENDS_ON_TOUCH,
    GRIP,
    HEADING_TOLERANCE,
    MASS,
    MISS_PENALTY,
    MOMENT,
    PERIOD,
    POSITION_TOLERANCE,
    RESPONSE,
    SHAPED,
    SLIP,
    TRACK,
    WHEEL_FORCE,
)

(
    STEPS,  # control periods driven
    LAST_STEP,  # control periods of the episode
    TIME,  # s
    COST,  # J so far
    HERE,  # clearance of the pose, m
    CLEARANCE,  # smallest clearance of the period, m
    COLLIDED,  # whether anything was touched in the episode
    TOUCHED,  # whether anything was touched in this period
    REMAINING,  # s of the period that are left when a touch ends the free part
    SUCCESS,
    TERMINATED,
    SPEED,  # of the wheels, m/s and rad/s, as commanded and disturbed
    TURN_RATE,
    DURATION,  # of the period, s
    VX,  # m/s and rad/s; what the robot is driven with in a period in "velocity"
    VY,
    SPIN,
    EFFORT,  # parts of the reward, positive where they are paid
    PROXIMITY,
    COLLISION,
    MISS,
    SHAPING,
    REWARD,
    POTENTIAL,  # of the state, for the shaped reward
    COLUMNS,
) = range(25)

GUIDES = 17  # points of the way along the reference, for the potential
_field = types.Array(types.float64, 1, "C", readonly=True)
_options = {"cache": True, "error_model": "numpy", "nogil": True}


@njit(float64(float64, float64, float64, float64, float64, _field), **_options)
def arc_proximity(x, y, heading, distance, turn, field):
    """Mean of Phi along an arc, by the three-point Gauss rule."""
    total = 0.0
    for share, weight in ((0.1127016653792583, 5 / 18), (0.5, 8 / 18), (0.8872983346207417, 5 / 18)):
        chord = distance * share * sinc(turn * share / 2)
        middle = heading + turn * share / 2
        total += weight * proximity_value(x + chord * math.cos(middle), y + chord * math.sin(middle), field)
    return total


@njit(types.none(float64[::1], float64[::1], float64, float64, float64), **_options)
def charge(row, task, speed_squared, turn_rate_squared, duration):
    """Adds the effort of a motion."""
    row[EFFORT] += 0.5 * (task[SPEED_WEIGHT] * speed_squared + task[TURN_WEIGHT] * turn_rate_squared) * duration


@njit(float64(float64[::1], float64[::1], float64[::1], float64[:, ::1], float64[::1]), **_options)
def potential(body, state, task, guides, settings):
    """Minus a cheap estimate of the cost-to-go: the way along the reference at an even pace, at most a miss.

    Any function of the state would leave the optimal policy as it is (Ng, Harada and Russell, 1999); a good estimate
    makes it quick to find. `guides` (GUIDES, 3) are points with the way (m) from there to the goal.
    """
    way = np.inf
    for k in range(len(guides)):
        dx, dy = guides[k, 0] - body[0], guides[k, 1] - body[1]
        way = min(way, math.sqrt(dx * dx + dy * dy) + guides[k, 2])
    heading = task[GOAL + 2]
    turn = 0.0 if math.isnan(heading) else (heading - body[2] + math.pi) % (2 * math.pi) - math.pi
    time = max(task[HORIZON] - state[TIME], settings[PERIOD])
    estimate = 0.5 * (task[SPEED_WEIGHT] * way * way + task[TURN_WEIGHT] * turn * turn) / time
    return -min(estimate, settings[MISS_PENALTY])


@njit(
    types.none(
        int64[::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, :, ::1],
        float64[::1],
    ),
    **_options,
)
def start_episodes(robots, bodies, state, tasks, fields, guides, settings):
    """Puts robots, given by number, at the start of their tasks."""
    for i in robots:
        bodies[i] = 0.0
        bodies[i, 0:3] = tasks[i, START : START + 3]
        state[i] = 0.0
        # A remainder of less than a millionth of a period is rounding of the horizon, not a period of its own.
        state[i, LAST_STEP] = max(1.0, math.ceil(tasks[i, HORIZON] / settings[PERIOD] - 1e-6))
        state[i, HERE] = clearance(bodies[i, 0], bodies[i, 1], fields[i])[0]
        state[i, CLEARANCE] = state[i, HERE]
        if settings[SHAPED] != 0.0:
            state[i, POTENTIAL] = potential(bodies[i], state[i], tasks[i], guides[i], settings)


@njit(
    int64(
        float64[:, ::1], boolean[::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], int64[::1], float64[::1]
    ),
    **_options,
)
def command(actions, active, state, tasks, noise, noise_rows, settings):
    """Sets the wheels' speeds for a period, in which those that are not active stand still for no time at all.

    Returns -1, or the number of the first active robot whose action is not finite; nothing is set then.
    """
    for i in range(len(state)):
        if active[i] and not (math.isfinite(actions[i, 0]) and math.isfinite(actions[i, 1])):
            return i
    disturbed = settings[ACTUATION_NOISE] != 0.0 or settings[SLIP] != 0.0
    for i in range(len(state)):
        row = state[i]
        row[TOUCHED] = row[EFFORT] = row[PROXIMITY] = row[COLLISION] = row[MISS] = row[SHAPING] = 0.0
        row[REMAINING] = row[REWARD] = row[SPEED] = row[TURN_RATE] = row[DURATION] = 0.0
        row[CLEARANCE] = row[HERE]
        if not active[i]:
            continue
        speed = min(max(actions[i, 0], -1.0), 1.0) * tasks[i, MAX_SPEED]
        turn_rate = min(max(actions[i, 1], -1.0), 1.0) * tasks[i, MAX_TURN_RATE]
        if disturbed:
            drawn = noise[i, noise_rows[i]]
            speed *= 1.0 + settings[ACTUATION_NOISE] * drawn[0]
            turn_rate *= 1.0 + settings[ACTUATION_NOISE] * drawn[1]
            half = settings[TRACK] / 2
            right = (speed + half * turn_rate) * (1.0 - min(settings[SLIP] * abs(drawn[2]), 1.0))
            left = (speed - half * turn_rate) * (1.0 - min(settings[SLIP] * abs(drawn[3]), 1.0))
            speed, turn_rate = (right + left) / 2, (right - left) / (2 * half)
        row[SPEED], row[TURN_RATE] = speed, turn_rate
        row[DURATION] = max(min(settings[PERIOD], tasks[i, HORIZON] - row[TIME]), 0.0)
    return -1


@njit(
    types.none(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1]),
    **_options,
)
def drive_arcs(bodies, state, tasks, fields, settings):
    """Gives each free body the velocity of its period, up to a touch, and charges for it.

    The exact arc of a command is a chord of length v h sinc(omega h / 2) at the mean heading. A body that is given the
    chord as its velocity ends where the arc ends, because Chipmunk moves bodies by an Euler step.
    """
    for i in range(len(state)):
        row, body = state[i], bodies[i]
        body[3] = body[4] = body[5] = 0.0
        if row[DURATION] == 0.0:
            continue
        distance, turn = row[SPEED] * row[DURATION], row[TURN_RATE] * row[DURATION]
        lowest, share, after = follow_arc(body[0], body[1], body[2], distance, turn, row[HERE], fields[i])
        row[CLEARANCE], row[HERE] = lowest, after
        if share < 1.0:
            row[TOUCHED] = 1.0
            row[REMAINING] = row[DURATION] * (1.0 - share)
            distance *= share
            turn *= share
        charge(row, tasks[i], row[SPEED] ** 2, row[TURN_RATE] ** 2, row[DURATION] * share)
        if row[DURATION] * share > 0.0:
            near = arc_proximity(body[0], body[1], body[2], distance, turn, fields[i])
            row[PROXIMITY] += near * row[DURATION] * share
        chord, middle = distance * sinc(turn / 2), body[2] + turn / 2
        body[3], body[4], body[5] = chord * math.cos(middle), chord * math.sin(middle), turn


@njit(
    types.UniTuple(float64, 3)(float64, float64, float64, float64, float64, float64, float64, float64[::1]), **_options
)
def wheel_forces(vx, vy, heading, spin, speed, turn_rate, duration, settings):
    """Force (x, y) in N and torque in N m on a robot whose motors hold the wheels' commanded speeds.

    The motors work against the difference to the commanded motion, each up to its force; the tyres take away the speed
    sideways as far as they grip.
    """
    cos, sin = math.cos(heading), math.sin(heading)
    mass, half = settings[MASS], settings[TRACK] / 2
    response = max(settings[RESPONSE], duration)
    ahead, aside = cos * vx + sin * vy, cos * vy - sin * vx
    push = mass * (speed - ahead) / response / 2
    twist = settings[MOMENT] * (turn_rate - spin) / response / (2 * half)
    limit = settings[WHEEL_FORCE]
    right, left = min(max(push + twist, -limit), limit), min(max(push - twist, -limit), limit)
    grip = settings[GRIP] * mass * 9.81
    across = min(max(-mass * aside / duration, -grip), grip)
    along = right + left
    return cos * along - sin * across, sin * along + cos * across, half * (right - left)


@njit(
    types.none(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], int64, int64),
    **_options,
)
def drive_motors(bodies, state, tasks, fields, settings, piece, pieces):
    """Gives each free body velocity and force for one of a period's pieces, up to a touch, and charges for it."""
    for i in range(len(state)):
        row, body = state[i], bodies[i]
        body[3:9] = 0.0
        step = row[DURATION] / pieces
        if step == 0.0 or row[TOUCHED] != 0.0:
            continue
        dx, dy, turn = row[VX] * step, row[VY] * step, row[SPIN] * step
        distance = math.sqrt(dx * dx + dy * dy)
        course = math.atan2(dy, dx)
        lowest, share, after = follow_arc(body[0], body[1], course, distance, 0.0, row[HERE], fields[i])
        row[CLEARANCE], row[HERE] = min(row[CLEARANCE], lowest), after
        charge(row, tasks[i], row[VX] ** 2 + row[VY] ** 2, row[SPIN] ** 2, step * share)
        near = proximity_value(body[0] + dx * share / 2, body[1] + dy * share / 2, fields[i])
        row[PROXIMITY] += near * step * share
        body[3], body[4], body[5] = dx * share, dy * share, turn * share
        if share < 1.0:
            row[TOUCHED] = 1.0
            row[REMAINING] = row[DURATION] - step * (piece + share)
            continue
        fx, fy, torque = wheel_forces(row[VX], row[VY], body[2], row[SPIN], row[SPEED], row[TURN_RATE], step, settings)
        body[6], body[7], body[8] = fx * step * step, fy * step * step, torque * step * step


@njit(types.none(float64[:, ::1], float64[:, ::1], int64), **_options)
def read_velocities(bodies, state, pieces):
    """Takes the velocities after one of a period's pieces; a robot that touches keeps those that it had."""
    for i in range(len(state)):
        row = state[i]
        step = row[DURATION] / pieces
        if step > 0.0 and row[TOUCHED] == 0.0:
            row[VX], row[VY], row[SPIN] = bodies[i, 3] / step, bodies[i, 4] / step, bodies[i, 5] / step


@njit(boolean(float64[::1], float64[::1], float64[::1]), **_options)
def at_goal(pose, task, settings):
    """Whether a pose is the goal's, within the tolerances."""
    dx, dy = pose[0] - task[GOAL], pose[1] - task[GOAL + 1]
    if math.hypot(dx, dy) > settings[POSITION_TOLERANCE]:
        return False
    heading = task[GOAL + 2]
    if math.isnan(heading):
        return True
    turn = (pose[2] - heading + math.pi) % (2 * math.pi) - math.pi
    return abs(turn) <= settings[HEADING_TOLERANCE]


@njit(
    types.none(
        float64[:, ::1],
        boolean[::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, :, ::1],
        float64[::1],
    ),
    **_options,
)
def end_periods(bodies, active, state, tasks, guides, settings):
    """Adds up a period: time, cost, reward, and whether the episode has ended."""
    for i in range(len(state)):
        if not active[i]:
            continue
        row, body, task = state[i], bodies[i], tasks[i]
        row[STEPS] += 1.0
        row[TIME] = min(row[STEPS] * settings[PERIOD], task[HORIZON])
        row[COST] += row[EFFORT] + row[PROXIMITY]
        if row[TOUCHED] != 0.0 and row[COLLIDED] == 0.0:
            row[COLLISION] = settings[COLLISION_PENALTY]
            row[COLLIDED] = 1.0
        last = row[STEPS] >= row[LAST_STEP]
        reached = at_goal(body, task, settings)
        row[SUCCESS] = 1.0 if last and reached and row[COLLIDED] == 0.0 else 0.0
        ended = last or (row[COLLIDED] != 0.0 and settings[ENDS_ON_TOUCH] != 0.0)
        row[TERMINATED] = 1.0 if ended else 0.0
        if ended and not (last and reached):
            row[MISS] = settings[MISS_PENALTY]
        reward = -row[EFFORT] - row[PROXIMITY] - row[COLLISION] - row[MISS]
        if settings[SHAPED] != 0.0:
            after = 0.0 if ended else potential(body, row, task, guides[i], settings)
            row[SHAPING] = settings[DISCOUNT] * after - row[POTENTIAL]
            row[POTENTIAL] = after
            reward += row[SHAPING]
        row[REWARD] = reward
