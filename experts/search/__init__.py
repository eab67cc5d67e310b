"""Global search for the optimum of a scenario: candidate paths and their local optima."""

from leapnav.deprecated import moved_names

__getattr__ = moved_names(__name__, "local_optima")
