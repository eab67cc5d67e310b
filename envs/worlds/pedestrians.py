"""Recordings of pedestrians in the text format of the ETH and UCY datasets: one line per position.

A line contains the number of the frame, that of the pedestrian, and the position x and y (m), separated by white space
or commas (S. Pellegrini et al., "You'll never walk alone", ICCV 2009; A. Lerner et al., "Crowds by example", Computer
Graphics Forum 26, 2007; in the form of A. Gupta et al., "Social GAN", CVPR 2018).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.families import MAX_HORIZON, CustomFamily, sample_scenario
from leapnav.envs.scenarios.layouts.layout import ARENA, Area, ScenarioLayout, rounded
from leapnav.envs.scenarios.obstacle import Obstacle, ObstaclePath
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.shapes import Circle
from leapnav.envs.utils.validation import check_at_least, check_positive

FRAMES_PER_SECOND = 25.0  # of the videos; an annotation every 10 frames
RADIUS = 0.25  # m
MARGIN = 1.0  # m between the recorded positions and the walls of the arena
SLOWEST = 0.05  # m/s; a slower pedestrian stands when the recording begins or ends
COLUMNS = 4


@dataclass(frozen=True, eq=False)
class Recording:
    """Pedestrians over time.

    Attributes:
        name: name of the file.
        tracks: for each pedestrian with at least two positions the times (s) and positions (K, 3), from its first to
            its last one; times begin at 0 with the recording.

    """

    name: str
    tracks: tuple[np.ndarray, ...]

    @property
    def duration(self) -> float:
        """Time (s) from the first to the last position."""
        return max(float(track[-1, 0]) for track in self.tracks)

    @property
    def arena(self) -> Area:
        """The positions of walls (m) around all pedestrians."""
        points = np.concatenate(self.tracks)[:, 1:]
        (x_min, y_min), (x_max, y_max) = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
        return rounded(x_min), rounded(y_min), rounded(x_max), rounded(y_max)

    def obstacles(self, start: float, duration: float, radius: float = RADIUS) -> list[Obstacle]:
        """Return the pedestrians of an episode as discs with paths.

        A pedestrian walks on with its first and its last recorded velocity before and after its track.

        Args:
            start: time of the recording (s) at which the episode starts.
            duration: of the episode (s).
            radius: of a pedestrian (m).

        """
        found = []
        for track in self.tracks:
            if track[0, 0] > start + duration or track[-1, 0] < start:
                continue
            times, points = track[:, 0] - start, track[:, 1:]
            first, last = ((points[b] - points[a]) / (times[b] - times[a]) for a, b in ((0, 1), (-2, -1)))
            before, after = max(float(times[0]), 0.0), max(duration - float(times[-1]), 0.0)
            if before > 0.0:
                times, points = np.append(0.0, times), np.vstack([points[0] - before * _walking(first), points])
            if after > 0.0:
                times, points = np.append(times, duration), np.vstack([points, points[-1] + after * _walking(last)])
            inside = np.flatnonzero((times > 0.0) & (times < duration))
            part = slice(max(inside[0] - 1, 0), inside[-1] + 2) if len(inside) else slice(None)
            shown = tuple((rounded(x), rounded(y)) for x, y in points[part].tolist())
            path = ObstaclePath(times=tuple(rounded(time) for time in times[part]), points=shown)
            found.append(Obstacle(circle=Circle(center=shown[0], radius=radius), path=path))
        return found


def _walking(velocity: np.ndarray) -> np.ndarray:
    return velocity if np.hypot(*velocity) > SLOWEST else np.zeros(2)


def read_pedestrians(path: str | os.PathLike[str], *, frames_per_second: float = FRAMES_PER_SECOND) -> Recording:
    """Read a recording.

    Args:
        path: the text file.
        frames_per_second: of the numbers of the frames; 25 in the usual files, with one annotation every 0.4 s.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line is not a position, two positions of a pedestrian are at the same time, or there is no
            pedestrian with two positions; the message names file and line.

    """
    check_positive("frames_per_second", frames_per_second)
    rows: dict[float, dict[float, tuple[float, float]]] = {}
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        try:
            frame, pedestrian, x, y = map(float, words)
        except ValueError:
            expected = f"{COLUMNS} numbers (frame, pedestrian, x, y)"
            raise ValueError(f"{path}: line {number}: expected {expected}, got {line[:80]!r}") from None
        if not all(map(math.isfinite, (frame, pedestrian, x, y))):
            raise ValueError(f"{path}: line {number}: expected finite numbers, got {line[:80]!r}")
        track = rows.setdefault(pedestrian, {})
        if frame in track:
            raise ValueError(f"{path}: line {number}: pedestrian {pedestrian:g} is in frame {frame:g} twice")
        track[frame] = x, y
    tracks = [np.array([(frame, *track[frame]) for frame in sorted(track)]) for track in rows.values()]
    tracks = [track for track in tracks if len(track) > 1]
    if not tracks:
        raise ValueError(f"{path}: expected a pedestrian with at least two positions, got none")
    begin = min(track[0, 0] for track in tracks)
    for track in tracks:
        track[:, 0] = (track[:, 0] - begin) / frames_per_second
    return Recording(Path(path).stem, tuple(tracks))


def sample_among_pedestrians(
    recording: Recording,
    count: int,
    *,
    seed: int = 0,
    radius: float = RADIUS,
    robot: RobotModel | Mapping[str, Any] | str = "unicycle",
    horizon: str = "fixed",
    obstacles: str = "cost",
) -> list[Scenario]:
    """Sample scenarios with random poses and times of a recording, see `sample_scenario`.

    Scenario i has the seed `seed + i`. The pedestrians do not react to the robot.

    Args:
        recording: the recording.
        count: number of scenarios.
        seed: first seed.
        radius: of a pedestrian (m).
        robot, horizon, obstacles: see `sample_scenario`.

    Raises:
        ValueError: an argument is invalid, or no poses are connected.

    """
    check_at_least("count", count, 1)
    check_positive("radius", radius)
    x_min, y_min, x_max, y_max = arena = recording.arena
    longest = MAX_HORIZON * max(1.0, max(x_max - x_min, y_max - y_min) / (ARENA[2] - ARENA[0]))

    def layout(rng: np.random.Generator) -> ScenarioLayout:
        start = rng.uniform(0.0, max(recording.duration - longest, 0.0))
        return ScenarioLayout(recording.obstacles(start, longest, radius), arena=arena)

    family = CustomFamily(recording.name, layout)
    return [sample_scenario(family, seed + i, robot, horizon, obstacles) for i in range(count)]
