"""The discretised problem of a scenario: cost, constraints, and their second-order expansion (kernels).

Constant controls on each of N intervals move the robot along exact circular arcs; the proximity cost is integrated by
the trapezoidal rule.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.envs.shapes.proximity import proximity
from leapnav.experts.numerics.flow import END_CONDITION, EndCondition


class DiscreteProblem(NamedTuple):
    """The discretised problem, with costs in units of the speed weight.

    Attributes:
        h: (N,), durations of the intervals (s).
        end: conditions at the horizon.
        turn_weight: turn weight / speed weight.
        unit: 1 / speed weight, the factor of the proximity cost.
        limits: (2,), largest speed (m/s) and turn rate (rad/s).
        field: packed obstacle field.

    """

    h: np.ndarray
    end: EndCondition
    turn_weight: float
    unit: float
    limits: np.ndarray
    field: np.ndarray


class Evaluation(NamedTuple):
    """What cost, constraints and expansion of a path have in common.

    Attributes:
        proximity: (N + 1, 6), proximity cost, its gradient and Hessian (x, y, xx, xy, yy) at the states.
        chords: (N, 5), of the arcs: cosine and sine of the heading, and chord / arc length with two derivatives.

    """

    proximity: np.ndarray
    chords: np.ndarray


class Expansion(NamedTuple):
    """The second-order expansion about a path.

    Attributes:
        dphi: (N + 1, 5), gradient and Hessian (x, y, xx, xy, yy) of the weighted proximity cost.
        A: (N, 2), derivatives of the next x and y with respect to the heading.
        B: (N, 2, 2), derivatives of the next x and y with respect to the controls.
        defects: (N, 3), violations of the dynamics.
        W: (N, 3, 3), Hessian of costates times dynamics in (theta, v, omega).

    """

    dphi: np.ndarray
    A: np.ndarray
    B: np.ndarray
    defects: np.ndarray
    W: np.ndarray


DISCRETE_PROBLEM = record_type(
    DiscreteProblem, h=VECTOR, end=END_CONDITION, turn_weight=float64, unit=float64, limits=CONSTANT, field=CONSTANT
)
EVALUATION = record_type(Evaluation, proximity=MATRIX, chords=MATRIX)
EXPANSION = record_type(Expansion, dphi=MATRIX, A=MATRIX, B=CUBE, defects=MATRIX, W=CUBE)


@kernel(tuple_of(*[float64] * 4)(float64, float64, float64))
def arc_chord(h, omega, theta):
    """Return the heading of an arc's chord, and chord / arc length with two derivatives by omega (by a series)."""
    a = 0.5 * h * omega
    if abs(a) < 0.5:
        square = a * a
        s = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        s1 = -a / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0))
        s2 = -1.0 / 3.0 * (1.0 - 0.3 * square * (1.0 - square * 5.0 / 84.0))
    else:
        s = math.sin(a) / a
        s1 = (math.cos(a) - s) / a
        s2 = -s - 2.0 * s1 / a
    return theta + a, s, 0.5 * h * s1, 0.25 * h * h * s2


@kernel(NOTHING(DISCRETE_PROBLEM, MATRIX, MATRIX, EVALUATION))
def evaluate(problem, q, u, evaluation):
    """Fill the evaluation of a path q (N + 1, 3), u (N, 2)."""
    terms, chords = evaluation.proximity, evaluation.chords
    for k in range(len(q)):
        terms[k, 0], terms[k, 1], terms[k, 2], terms[k, 3], terms[k, 4], terms[k, 5] = proximity(
            q[k, 0], q[k, 1], problem.field
        )
    for k in range(len(u)):
        heading, chords[k, 2], chords[k, 3], chords[k, 4] = arc_chord(problem.h[k], u[k, 1], q[k, 2])
        chords[k, 0], chords[k, 1] = math.cos(heading), math.sin(heading)


@kernel(float64(DISCRETE_PROBLEM, MATRIX, EVALUATION))
def discrete_cost(problem, u, evaluation):
    """Return J of an evaluated path with the controls u (N, 2), in units of the speed weight."""
    h, turn_weight, unit = problem.h, problem.turn_weight, problem.unit
    intervals = len(h)
    cost = 0.0
    for k in range(intervals + 1):
        weight = 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        cost += unit * weight * evaluation.proximity[k, 0]
    for k in range(intervals):
        cost += 0.5 * h[k] * (u[k, 0] * u[k, 0] + turn_weight * u[k, 1] * u[k, 1])
    return cost


@kernel(tuple_of(*[float64] * 3)(DISCRETE_PROBLEM, MATRIX, MATRIX, EVALUATION, MATRIX, VECTOR))
def violations(problem, q, u, evaluation, multipliers, end_multipliers):
    """Return sums over the constraint violations: absolute values, products with the multipliers, and squares."""
    h, goal, free, chords = problem.h, problem.end.goal, problem.end.free, evaluation.chords
    intervals = len(h)
    violation, weighted, squares = 0.0, 0.0, 0.0
    for k in range(intervals):
        chord = h[k] * u[k, 0] * chords[k, 2]
        defect_x = q[k, 0] + chord * chords[k, 0] - q[k + 1, 0]
        defect_y = q[k, 1] + chord * chords[k, 1] - q[k + 1, 1]
        defect_theta = q[k, 2] + h[k] * u[k, 1] - q[k + 1, 2]
        violation += abs(defect_x) + abs(defect_y) + abs(defect_theta)
        squares += defect_x * defect_x + defect_y * defect_y + defect_theta * defect_theta
        row = multipliers[k + 1]
        weighted += row[0] * defect_x + row[1] * defect_y + row[2] * defect_theta
    for i in range(3):
        if not free[i]:
            end_error = q[intervals, i] - goal[i]
            violation += abs(end_error)
            squares += end_error * end_error
            weighted += end_multipliers[i] * end_error
    return violation, weighted, squares


@kernel(NOTHING(DISCRETE_PROBLEM, MATRIX, MATRIX, EVALUATION, MATRIX, EXPANSION))
def expand(problem, q, u, evaluation, costates, expansion):
    """Fill the second-order expansion about an evaluated path."""
    h, unit, terms, chords = problem.h, problem.unit, evaluation.proximity, evaluation.chords
    dphi, A, B, defects, W = expansion.dphi, expansion.A, expansion.B, expansion.defects, expansion.W
    intervals = len(h)
    for k in range(intervals + 1):
        weight = unit * 0.5 * ((h[k] if k < intervals else 0.0) + (h[k - 1] if k > 0 else 0.0))
        for j in range(5):
            dphi[k, j] = weight * terms[k, 1 + j]
    for k in range(intervals):
        c, d, s, s1, s2 = chords[k, 0], chords[k, 1], chords[k, 2], chords[k, 3], chords[k, 4]
        v, omega, half = u[k, 0], u[k, 1], 0.5 * h[k]
        distance = h[k] * v
        defects[k, 0] = q[k, 0] + distance * s * c - q[k + 1, 0]
        defects[k, 1] = q[k, 1] + distance * s * d - q[k + 1, 1]
        defects[k, 2] = q[k, 2] + h[k] * omega - q[k + 1, 2]
        A[k, 0], A[k, 1] = -distance * s * d, distance * s * c
        B[k, 0, 0], B[k, 0, 1] = h[k] * s * c, distance * (s1 * c - half * s * d)
        B[k, 1, 0], B[k, 1, 1] = h[k] * s * d, distance * (s1 * d + half * s * c)
        along = costates[k + 1, 0] * c + costates[k + 1, 1] * d
        across = costates[k + 1, 1] * c - costates[k + 1, 0] * d
        W[k, 0, 0] = -distance * s * along
        W[k, 0, 1] = W[k, 1, 0] = h[k] * s * across
        W[k, 0, 2] = W[k, 2, 0] = distance * (s1 * across - half * s * along)
        W[k, 1, 1] = 0.0
        W[k, 1, 2] = W[k, 2, 1] = h[k] * (s1 * along + half * s * across)
        W[k, 2, 2] = distance * (s2 * along + 2.0 * s1 * half * across - s * half * half * along)
