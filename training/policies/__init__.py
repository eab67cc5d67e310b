"""Policies: networks and their files, and baselines."""

from leapnav.deprecated import moved_names

__getattr__ = moved_names(__name__, "network", "files")
