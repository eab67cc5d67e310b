"""The packages: those in `leapnav/`, and `envs/`, `experts/` and `training/` as its subpackages."""

from setuptools import find_packages, setup

own = find_packages(include=["leapnav", "leapnav.*"])
parts = find_packages(include=["envs", "envs.*", "experts", "experts.*", "training", "training.*"])
setup(packages=[*own, *(f"leapnav.{name}" for name in parts)])
