"""`leapnav worlds import`: scenario files from the worlds of other benchmarks."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from leapnav.commands.options import Robot, TaskOptions

if TYPE_CHECKING:
    from leapnav.envs.scenarios.scenario import Scenario


@dataclass(frozen=True)
class ImportBarn(TaskOptions):
    """Read the worlds of the BARN challenge (https://github.com/Daffan/the-barn-challenge, MIT licence)."""

    folder: tyro.conf.Positional[Path]
    """Directory of the files world_N.world, or a clone of the repository."""
    out: Path
    """Output directory of the scenario files."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.barn import read_barn

        return _write(read_barn(self.folder, **self.task), self.out)


@dataclass(frozen=True)
class ImportMovingAI:
    """Read problems on a map of the Moving AI Lab (https://movingai.com/benchmarks, ODC Attribution License)."""

    file: tyro.conf.Positional[Path]
    """Map file (.map)."""
    scen: Path
    """Scenario file (.map.scen)."""
    out: Path
    """Output directory of the scenario files."""
    count: int | None = None
    """Number of problems, evenly spaced in the file; by default all."""
    cell_size: float = 1.0
    """Side length of a cell (m)."""
    robot: Robot = "unicycle"
    """Model of the robot."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.movingai import read_movingai_problems

        scenarios = read_movingai_problems(
            self.file, self.scen, count=self.count, cell_size=self.cell_size, robot=self.robot
        )
        return _write(scenarios, self.out)


@dataclass(frozen=True)
class ImportPedestrians(TaskOptions):
    """Sample poses among recorded pedestrians (text files of the ETH and UCY datasets: frame, pedestrian, x, y)."""

    file: tyro.conf.Positional[Path]
    """Text file of the recording, with positions in metres."""
    out: Path
    """Output directory of the scenario files."""
    count: int = 100
    """Number of scenarios."""
    seed: int = 0
    """First seed: scenario i has seed SEED + i."""
    frames_per_second: float = 25.0
    """Of the numbers of the frames."""
    radius: float = 0.25
    """Radius of a pedestrian (m)."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.pedestrians import read_pedestrians, sample_among_pedestrians

        recording = read_pedestrians(self.file, frames_per_second=self.frames_per_second)
        found = sample_among_pedestrians(recording, self.count, seed=self.seed, radius=self.radius, **self.task)
        return _write(found, self.out)


@dataclass(frozen=True)
class ImportRosMap(TaskOptions):
    """Sample poses on an occupancy grid of ROS (map server, Nav2)."""

    file: tyro.conf.Positional[Path]
    """YAML file of the map; its image is beside it."""
    out: Path
    """Output directory of the scenario files."""
    count: int = 100
    """Number of scenarios."""
    seed: int = 0
    """First seed: scenario i has seed SEED + i."""
    unknown: Literal["occupied", "free"] = "occupied"
    """What unknown cells count as."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.ros_map import read_ros_map, sample_on_map

        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            grid = read_ros_map(self.file, unknown=self.unknown)
        for warning in caught:
            print(f"leapnav: warning: {warning.message}", file=sys.stderr)
        return _write(sample_on_map(grid, self.count, seed=self.seed, **self.task), self.out)


@dataclass(frozen=True)
class ImportDynobench:
    """Read the problems of dynobench (https://github.com/quimortiz/dynobench, MIT licence) for robots that leapnav has.

    The horizon is free with the time weight 1, and the proximity cost is small.
    """

    folder: tyro.conf.Positional[Path]
    """Clone of the repository."""
    out: Path
    """Output directory of the scenario files."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.dynobench import read_dynobench

        problems = read_dynobench(self.folder)
        for name, problem in problems.items():
            if problem.scenario is None:
                print(f"{name}: left out: {problem.reason}")
        return _write([one.scenario for one in problems.values() if one.scenario is not None], self.out)


@dataclass(frozen=True)
class ImportTpcap:
    """Read the cases of the Trajectory Planning Competition of Automated Parking (https://www.tpcap.net)."""

    folder: tyro.conf.Positional[Path]
    """Directory of the files CaseN.csv."""
    out: Path
    """Output directory of the scenario files."""

    def run(self) -> int:
        """Write the scenario files."""
        from leapnav.envs.worlds.tpcap import read_tpcap

        return _write(read_tpcap(self.folder), self.out)


@dataclass(frozen=True)
class Import:
    """Read the worlds of another benchmark from your own download, and write them as scenario files."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[
            Annotated[ImportBarn, tyro.conf.subcommand("barn")]
            | Annotated[ImportDynobench, tyro.conf.subcommand("dynobench")]
            | Annotated[ImportMovingAI, tyro.conf.subcommand("movingai")]
            | Annotated[ImportPedestrians, tyro.conf.subcommand("pedestrians")]
            | Annotated[ImportRosMap, tyro.conf.subcommand("ros-map")]
            | Annotated[ImportTpcap, tyro.conf.subcommand("tpcap")],
            tyro.conf.arg(name=""),
        ]
    ]


def _write(scenarios: Sequence[Scenario], out: Path) -> int:
    """Write scenarios to files with their names."""
    out.mkdir(parents=True, exist_ok=True)
    for scenario in scenarios:
        scenario.to_json(out / f"{scenario.name}.json")
    print(
        f"wrote {len(scenarios)} scenarios to {out}; next: leapnav bank build --scenarios {out} --out {out.name}.bank"
    )
    return 0
