"""Gymnasium environments of a wheeled robot among obstacles, and the scenarios played in them."""

from leapnav.envs.goal_navigation import NavigateGoalEnv
from leapnav.envs.navigation import NavigateEnv
from leapnav.envs.robots import (
    Box,
    Car,
    DifferentialDrive,
    Disc,
    DynamicCar,
    DynamicUnicycle,
    RobotModel,
    Trailer,
    Unicycle,
    UnicycleTrailer,
)
from leapnav.envs.scenarios.bank import BankError, ScenarioBank
from leapnav.envs.scenarios.banks.checks import Reference
from leapnav.envs.scenarios.cost import Cost
from leapnav.envs.scenarios.families import FAMILIES, register_family, sample_scenario
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.layouts.layout import ScenarioLayout
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import Disturbance, EnvironmentSettings, Motor
from leapnav.envs.shapes import Capsule, Circle, Polygon, Shape
from leapnav.envs.vector import NavigateGoalVectorEnv, NavigateVectorEnv

__all__ = [
    "FAMILIES",
    "BankError",
    "Box",
    "Capsule",
    "Car",
    "Circle",
    "Cost",
    "DifferentialDrive",
    "Disc",
    "Disturbance",
    "DynamicCar",
    "DynamicUnicycle",
    "EnvironmentSettings",
    "Motor",
    "NavigateEnv",
    "NavigateGoalEnv",
    "NavigateGoalVectorEnv",
    "NavigateVectorEnv",
    "Obstacle",
    "Polygon",
    "Reference",
    "RobotModel",
    "Scenario",
    "ScenarioBank",
    "ScenarioError",
    "ScenarioLayout",
    "Shape",
    "Trailer",
    "Unicycle",
    "UnicycleTrailer",
    "register_family",
    "sample_scenario",
]
