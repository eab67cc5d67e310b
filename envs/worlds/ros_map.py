"""Occupancy grids of ROS: an image and a YAML file, as the map server of ROS reads them.

The format is described at https://wiki.ros.org/map_server (ROS 1) and in the documentation of Nav2 (ROS 2). Where the
two differ, this module follows Nav2.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import CustomFamily, sample_scenario
from leapnav.envs.scenarios.layouts.layout import ScenarioLayout
from leapnav.envs.scenarios.maps import rectangle_vertices
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Polygon
from leapnav.envs.utils.validation import check_at_least, check_choice
from leapnav.envs.worlds.yaml_files import AnyNumber, Number, YamlRecord, as_record, read_yaml

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # defaults of the map server
UNKNOWN = ("occupied", "free")  # what unknown cells count as
UNKNOWN_GRAY = 205  # of 255: the value that map savers write for an unknown cell in the mode trinary
MAX_SHALLOW, MAX_DEEP = 255, 65535  # white, with 8 and 16 bits per channel
MIN_YAW = 1e-4  # rad: smaller rotations are rounding errors, which move a corner by 1 cm at 100 m, less than a cell


class _MapFile(YamlRecord):
    """The fields of the YAML file of a map."""

    image: str
    resolution: Annotated[Number, Field(gt=0)]
    origin: Annotated[tuple[AnyNumber, ...], Field(min_length=2, max_length=3)]
    mode: Literal["trinary", "scale"] = "trinary"
    occupied_thresh: Annotated[Number, Field(ge=0, le=1)] = OCCUPIED_THRESHOLD
    free_thresh: Annotated[Number, Field(ge=0, le=1)] = FREE_THRESHOLD
    negate: bool = False


@dataclass(frozen=True, eq=False)
class GridMap:
    """An occupancy grid.

    Attributes:
        name: name of the file.
        blocked (height, width): whether a cell is an obstacle; the first line is the top of the map.
        resolution: side length of a cell (m).
        origin: position of the lower left corner (m).
        yaw: rotation of the map around this corner, counter-clockwise (rad).

    """

    name: str
    blocked: np.ndarray
    resolution: float
    origin: tuple[float, float]
    yaw: float = 0.0

    @property
    def arena(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of the map (m)."""
        corners = np.array(self._corners())
        x_min, y_min, x_max, y_max = (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())
        return x_min, y_min, x_max, y_max

    def obstacles(self) -> list[Obstacle]:
        """Return the blocked cells that have a free neighbour, merged into few rectangles; others cannot be reached.

        The parts of the arena outside of a rotated map are obstacles, too.
        """
        if self.yaw == 0.0:
            parts = rectangle_vertices(self.blocked, self.resolution, self.origin)
        else:
            rectangles = rectangle_vertices(self.blocked, self.resolution)
            parts = [tuple(self._placed(*vertex) for vertex in part) for part in rectangles]
            parts += self._triangles()
        return [Obstacle(polygon=Polygon(vertices=part)) for part in parts]

    def _placed(self, x: float, y: float) -> tuple[float, float]:
        """Return the position of a point of the map that is not rotated and has its corner at (0, 0)."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.origin[0] + cos * x - sin * y, self.origin[1] + sin * x + cos * y

    def _corners(self) -> list[tuple[float, float]]:
        """Return the corners of the map, counter-clockwise from its origin."""
        height, width = self.blocked.shape
        right, top = width * self.resolution, height * self.resolution
        return [self._placed(x, y) for x, y in ((0.0, 0.0), (right, 0.0), (right, top), (0.0, top))]

    def _triangles(self) -> list[tuple[tuple[float, float], ...]]:
        """Return the triangles between the edges of the rotated map and the corners of the arena."""
        corners, found = self._corners(), []
        for (x, y), (other_x, other_y) in zip(corners, [*corners[1:], corners[0]], strict=True):
            if min(abs(other_x - x), abs(other_y - y)) < MIN_YAW * self.resolution:  # the edge is one of the arena
                continue
            # The corner of the arena to the right of the edge.
            outside = (other_x, y) if (other_x - x) * (other_y - y) > 0.0 else (x, other_y)
            found.append(((x, y), outside, (other_x, other_y)))
        return found


def read_ros_map(path: str | os.PathLike[str], *, unknown: str = "occupied") -> GridMap:
    """Read an occupancy grid.

    The gray value g of a cell is the mean of its red, green and blue, from 0 (black) to 1; in the mode trinary, of its
    opacity, too, if the image has one. With the occupancy p = 1 - g, or g if `negate` is set, a cell is occupied if p
    is above `occupied_thresh`, otherwise free if p is below `free_thresh`, and otherwise unknown. In the mode scale,
    a cell that is not opaque is unknown.

    Args:
        path: the YAML file; its image, with 8 or 16 bits per channel, is beside it.
        unknown: what unknown cells count as, "occupied" or "free".

    Raises:
        OSError: a file cannot be read.
        ValueError: a field is missing or invalid, the mode is "raw", or the image cannot be read; the message names the
            file and the field.
        ModuleNotFoundError: PyYAML is not installed.

    Warns:
        UserWarning: the yaw is not a number and is read as 0, or cells with the gray value of unknown cells are below
            `free_thresh` and are read as free.

    """
    check_choice("unknown", unknown, UNKNOWN)
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    fields = as_record(_MapFile, read_yaml(path), path)
    origin, yaw = _origin(path, fields)
    gray, is_opaque = _read_image(path, fields.image, fields.mode)
    occupancy = gray if fields.negate else 1.0 - gray
    occupied = occupancy > fields.occupied_thresh
    free = (occupancy < fields.free_thresh) & ~occupied
    if fields.mode == "scale":
        occupied, free = occupied & is_opaque, free & is_opaque
    doubtful = int((free & (gray == UNKNOWN_GRAY / 255)).sum())
    if doubtful and unknown == "occupied" and fields.mode == "trinary" and not fields.negate:
        warnings.warn(
            f"{path}: free_thresh: {doubtful} cells with the gray value {UNKNOWN_GRAY}, which map savers write for "
            f"unknown cells, are read as free; free_thresh: {FREE_THRESHOLD} reads them as unknown",
            stacklevel=2,
        )
    blocked = ~free if unknown == "occupied" else occupied
    return GridMap(path.stem, blocked, fields.resolution, origin, yaw)


def sample_on_map(
    grid: GridMap,
    count: int,
    *,
    seed: int = 0,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
    obstacles: str = "cost",
) -> list[Scenario]:
    """Sample scenarios with random poses on a map, see `sample_scenario`; scenario i has the seed `seed + i`.

    Raises:
        ValueError: an argument is invalid, or no poses are connected.

    """
    check_at_least("count", count, 1)
    layout = ScenarioLayout(grid.obstacles(), arena=grid.arena)
    family = CustomFamily(grid.name, lambda rng: layout)
    return [sample_scenario(family, seed + i, robot, horizon, obstacles) for i in range(count)]


def _origin(path: Path, fields: _MapFile) -> tuple[tuple[float, float], float]:
    """Return the position of the lower left corner (m) and the rotation of the map (rad)."""
    x, y, *yaws = fields.origin
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"{path}: origin: expected finite coordinates, got {fields.origin}")
    yaw = yaws[0] if yaws else 0.0
    if math.isinf(yaw):
        raise ValueError(f"{path}: origin: expected a finite yaw, got {yaw}")
    if math.isnan(yaw):
        warnings.warn(f"{path}: origin: the yaw is not a number and is read as 0", stacklevel=3)
        yaw = 0.0
    yaw = math.remainder(yaw, 2 * math.pi)
    return (x, y), yaw if abs(yaw) > MIN_YAW else 0.0


def _read_image(path: Path, name: str, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the gray values (height, width) of the image of a map, from 0 (black) to 1, and whether it is opaque."""
    from PIL import Image, UnidentifiedImageError

    file = path.parent / name
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; it is the image of {path}")
    try:
        with Image.open(file) as image:
            has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
            is_deep = image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM"))
            if image.mode in ("I", "F") and not is_deep:
                raise ValueError(f"expected 8 or 16 bits per channel, got the mode {image.mode}")
            if is_deep and has_alpha:
                raise ValueError("a transparent gray value of 16 bits is not supported")
            if not is_deep:  # this would clip 16 bits
                image = image.convert("RGBA" if has_alpha else "L" if image.mode in ("1", "L") else "RGB")
            values = np.asarray(image).reshape(image.height, image.width, -1)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"{file}: not an image: {error}") from None
    colors = values if mode == "trinary" else values[..., :3]
    maximum = MAX_DEEP if is_deep else MAX_SHALLOW
    gray = colors.sum(axis=2, dtype=np.int64) / (colors.shape[2] * maximum)
    is_opaque = values[..., 3] == maximum if has_alpha else np.ones(gray.shape, dtype=bool)
    return gray, is_opaque
