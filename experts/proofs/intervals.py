"""Interval arithmetic with outward rounding: the few operations that the constants of a proof need.

Python rounds each operation to the nearest double, so one step outward of the result encloses the exact value. For the
functions of the C library (tan) two units in the last place are assumed, and four steps are taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

LIBRARY_STEPS = 4


@dataclass(frozen=True)
class Interval:
    """A closed interval of real numbers, with the operations of sums, products and quotients."""

    low: float
    high: float

    @classmethod
    def of(cls, value: float | Interval) -> Interval:
        """Return the value as an interval; a float is taken as exact."""
        return value if isinstance(value, Interval) else cls(value, value)

    def __add__(self, other: float | Interval) -> Interval:
        other = Interval.of(other)
        return outward(self.low + other.low, self.high + other.high)

    __radd__ = __add__

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __sub__(self, other: float | Interval) -> Interval:
        return self + (-Interval.of(other))

    def __rsub__(self, other: float | Interval) -> Interval:
        return Interval.of(other) + (-self)

    def __mul__(self, other: float | Interval) -> Interval:
        other = Interval.of(other)
        products = [a * b for a in (self.low, self.high) for b in (other.low, other.high)]
        return outward(min(products), max(products))

    __rmul__ = __mul__

    def __truediv__(self, other: float | Interval) -> Interval:
        other = Interval.of(other)
        if other.low <= 0.0 <= other.high:
            raise ZeroDivisionError(f"division by an interval that contains 0: [{other.low}, {other.high}]")
        quotients = [a / b for a in (self.low, self.high) for b in (other.low, other.high)]
        return outward(min(quotients), max(quotients))

    def sqrt(self) -> Interval:
        """Return the square root; negative parts of the interval are cut off."""
        return outward(math.sqrt(max(self.low, 0.0)), math.sqrt(self.high))

    def magnitude(self) -> float:
        """Return the largest absolute value."""
        return max(abs(self.low), abs(self.high))


def outward(low: float, high: float, steps: int = 1) -> Interval:
    """Return the interval widened by some steps between adjacent doubles on both sides."""
    for _ in range(steps):
        low, high = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    return Interval(low, high)


def tangent(x: float) -> Interval:
    """Return an enclosure of tan(x) for a double x with 0 <= x < pi / 2."""
    return outward(math.tan(x), math.tan(x), LIBRARY_STEPS)
