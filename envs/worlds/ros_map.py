"""Occupancy grids of ROS: an image and a YAML file, as the map server of ROS reads them.

The format is described at https://wiki.ros.org/map_server (ROS 1) and in the documentation of Nav2 (ROS 2).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import CustomFamily, sample_scenario
from leapnav.envs.scenarios.layouts import ScenarioLayout
from leapnav.envs.scenarios.maps import rectangle_vertices
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Polygon
from leapnav.envs.utils.validation import check_at_least, check_choice
from leapnav.envs.worlds.yaml_files import read_yaml

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # defaults of the map server
UNKNOWN = ("occupied", "free")  # what unknown cells count as


@dataclass(frozen=True, eq=False)
class GridMap:
    """An occupancy grid.

    Attributes:
        name: name of the file.
        blocked (height, width): whether a cell is an obstacle; the first line is the top of the map.
        resolution: side length of a cell (m).
        origin: position of the lower left corner (m).

    """

    name: str
    blocked: np.ndarray
    resolution: float
    origin: tuple[float, float]

    @property
    def arena(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of the map (m)."""
        height, width = self.blocked.shape
        x, y = self.origin
        return x, y, x + width * self.resolution, y + height * self.resolution

    def obstacles(self) -> list[Obstacle]:
        """Return the blocked cells that have a free neighbour, merged into few rectangles; others cannot be reached."""
        parts = rectangle_vertices(self.blocked, self.resolution, self.origin)
        return [Obstacle(polygon=Polygon(vertices=part)) for part in parts]


def read_ros_map(path: str | os.PathLike[str], *, unknown: str = "occupied") -> GridMap:
    """Read an occupancy grid.

    With the occupancy p = (255 - gray) / 255 of a cell, or gray / 255 if `negate` is set, a cell is occupied if p is
    above `occupied_thresh`, free if p is below `free_thresh`, and unknown otherwise.

    Args:
        path: the YAML file; its image is beside it.
        unknown: what unknown cells count as, "occupied" or "free".

    Raises:
        OSError: a file cannot be read.
        ValueError: a field is missing or invalid, the map is rotated, its mode is "raw", or the image cannot be read;
            the message names the file and the field.
        ModuleNotFoundError: PyYAML is not installed.

    """
    check_choice("unknown", unknown, UNKNOWN)
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    fields = read_yaml(path)
    resolution = fields.number("resolution")
    if not resolution > 0:
        raise ValueError(f"{path}: resolution: expected a positive number, got {resolution}")
    origin = fields.numbers("origin", 2, 3)
    if len(origin) == 3 and origin[2] != 0:
        raise ValueError(f"{path}: origin: expected a map that is not rotated, got the yaw {origin[2]}")
    mode = fields.values.get("mode", "trinary")
    if mode not in ("trinary", "scale"):
        raise ValueError(f"{path}: mode: expected trinary or scale, got {mode!r}")
    gray = _read_image(path, fields.text("image"))
    occupancy = gray if fields.values.get("negate", 0) else 1.0 - gray
    occupied = occupancy > fields.number("occupied_thresh", OCCUPIED_THRESHOLD)
    free = occupancy < fields.number("free_thresh", FREE_THRESHOLD)
    blocked = ~free if unknown == "occupied" else occupied
    return GridMap(path.stem, blocked, resolution, (origin[0], origin[1]))


def sample_on_map(
    grid: GridMap,
    count: int,
    *,
    seed: int = 0,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
) -> list[Scenario]:
    """Sample scenarios with random poses on a map, see `sample_scenario`; scenario i has the seed `seed + i`.

    Raises:
        ValueError: an argument is invalid, or no poses are connected.

    """
    check_at_least("count", count, 1)
    layout = ScenarioLayout(grid.obstacles(), arena=grid.arena)
    family = CustomFamily(grid.name, lambda rng: layout)
    return [sample_scenario(family, seed + i, robot, horizon) for i in range(count)]


def _read_image(path: Path, name: str) -> np.ndarray:
    """Return the gray values (height, width) of the image of a map, from 0 (black) to 1."""
    from PIL import Image, UnidentifiedImageError

    file = path.parent / name
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; it is the image of {path}")
    try:
        with Image.open(file) as image:
            return np.asarray(image.convert("L"), dtype=float) / 255
    except (UnidentifiedImageError, OSError, ValueError) as error:
        raise ValueError(f"{file}: not an image: {error}") from None
