"""`leapnav rollout` and `leapnav dataset check`: datasets of demonstrations."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from leapnav.commands.options import FamilyOrAll, Horizon, Obstacles, Robot
from leapnav.durations import announce, of_scenarios
from leapnav.outputs import FAILED, check_outputs, write_json

# Maximum deviation of a replay: other versions of the libraries may round the last digits differently.
REPLAY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Rollout:
    """Sample scenarios, find their optima, execute them in the environment, and write a Minari dataset.

    The same command resumes an interrupted rollout.
    """

    out: Path
    """Output directory of the dataset."""
    family: FamilyOrAll = "clutter"
    """Family of the scenarios."""
    robot: Robot = "unicycle"
    """Model of the robot."""
    horizon: Horizon = "fixed"
    """Fixed or free horizon."""
    obstacles: Obstacles = "cost"
    """Obstacles with a proximity cost, or hard obstacles, which cost nothing."""
    count: int = 100
    """Number of scenarios."""
    seed: int = 1000
    """First scenario seed: scenario i has seed SEED + i. At least 2, because the included banks have seeds 0 and 1."""
    recoveries: int = 0
    """Number of recoveries per scenario: demonstrations from perturbed states of the optimum."""
    noise: float = 0.0
    """Standard deviation of the noise on the executed actions; the recorded ones are the expert's, in closed loop."""
    workers: int = os.cpu_count() or 1
    """Number of processes; the dataset does not depend on it."""
    dask: str | None = None
    """Address of a Dask scheduler (tcp://host:8786) whose workers are used instead."""
    force: bool = False
    """Replace an existing dataset or unfinished rollout in the output directory."""
    json: Path | None = None
    """JSON file of the summary; "-" for standard output."""

    resumption = "the same command resumes where it stopped"

    def run(self) -> int:
        """Write the dataset."""
        check_outputs(self.json)
        from leapnav.experts.data.demonstrations import dataset_id
        from leapnav.experts.data.rollouts import rollout

        workers = 1 if self.dask else self.workers
        announce(of_scenarios(self.family, self.count, workers) * (1 + self.recoveries / 4), "finding the optima")
        summary = rollout(
            self.family,
            self.count,
            self.out,
            robot=self.robot,
            horizon=self.horizon,
            obstacles=self.obstacles,
            seed=self.seed,
            recoveries=self.recoveries,
            noise=self.noise,
            workers=self.workers,
            dask=self.dask,
            force=self.force,
        )
        print(
            f"wrote {self.out}: {summary.demonstrations} demonstrations, {summary.steps} environment steps "
            f"({summary.unsolved} scenarios without a certified optimum and "
            f"{summary.failed_replays} failed replays left out)"
        )
        name = dataset_id(self.family, self.robot, self.horizon, self.obstacles)
        print(f"load it with minari.load_dataset({name!r}) and MINARI_DATASETS_PATH={self.out}")
        write_json(asdict(summary), self.json)
        return 0


@dataclass(frozen=True)
class CheckDataset:
    """Replay a dataset of demonstrations in the environment and report the maximum deviation.

    Exit code 1: a deviation is above 1e-6.
    """

    action: tyro.conf.Positional[Literal["check"]]
    """What to do."""
    folder: tyro.conf.Positional[Path]
    """Directory written by `leapnav rollout`."""
    json: Path | None = None
    """JSON file of the deviations; "-" for standard output."""

    def run(self) -> int:
        """Replay and report."""
        from leapnav.experts.data.rollouts import check_dataset

        check_outputs(self.json)
        replay = check_dataset(self.folder)
        print(
            f"{self.folder}: {replay.episodes} episodes replayed; maximum deviation of observations "
            f"{replay.observation:.1e}, rewards {replay.reward:.1e}, states {replay.state:.1e} (episode {replay.worst})"
        )
        write_json(asdict(replay), self.json)
        return 0 if max(replay.observation, replay.reward, replay.state) <= REPLAY_TOLERANCE else FAILED
