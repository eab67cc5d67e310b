"""Robot models: one file each, see `leapnav.envs.robots.base`."""

from leapnav.envs.robots.base import Dynamics, RobotModel, Symmetry, register
from leapnav.envs.robots.car import Car
from leapnav.envs.robots.differential_drive import DifferentialDrive
from leapnav.envs.robots.dynamic_car import DynamicCar
from leapnav.envs.robots.dynamic_unicycle import DynamicUnicycle
from leapnav.envs.robots.footprints import Box, Disc
from leapnav.envs.robots.trailer import Trailer, UnicycleTrailer
from leapnav.envs.robots.unicycle import Unicycle

__all__ = [
    "Box",
    "Car",
    "DifferentialDrive",
    "Disc",
    "DynamicCar",
    "DynamicUnicycle",
    "Dynamics",
    "RobotModel",
    "Symmetry",
    "Trailer",
    "Unicycle",
    "UnicycleTrailer",
    "register",
]
