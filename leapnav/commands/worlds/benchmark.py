"""`leapnav benchmark`: policies in the worlds of other benchmarks."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from leapnav.commands.options import Horizon, Robot
from leapnav.outputs import check_outputs, write_json


@dataclass(frozen=True)
class Benchmark:
    """Score policies in the worlds of another benchmark, with its own score beside ours.

    The worlds are solved first, and the optima are stored in a bank. The BARN challenge runs in another simulator
    (Gazebo), with another robot, and counts the time only: its published scores cannot be compared with these.
    """

    name: tyro.conf.Positional[Literal["barn"]]
    """Name of the benchmark."""
    folder: tyro.conf.Positional[Path]
    """Directory of the files world_N.world, or a clone of the challenge's repository."""
    policy: tuple[str, ...] = ("expert",)
    """Policies, see `leapnav evaluate`."""
    bank: Path = Path("barn.bank")
    """Bank of the worlds; it is built unless it exists."""
    robot: Robot = "unicycle"
    """Model of the robot."""
    horizon: Horizon = "fixed"
    """Fixed or free horizon."""
    count: int | None = None
    """Number of worlds; by default all."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: Path | None = None
    """JSON file of the tables and of every episode; "-" for standard output."""

    @property
    def resumption(self) -> str:
        """What to do after an interruption."""
        return "the same command resumes the bank where it stopped"

    def run(self) -> int:
        """Build the bank, play the episodes and report the scores."""
        check_outputs(self.json)
        from leapnav.envs.worlds.barn import LICENCE, ORIGIN, path_lengths, read_barn
        from leapnav.experts.data.banks import build_bank_of
        from leapnav.training.scoring.barn import barn_scores
        from leapnav.training.scoring.comparison import compare_policies
        from leapnav.training.scoring.policy_specs import load_policy_spec
        from leapnav.training.scoring.reports import print_barn_scores, print_scores, scores_to_dict

        specs = [load_policy_spec(name) for name in self.policy]
        scenarios = read_barn(self.folder, robot=self.robot, horizon=self.horizon)
        bank = build_bank_of(scenarios, self.bank, doubtful=True, origin=ORIGIN, licence=LICENCE, workers=self.workers)
        assert bank.given is not None
        for name, reason in bank.given["rejected"].items():
            print(f"{name}: left out: {reason}")
        if bank.given["doubtful"]:
            print(
                f"doubtful optima, since a cheaper solution touches or was not certified: {len(bank.given['doubtful'])}"
            )
        comparison = compare_policies(specs, [bank], count=self.count, workers=self.workers)
        scores = barn_scores(comparison, path_lengths(self.folder))
        print_scores(comparison)
        print_barn_scores(scores)
        write_json({**scores_to_dict(comparison), "barn": [asdict(row) for row in scores]}, self.json)
        return 0
