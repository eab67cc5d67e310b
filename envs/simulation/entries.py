"""Names and units of the entries of an observation, for programs that build observations without leapnav."""

from __future__ import annotations

from dataclasses import dataclass

from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import ObservationLayout, goal_entries


@dataclass(frozen=True)
class Entry:
    """One number of an observation or an action.

    Attributes:
        name: part and meaning, such as "goal.ahead".
        unit: unit, "1" for a number without one.
        low, high: bounds; values outside are clipped.

    """

    name: str
    unit: str
    low: float
    high: float


_GOAL = (
    ("goal.ahead", "m"),
    ("goal.left", "m"),
    ("goal.cos_heading_error", "1"),
    ("goal.sin_heading_error", "1"),
    ("goal.time_left", "s"),
    ("goal.needed_speed_ahead", "m/s"),
    ("goal.needed_speed_left", "m/s"),
    ("goal.needed_speed", "m/s"),
    ("goal.needed_turn_rate", "rad/s"),
)
_MOTION = (("motion.speed_ahead", "m/s"), ("motion.speed_left", "m/s"), ("motion.turn_rate", "rad/s"))
_WALLS = (
    *((f"walls.{side}", "m") for side in ("left", "bottom", "right", "top")),
    ("walls.cos_heading", "1"),
    ("walls.sin_heading", "1"),
)
ACTION = (Entry("speed / max_speed", "1", -1.0, 1.0), Entry("turn_rate / max_turn_rate", "1", -1.0, 1.0))


def observation_entries(settings: EnvironmentSettings) -> list[Entry]:
    """Return the entries of a flat observation of `NavigateEnv`, in order.

    Raises:
        ValueError: the observations of these settings are dictionaries.

    """
    if settings.dict_observation or settings.goal_conditioned:
        raise ValueError("environment: expected flat observations, got dict_observation or a goal-conditioned one")
    names = list(_GOAL[: goal_entries(settings)])
    if settings.motors:
        names += _MOTION
    if settings.has_lidar:
        beams = settings.lidar_beams
        angles = [f"{360 * k / beams:g} deg counter-clockwise from ahead" for k in range(beams)]
        names += [(f"lidar[{k}], {angle}", "m") for k, angle in enumerate(angles)]
        if settings.observation == "geodesic":
            names += [(f"detours[{k}], {angle}", "m") for k, angle in enumerate(angles)]
            names.append(("distance", "m"))
    elif settings.observation == "map":
        names += _WALLS
        for k in range(settings.map_obstacles):
            names += [(f"obstacles[{k}].exists", "1"), (f"obstacles[{k}].radius", "m")]
            for vertex in range(settings.map_vertices):
                names += [(f"obstacles[{k}].vertices[{vertex}].{side}", "m") for side in ("ahead", "left")]
    bounds = ObservationLayout(settings).bounds.astype(float).T.tolist()
    return [Entry(name, unit, low, high) for (name, unit), (low, high) in zip(names, bounds, strict=True)]
