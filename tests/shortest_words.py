"""Minimum times of vehicles in the plane without obstacles in closed form, independent of the solvers of the package.

All paths start at (0, 0, 0), have the speed 1, and turn with radius 1 (vehicles that turn while they drive) or rotate
in place (differential drive).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy.optimize import minimize

Pose = tuple[float, float, float]
# A piece of a path: "L", "R" or "S", and its signed length; a negative one is driven backwards.
Piece = tuple[str, float]
MISS = 1e-9  # a word is a path to the goal if it ends closer than this
TURN = {"L": 1.0, "S": 0.0, "R": -1.0}


def end_of(pieces: tuple[Piece, ...]) -> Pose:
    """Return the pose at the end of a path with radius 1."""
    x, y, heading = 0.0, 0.0, 0.0
    for kind, length in pieces:
        curvature = TURN[kind]
        if curvature == 0.0:
            x, y = x + length * math.cos(heading), y + length * math.sin(heading)
        else:
            after = heading + curvature * length
            x += (math.sin(after) - math.sin(heading)) / curvature
            y -= (math.cos(after) - math.cos(heading)) / curvature
            heading = after
    return x, y, heading


def misses(pieces: tuple[Piece, ...], goal: Pose) -> float:
    """Return the distance of the end of a path from the goal, the heading modulo 2 pi."""
    x, y, heading = end_of(pieces)
    return math.hypot(x - goal[0], y - goal[1]) + abs(math.remainder(heading - goal[2], 2 * math.pi))


def dubins(goal: Pose) -> dict[str, float]:
    """Return the length of each word of Dubins' car that reaches the goal (L. E. Dubins, 1957).

    The circles of the turns are tangent to the line between them, or to the circle between them.
    """
    found = {}
    for word in ("LSL", "RSR", "LSR", "RSL", "LRL", "RLR"):
        lengths = [path for path in _dubins_paths(word, goal) if misses(path, goal) < MISS]
        if lengths:
            found[word] = min(sum(length for _, length in path) for path in lengths)
    return found


def _dubins_paths(word: str, goal: Pose) -> Iterator[tuple[Piece, ...]]:
    first, middle, last = (TURN[kind] for kind in word)
    centre = complex(0.0, first)
    end = complex(goal[0], goal[1]) + last * 1j * complex(math.cos(goal[2]), math.sin(goal[2]))
    across, angle = abs(end - centre), float(np.angle(end - centre))
    if middle == 0.0:
        # Heading of the straight line: its offset from the line of centres is 0, or that of an inner tangent.
        if first != last and across < 2.0:
            return
        for heading in (angle if first == last else angle + first * math.asin(2.0 / across),):
            straight = across if first == last else math.sqrt(across**2 - 4.0)
            yield _pieces(word, (first * heading, straight, last * (goal[2] - heading)))
    elif across <= 4.0:
        # The middle circle is tangent to both: an isosceles triangle with two sides of length 2.
        for side in (-1.0, 1.0):
            to_middle = angle + side * math.acos(across / 4.0)
            centre_of_middle = centre + 2.0 * complex(math.cos(to_middle), math.sin(to_middle))
            from_middle = float(np.angle(end - centre_of_middle))
            one, two = to_middle + first * math.pi / 2, from_middle - first * math.pi / 2
            yield _pieces(word, (first * one, middle * (two - one), last * (goal[2] - two)))


def _pieces(word: str, lengths: tuple[float, ...]) -> tuple[Piece, ...]:
    """Return a path whose turns are the smallest non-negative ones."""
    turns = [(kind, length if kind == "S" else _turn(length)) for kind, length in zip(word, lengths, strict=True)]
    return tuple(turns)


def _turn(angle: float) -> float:
    """Return an angle in [0, 2 pi), with rounding errors below 0 rounded to 0."""
    angle = math.fmod(angle, 2 * math.pi)
    if angle < 0.0:
        angle += 2 * math.pi
    return 0.0 if 2 * math.pi - angle < 1e-12 else angle


# Reeds and Shepp (1990), section 8: a path of each family for a goal, with the lengths t, u, v. The other words follow
# by reflection (y, theta -> -y, -theta), time reversal (x, theta -> -x, -theta) and reversal of the order.


def _polar(x: float, y: float) -> tuple[float, float]:
    return math.hypot(x, y), math.atan2(y, x)


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def _csc_same(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    u, t = _polar(x - math.sin(phi), y - 1.0 + math.cos(phi))
    yield ("L", t), ("S", u), ("L", _wrap(phi - t))


def _csc_other(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    across, angle = _polar(x + math.sin(phi), y - 1.0 - math.cos(phi))
    if across >= 2.0:
        u = math.sqrt(across**2 - 4.0)
        t = _wrap(angle + math.atan2(2.0, u))
        yield ("L", t), ("S", u), ("R", _wrap(t - phi))


def _ccc(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    """C|C|C and C|CC, which is CC|C in reversed order."""
    across, angle = _polar(x - math.sin(phi), y - 1.0 + math.cos(phi))
    if across <= 4.0:
        half = math.acos(across / 4.0)
        t = _wrap(math.pi / 2 + half + angle)
        u = _wrap(math.pi - 2 * half)
        yield ("L", t), ("R", -u), ("L", _wrap(phi - t - u))
        yield ("L", t), ("R", -u), ("L", _wrap(phi - t - u) - math.copysign(2 * math.pi, _wrap(phi - t - u)))


def _cccc(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    """CC_u|C_uC and C|C_uC_u|C."""
    xi, eta = x + math.sin(phi), y - 1.0 - math.cos(phi)
    across = math.hypot(xi, eta)
    inner = 0.25 * (2.0 + across)
    if inner <= 1.0:
        u = math.acos(inner)
        yield from _outer_turns(u, -u, xi, eta, phi)
    inner = (20.0 - across**2) / 16.0
    if 0.0 <= inner <= 1.0:
        u = -math.acos(inner)
        yield from _outer_turns(u, u, xi, eta, phi)


def _outer_turns(u: float, v: float, xi: float, eta: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    """L R L R with the inner turns u and v."""
    delta = u - v
    a, b = math.sin(u) - math.sin(delta), math.cos(u) - math.cos(delta) - 1.0
    base = math.atan2(eta * a - xi * b, xi * a + eta * b)
    for extra in (0.0, math.pi):
        t = _wrap(base + extra)
        yield ("L", t), ("R", u), ("L", v), ("R", _wrap(t - u + v - phi))


def _ccsc(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    """C|C_pi/2 S C with both directions of the last turn; C S C_pi/2|C is the same in reversed order."""
    xi, eta = x - math.sin(phi), y - 1.0 + math.cos(phi)
    across, angle = _polar(xi, eta)
    if across >= 2.0:
        root = math.sqrt(across**2 - 4.0)
        for t in (_wrap(angle + math.atan2(root, -2.0)), _wrap(angle + math.atan2(2.0, root - 2.0))):
            yield ("L", t), ("R", -math.pi / 2), ("S", 2.0 - root), ("L", _wrap(phi - t - math.pi / 2))
    xi, eta = x + math.sin(phi), y - 1.0 - math.cos(phi)
    across, angle = _polar(-eta, xi)
    if across >= 2.0:
        t = angle
        yield ("L", t), ("R", -math.pi / 2), ("S", 2.0 - across), ("R", _wrap(t + math.pi / 2 - phi))


def _ccscc(x: float, y: float, phi: float) -> Iterator[tuple[Piece, ...]]:
    """C|C_pi/2 S C_pi/2|C."""
    xi, eta = x + math.sin(phi), y - 1.0 - math.cos(phi)
    across = math.hypot(xi, eta)
    if across >= 2.0:
        u = 4.0 - math.sqrt(across**2 - 4.0)
        t = _wrap(math.atan2((4.0 - u) * xi - 2.0 * eta, -2.0 * xi + (u - 4.0) * eta))
        yield ("L", t), ("R", -math.pi / 2), ("S", u), ("L", -math.pi / 2), ("R", _wrap(t - phi))


NAMES = (
    "C",
    "S",
    "CC",
    "C|C",
    "CS",
    "SC",
    "CSC",
    "C|CC",
    "CC|C",
    "C|C|C",
    "CC|CC",
    "C|CC|C",
    "C|CS",
    "SC|C",
    "C|CSC",
    "CSC|C",
    "C|CSC|C",
)  # an optimum is in one of these families
FAMILIES: tuple[Callable[[float, float, float], Iterator[tuple[Piece, ...]]], ...] = (
    _csc_same,
    _csc_other,
    _ccc,
    _cccc,
    _ccsc,
    _ccscc,
)


def reeds_shepp(goal: Pose) -> dict[str, float]:
    """Return the length of the words of Reeds and Shepp's car that reach the goal, such as "L+R-L+".

    Each candidate is checked by driving it, so that a wrong formula can omit a word, but not add a path.
    """
    found: dict[str, float] = {}
    for pieces in _reeds_shepp_paths(goal):
        if misses(pieces, goal) < MISS:
            word = "".join(k + ("+" if s > 0 else "-") for k, s in pieces if abs(s) > MISS)
            if family_of(word) not in NAMES:
                continue
            length = sum(abs(s) for _, s in pieces)
            found[word] = min(length, found.get(word, math.inf))
    return found


def _reeds_shepp_paths(goal: Pose) -> Iterator[tuple[Piece, ...]]:
    x, y, phi = goal
    # In reversed order the path starts at the goal of a path that is driven backwards.
    back = x * math.cos(phi) + y * math.sin(phi), x * math.sin(phi) - y * math.cos(phi), phi
    other = {"L": "R", "R": "L", "S": "S"}
    for (x1, y1, phi1), is_reversed in (((x, y, phi), False), (back, True)):
        for flip, reflect in itertools.product((1.0, -1.0), repeat=2):
            for family in FAMILIES:
                for pieces in family(flip * x1, reflect * y1, flip * reflect * phi1):
                    moved = [(other[k] if reflect < 0 else k, flip * s) for k, s in pieces]
                    yield tuple(moved[::-1] if is_reversed else moved)


def family_of(word: str) -> str:
    """Return the family of a word of Reeds and Shepp, such as "C|CSC" of "L+R-S-L-"."""
    kinds, signs = word[::2], word[1::2]
    name = ""
    for index, kind in enumerate(kinds):
        if index and signs[index] != signs[index - 1]:
            name += "|"
        name += "S" if kind == "S" else "C"
    return name


def balkcom_mason(goal: Pose, half_track: float = 1.0, starts: int = 40, seed: int = 0) -> float:
    """Return the minimum time of a differential drive with wheel speeds of at most 1.

    Its time-optimal paths consist of at most three straight lines and rotations in place between them (D. J. Balkcom
    and M. T. Mason, 2002), of which the time is the length plus half the track times the rotation. The two inner
    corners of the polygon are found by minimisation from many starts.
    """
    x, y, phi = goal
    end = complex(x, y)
    size = abs(end) + half_track
    rng = np.random.default_rng(seed)

    def time(corners: np.ndarray, signs: tuple[float, ...]) -> float:
        points = (0j, complex(corners[0], corners[1]), complex(corners[2], corners[3]), end)
        heading, total = 0.0, 0.0
        for (a, b), sign in zip(itertools.pairwise(points), signs, strict=True):
            length = abs(b - a)
            if length > 1e-12:
                along = float(np.angle(sign * (b - a)))
                total += length + half_track * abs(_wrap(along - heading))
                heading = along
        return total + half_track * abs(_wrap(phi - heading))

    best = math.inf
    for signs in itertools.product((1.0, -1.0), repeat=3):
        guesses = [np.zeros(4), np.array([0.0, 0.0, x, y]), np.array([x, y, x, y])]
        guesses += list(rng.normal(scale=size, size=(starts, 4)))
        values = sorted((time(guess, signs), tuple(guess)) for guess in guesses)
        best = min(best, values[0][0])
        for _, guess in values[:8]:
            options = {"xatol": 1e-10, "fatol": 1e-12, "maxiter": 4000, "maxfev": 4000}
            one = minimize(time, guess, (signs,), method="Nelder-Mead", options=options)
            again = minimize(time, one.x, (signs,), method="Nelder-Mead", options=options)
            best = min(best, float(again.fun))
    return best
