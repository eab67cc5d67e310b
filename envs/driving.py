"""A control period of many robots as compiled kernels: how they drive, what it costs, and how an episode ends.

Two arrays hold all episodes: `bodies`, as `FreeBodies` describes it, and `state`, whose columns are named here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import boolean, float64, int64, types

from leapnav.envs.arcs import arc_proximity, follow_arc
from leapnav.envs.compiling import njit
from leapnav.envs.obstacles import clearance, sinc
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

# What infos tell: numbers, flags, and the parts of the reward that are paid.
INFOS = {"cost": COST, "clearance": CLEARANCE, "time": TIME}
FLAGS = {"collision": COLLIDED, "is_success": SUCCESS}
PARTS = {"effort": EFFORT, "proximity": PROXIMITY, "collision": COLLISION, "miss": MISS}

GUIDES = 17  # points of the way along the reference, for the potential
_field = types.Array(types.float64, 1, "C", readonly=True)
_options = {"cache": True, "error_model": "numpy", "nogil": True}


@njit(float64(float64[:, ::1], int64, float64, float64), **_options)
def effort(tasks, i, speed_squared, turn_rate_squared):
    """The running cost of robot i's motion, without the proximity cost."""
    return 0.5 * (tasks[i, SPEED_WEIGHT] * speed_squared + tasks[i, TURN_WEIGHT] * turn_rate_squared)


@njit(float64(int64, float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[::1]), **_options)
def potential(i, bodies, state, tasks, guides, settings):
    """Minus a cheap estimate of robot i's cost-to-go: the way along the reference at an even pace, at most a miss.

    Any function of the state would leave the optimal policy as it is (Ng, Harada and Russell, 1999); a good estimate
    makes it quick to find. `guides` (robots, GUIDES, 3) are points with the way (m) from there to the goal.
    """
    way = np.inf
    for k in range(guides.shape[1]):
        dx, dy = guides[i, k, 0] - bodies[i, 0], guides[i, k, 1] - bodies[i, 1]
        way = min(way, math.sqrt(dx * dx + dy * dy) + guides[i, k, 2])
    heading = tasks[i, GOAL + 2]
    turn = 0.0 if math.isnan(heading) else (heading - bodies[i, 2] + math.pi) % (2 * math.pi) - math.pi
    time = max(tasks[i, HORIZON] - state[i, TIME], settings[PERIOD])
    estimate = effort(tasks, i, way * way, turn * turn) / time
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
            state[i, POTENTIAL] = potential(i, bodies, state, tasks, guides, settings)


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
        for column in (TOUCHED, REMAINING, SPEED, TURN_RATE, DURATION):
            state[i, column] = 0.0
        for column in (EFFORT, PROXIMITY, COLLISION, MISS, SHAPING, REWARD):
            state[i, column] = 0.0
        state[i, CLEARANCE] = state[i, HERE]
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
        state[i, SPEED], state[i, TURN_RATE] = speed, turn_rate
        state[i, DURATION] = max(min(settings[PERIOD], tasks[i, HORIZON] - state[i, TIME]), 0.0)
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
        bodies[i, 3] = bodies[i, 4] = bodies[i, 5] = 0.0
        if state[i, DURATION] == 0.0:
            continue
        x, y, heading, field = bodies[i, 0], bodies[i, 1], bodies[i, 2], fields[i]
        distance, turn = state[i, SPEED] * state[i, DURATION], state[i, TURN_RATE] * state[i, DURATION]
        lowest, share, after = follow_arc(x, y, heading, distance, turn, state[i, HERE], field)
        state[i, CLEARANCE], state[i, HERE] = lowest, after
        if share < 1.0:
            state[i, TOUCHED] = 1.0
            state[i, CLEARANCE] = after  # it does not get to where the arc would have gone
            state[i, REMAINING] = state[i, DURATION] * (1.0 - share)
            distance *= share
            turn *= share
        driven = state[i, DURATION] * share
        state[i, EFFORT] += effort(tasks, i, state[i, SPEED] ** 2, state[i, TURN_RATE] ** 2) * driven
        if driven > 0.0:
            state[i, PROXIMITY] += arc_proximity(x, y, heading, distance, turn, field) * driven
        chord, middle = distance * sinc(turn / 2), heading + turn / 2
        bodies[i, 3], bodies[i, 4], bodies[i, 5] = chord * math.cos(middle), chord * math.sin(middle), turn


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
        bodies[i, 3:9] = 0.0
        step = state[i, DURATION] / pieces
        if step == 0.0 or state[i, TOUCHED] != 0.0:
            continue
        dx, dy, turn = state[i, VX] * step, state[i, VY] * step, state[i, SPIN] * step
        x, y, heading, field = bodies[i, 0], bodies[i, 1], bodies[i, 2], fields[i]
        distance, course = math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)
        lowest, share, after = follow_arc(x, y, course, distance, 0.0, state[i, HERE], field)
        state[i, CLEARANCE], state[i, HERE] = min(state[i, CLEARANCE], lowest), after
        speed_squared = state[i, VX] ** 2 + state[i, VY] ** 2
        state[i, EFFORT] += effort(tasks, i, speed_squared, state[i, SPIN] ** 2) * step * share
        state[i, PROXIMITY] += arc_proximity(x, y, course, distance * share, 0.0, field) * step * share
        bodies[i, 3], bodies[i, 4], bodies[i, 5] = dx * share, dy * share, turn * share
        if share < 1.0:
            state[i, TOUCHED] = 1.0
            state[i, CLEARANCE] = after  # it does not get to where the arc would have gone
            state[i, REMAINING] = state[i, DURATION] - step * (piece + share)
            continue
        wheels = state[i, SPEED], state[i, TURN_RATE]
        fx, fy, torque = wheel_forces(state[i, VX], state[i, VY], heading, state[i, SPIN], *wheels, step, settings)
        bodies[i, 6], bodies[i, 7], bodies[i, 8] = fx * step * step, fy * step * step, torque * step * step


@njit(types.none(float64[:, ::1], float64[:, ::1], int64), **_options)
def read_velocities(bodies, state, pieces):
    """Takes the velocities after one of a period's pieces; a robot that touches keeps those that it had."""
    for i in range(len(state)):
        step = state[i, DURATION] / pieces
        if step > 0.0 and state[i, TOUCHED] == 0.0:
            state[i, VX], state[i, VY], state[i, SPIN] = bodies[i, 3] / step, bodies[i, 4] / step, bodies[i, 5] / step


@njit(boolean(int64, float64[:, ::1], float64[:, ::1], float64[::1]), **_options)
def at_goal(i, bodies, tasks, settings):
    """Whether robot i's pose is its goal's, within the tolerances."""
    dx, dy = bodies[i, 0] - tasks[i, GOAL], bodies[i, 1] - tasks[i, GOAL + 1]
    if math.hypot(dx, dy) > settings[POSITION_TOLERANCE]:
        return False
    heading = tasks[i, GOAL + 2]
    if math.isnan(heading):
        return True
    turn = (bodies[i, 2] - heading + math.pi) % (2 * math.pi) - math.pi
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
        state[i, STEPS] += 1.0
        state[i, TIME] = min(state[i, STEPS] * settings[PERIOD], tasks[i, HORIZON])
        state[i, COST] += state[i, EFFORT] + state[i, PROXIMITY]
        if state[i, TOUCHED] != 0.0 and state[i, COLLIDED] == 0.0:
            state[i, COLLISION] = settings[COLLISION_PENALTY]
            state[i, COLLIDED] = 1.0
        last = state[i, STEPS] >= state[i, LAST_STEP]
        reached = at_goal(i, bodies, tasks, settings)
        state[i, SUCCESS] = 1.0 if last and reached and state[i, COLLIDED] == 0.0 else 0.0
        ended = last or (state[i, COLLIDED] != 0.0 and settings[ENDS_ON_TOUCH] != 0.0)
        state[i, TERMINATED] = 1.0 if ended else 0.0
        if ended and not (last and reached):
            state[i, MISS] = settings[MISS_PENALTY]
        reward = -state[i, EFFORT] - state[i, PROXIMITY] - state[i, COLLISION] - state[i, MISS]
        if settings[SHAPED] != 0.0:
            after = 0.0 if ended else potential(i, bodies, state, tasks, guides, settings)
            state[i, SHAPING] = settings[DISCOUNT] * after - state[i, POTENTIAL]
            state[i, POTENTIAL] = after
            reward += state[i, SHAPING]
        state[i, REWARD] = reward
