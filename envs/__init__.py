"""Gymnasium environments of a two-wheeled robot among obstacles, and the scenarios played in them."""

from leapnav.envs.navigation import NavigateEnv, NavigateGoalEnv
from leapnav.envs.scenarios.bank import BankError, Reference, ScenarioBank
from leapnav.envs.scenarios.families import FAMILIES, sample_scenario
from leapnav.envs.scenarios.scenario import Circle, Cost, Obstacle, Polygon, Robot, Scenario, ScenarioError
from leapnav.envs.settings import Disturbance, Motor
from leapnav.envs.vector import NavigateGoalVectorEnv, NavigateVectorEnv

__all__ = [
    "FAMILIES",
    "BankError",
    "Circle",
    "Cost",
    "Disturbance",
    "Motor",
    "NavigateEnv",
    "NavigateGoalEnv",
    "NavigateGoalVectorEnv",
    "NavigateVectorEnv",
    "Obstacle",
    "Polygon",
    "Reference",
    "Robot",
    "Scenario",
    "ScenarioBank",
    "ScenarioError",
    "sample_scenario",
]
