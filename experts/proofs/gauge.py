r"""A lower bound of the distance from a pose for 2 (E + Phi) = 1: the gauge N near the source of a proof.

The distance of the metric r_v v^2 + r_w omega^2 from the pose 0 is not smooth there, so no spline can represent it. A
gauge N with N(0) = 0 and horizontal gradient

    |grad_H N|^2 = (X N)^2 / r_v + (N_theta)^2 / r_w  <= 1,        X = cos(theta) d/dx + sin(theta) d/dy,

is at most the distance. `gauge` is the maximum of three such functions of the pose (x, y, theta) in the source's frame,

    sqrt(r_v) |(x, y)|,   sqrt(r_w) |theta|,   min(K, B) / G.

The first two have a horizontal gradient of at most 1 because the position moves with |v| and the heading with |omega|.
K is the gauge of Koranyi in logarithmic coordinates of SE(2), with a = (theta / 2) cot(theta / 2),

    u = a x + theta y / 2,    w = -theta x / 2 + a y,
    K^4 = (r_v u^2 + r_w theta^2)^2 + 16 r_v r_w w^2,

and G >= 1 is a bound of its horizontal gradient where K < B, see `gradient_bound`.

A bound of the gradient of K. Measure lengths in sqrt(r_w / r_v) and cost in r_w, so that r_v = r_w = 1. Differentiating
gives X u = a, X w = theta / 2, and, with beta = (1 - a) / theta, u_theta = beta u + w / 2, w_theta = -u / 2 + beta w.
Write r^2 = u^2 + theta^2 = K^2 c^2, (u, theta) = r (cos phi, sin phi), 4 w = K^2 t, so that c^4 + t^2 = 1, and
beta = kappa theta / 12 with 1 <= kappa <= kappa(K), since (1 - a) / theta^2 is an even power series in theta with
positive coefficients, the first of which is 1/12, and |theta| <= K. Then X K = P and K_theta = Q with

    P = c^3 cos phi + t c sin phi - kappa K^2 c^5 sin^2 phi cos phi / 12,
    Q = c^3 sin phi - t c cos phi + kappa K^2 c sin phi (c^4 cos^2 phi + t^2 / 2) / 12 + K^2 c^3 t cos phi / 8.

The terms without K^2 have squares that sum to C = c^2 = sqrt(1 - t^2). Their product with the others is

    K^2 [t c^6 sin phi cos phi (1/8 - kappa/12) + kappa c^4 t^2 sin^2 phi / 24 - kappa t^3 c^2 sin phi cos phi / 24
         - t^2 c^4 cos^2 phi / 8],

and the others have a norm of at most K^2 (kappa C^(5/2) + kappa C^(1/2) t^2 + 3 C^(3/2) |t|) / 24. For kappa <= 3/2,

    |grad_H K|^2 <= C + K^2 (C^3 |t| + 2 kappa C^2 t^2 + kappa C |t|^3) / 24
                    + K^4 (kappa C^(5/2) + kappa C^(1/2) t^2 + 3 C^(3/2) |t|)^2 / 576,

which grows with K and kappa. `gradient_bound` encloses its maximum over |t| <= 1 by interval arithmetic.

Koranyi's gauge: A. Koranyi, "Geometric properties of Heisenberg-type groups", Advances in Mathematics 56 (1985).
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

from numba import float64

from leapnav.envs.kernels import kernel, record_type
from leapnav.experts.proofs.intervals import Interval, tangent

MIN_RADIUS = 1e-4  # below, rounding errors spoil the bound
MAX_RADIUS = 2.0  # largest K / sqrt(r_w) for which `gradient_bound` is used; there kappa < 1.1 and |theta| < 2
N_PARTS = 2000  # intervals of t
SMALL_ANGLE = 1e-3  # rad, below which a = 1 - theta^2 / 12 is correct to 2e-15
ROUNDING = 1e-12  # relative margin of a bound of the gauge, 1000 times its rounding errors


@cache
def gradient_bound(radius: float) -> float:
    """Return an upper bound G of the horizontal gradient of K where K <= radius, for r_v = r_w = 1.

    Args:
        radius: K at most, in units of sqrt(r_w).

    Raises:
        ValueError: the radius is not in [MIN_RADIUS, MAX_RADIUS].

    """
    if not MIN_RADIUS <= radius <= MAX_RADIUS:
        raise ValueError(f"radius: expected a number from {MIN_RADIUS:g} to {MAX_RADIUS:g}, got {radius:g}")
    square = Interval.of(radius) * radius
    half = radius / 2
    kappa = 12.0 * (1.0 - Interval.of(half) / tangent(half)) / square
    assert kappa.high < 1.5
    largest = 1.0
    for part in range(N_PARTS):
        t = Interval(part / N_PARTS, (part + 1) / N_PARTS)
        c4 = 1.0 - t * t  # C^2
        c2 = c4.sqrt()
        c = c2.sqrt()
        product = (c4 * c2 * t + 2.0 * kappa * c4 * t * t + kappa * c2 * t * t * t) / 24.0
        norm = (kappa * c4 * c + kappa * c * t * t + 3.0 * c2 * c * t) / 24.0
        bound = c2 + square * product + square * square * norm * norm
        largest = max(largest, bound.high)
    return Interval.of(largest).sqrt().high


class Source(NamedTuple):
    """A source pose and the gauge around it.

    Attributes:
        x, y, heading: the pose (m, rad).
        speed_weight, turn_weight: r_v and r_w, both positive.
        limit: B, from MIN_RADIUS sqrt(r_w) to MAX_RADIUS sqrt(r_w).
        gradient: G, `gradient_bound(B / sqrt(r_w))`.

    """

    x: float
    y: float
    heading: float
    speed_weight: float
    turn_weight: float
    limit: float
    gradient: float


SOURCE = record_type(Source, **dict.fromkeys(Source._fields, float64))


def make_source(pose: tuple[float, float, float], metric: tuple[float, float], limit: float) -> Source:
    """Return the source at a pose (x, y, heading) for a metric (r_v, r_w), with B = `limit` or its largest value."""
    limit = min(limit, MAX_RADIUS * math.sqrt(metric[1]))
    x, y, heading = pose
    return Source(x, y, heading, *metric, limit, gradient_bound(limit / math.sqrt(metric[1])))


@kernel(float64(float64))
def half_cotangent(angle):
    """A = (angle / 2) cot(angle / 2)."""
    return 1.0 - angle * angle / 12.0 if abs(angle) < SMALL_ANGLE else 0.5 * angle / math.tan(0.5 * angle)


@kernel(float64(float64, float64))
def angle_between(angle, reference):
    """The difference of two angles in [-pi, pi)."""
    return (angle - reference + math.pi) % (2.0 * math.pi) - math.pi


@kernel(float64(float64, float64, float64, float64, float64, SOURCE))
def gauge_minimum(x, y, heading, width, angle_width, source):
    """A lower bound of the gauge over a box of poses.

    Args:
        x, y, heading: the centre of the box (m, rad).
        width, angle_width: half of its widths along x and y (m), and in the heading (rad).
        source: the source.

    """
    r_v, r_w = source.speed_weight, source.turn_weight
    dx, dy, angle = x - source.x, y - source.y, angle_between(heading, source.heading)
    near, far = max(abs(angle) - angle_width, 0.0), abs(angle) + angle_width
    apart = math.hypot(max(abs(dx) - width, 0.0), max(abs(dy) - width, 0.0))
    lowest = max(math.sqrt(r_v) * apart, math.sqrt(r_w) * near)
    if far > 3.0:  # beyond MAX_RADIUS: K exceeds B, or the angle may be across the cut at pi
        return max(lowest, (min(math.sqrt(r_w) * near, source.limit)) / source.gradient) * (1.0 - ROUNDING)
    # Enclosures of the position in the source's frame, of a, and of u and w: midpoint and half width.
    cos, sin = math.cos(source.heading), math.sin(source.heading)
    px, py = cos * dx + sin * dy, cos * dy - sin * dx
    side = (abs(cos) + abs(sin)) * width
    low, high = half_cotangent(far), half_cotangent(near)
    a, spread = 0.5 * (low + high), 0.5 * (high - low)
    u = a * px + 0.5 * angle * py
    w = a * py - 0.5 * angle * px
    u_width = abs(a) * side + spread * (abs(px) + side) + 0.5 * (abs(angle) * side + angle_width * (abs(py) + side))
    w_width = abs(a) * side + spread * (abs(py) + side) + 0.5 * (abs(angle) * side + angle_width * (abs(px) + side))
    u, w = max(abs(u) - u_width, 0.0), max(abs(w) - w_width, 0.0)
    square = r_v * u * u + r_w * near * near
    koranyi = math.sqrt(math.sqrt(square * square + 16.0 * r_v * r_w * w * w))
    return max(lowest, min(koranyi, source.limit) / source.gradient) * (1.0 - ROUNDING)


@kernel(float64(float64, float64, float64, SOURCE))
def gauge(x, y, heading, source):
    """The gauge at a pose."""
    return gauge_minimum(x, y, heading, 0.0, 0.0, source)
