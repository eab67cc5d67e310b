"""Training runs: run directories, checkpoints and one module per kind of algorithm."""

from leapnav.deprecated import moved_names

__getattr__ = moved_names(__name__, "run")
