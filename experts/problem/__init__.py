"""Optimal control problems, extremals and certificates."""

from leapnav.deprecated import moved_names

__getattr__ = moved_names(__name__, "problem", "extremal")
