"""Proofs of lower bounds: their content, and files that contain them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leapnav.envs.robots import DifferentialDrive, Unicycle
from leapnav.envs.scenarios.faults import check_at_rest
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.files import atomic_path

FORMAT, VERSION = "leapnav-proof", 1
Pose = tuple[float, float, float]


class ProofError(ValueError):
    """A proof is wrong or incomplete, or a file does not contain one. The message names the fault."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A function on blocks of cells that a proof uses as a lower bound of the distance from the start or the goal.

    Attributes:
        values (m, 8, 8, 8): coefficients, float32.
        scale: factor of all coefficients.
        radius: gauge within which the inequality is not required, see `leapnav.experts.proofs.checker`.
        limit: gauge up to which the distance is bounded by the gauge, larger than the radius.

    """

    values: np.ndarray
    scale: float
    radius: float
    limit: float


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of a proof: two splines, which exclude cells.

    Attributes:
        level: how often the spacing is halved.
        blocks (m, 3): positions of the blocks of 8 x 8 x 8 coefficients.
        start, goal: the splines for the distance from the start and from the goal.

    """

    level: int
    blocks: np.ndarray
    start: Spline
    goal: Spline


@dataclass(frozen=True, eq=False)
class Proof:
    """A proof that no collision-free path of a scenario costs less than `value`; `check_proof` checks it.

    Attributes:
        scenario: the scenario.
        value: the lower bound.
        energy: E of the inequality; the time weight if the horizon is free.
        spacing, headings: width of the cells (m), and number of cells in the heading, at level 0.
        stages: the steps.

    """

    scenario: Scenario
    value: float
    energy: float
    spacing: float
    headings: int
    stages: tuple[Stage, ...]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the proof to a file (a compressed archive of NumPy arrays)."""
        header = {
            "format": FORMAT,
            "version": VERSION,
            "scenario": self.scenario.to_dict(),
            "value": self.value,
            "energy": self.energy,
            "spacing": self.spacing,
            "headings": self.headings,
            "stages": [
                {
                    "level": stage.level,
                    **{
                        side: {"scale": spline.scale, "radius": spline.radius, "limit": spline.limit}
                        for side, spline in (("start", stage.start), ("goal", stage.goal))
                    },
                }
                for stage in self.stages
            ],
        }
        arrays: dict[str, np.ndarray] = {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}
        for number, stage in enumerate(self.stages):
            arrays[f"blocks_{number}"] = stage.blocks.astype(np.int16)
            arrays[f"start_{number}"], arrays[f"goal_{number}"] = stage.start.values, stage.goal.values
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Proof:
        """Read a proof from a file.

        Raises:
            ProofError: the file does not contain a proof.
            OSError: the file cannot be read.

        """
        try:
            with np.load(Path(path), allow_pickle=False) as arrays:
                header = json.loads(arrays["header"].tobytes())
                if (header["format"], header["version"]) != (FORMAT, VERSION):
                    raise ProofError(f"{path}: expected version {VERSION} of a proof, got {header['version']!r}")
                stages = tuple(
                    Stage(
                        stage["level"],
                        arrays[f"blocks_{number}"].astype(np.int32),
                        Spline(arrays[f"start_{number}"], **stage["start"]),
                        Spline(arrays[f"goal_{number}"], **stage["goal"]),
                    )
                    for number, stage in enumerate(header["stages"])
                )
            numbers: dict[str, Any] = {name: header[name] for name in ("value", "energy", "spacing", "headings")}
            for fields in (numbers, *(stage[side] for stage in header["stages"] for side in ("start", "goal"))):
                for name, number in fields.items():
                    if isinstance(number, bool) or not isinstance(number, int | float):
                        raise ProofError(f"{path}: {name}: expected a number, got {number!r}")
        except (ProofError, OSError):
            raise
        except Exception as error:  # a damaged archive may raise any error in NumPy and zipfile
            raise ProofError(f"{path}: not a proof ({type(error).__name__}: {error})") from None
        scenario = Scenario.from_dict(header["scenario"])
        return cls(scenario, stages=stages, **numbers)


def find_ends(scenario: Scenario) -> tuple[Pose, Pose]:
    """Return start and goal (x, y, heading) of a scenario for which lower bounds can be proved.

    Raises:
        ValueError: they cannot; the message names the field.

    """
    check_at_rest(scenario.moves, "lower bounds")
    robot = scenario.robot
    if not isinstance(robot, Unicycle | DifferentialDrive):
        raise ValueError(f"robot: lower bounds need a unicycle or a differential_drive, got {robot.model!r}")
    if len(scenario.outline) != 1 or scenario.outline[0, :3].any():
        raise ValueError(f"robot.footprint: lower bounds need one disc at the centre, got {robot.footprint!r}")
    x, y, heading = scenario.goal
    if heading is None:
        raise ValueError("goal: lower bounds need a heading, got None")
    return scenario.start, (x, y, heading)
