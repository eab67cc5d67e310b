"""`leapnav rollout` and `leapnav dataset check`: datasets of demonstrations."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from leapnav.commands.options import FamilyOrAll, FamilyTaskOptions, ParallelOptions, PolicyName
from leapnav.outputs import FAILED, check_outputs, write_json

# Maximum deviation of a replay: other versions of the libraries may round the last digits differently.
REPLAY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Rollout(FamilyTaskOptions, ParallelOptions):
    """Sample scenarios, find their optima, execute them in the environment, and write a Minari dataset.

    The same command resumes an interrupted rollout. With --policy, the episodes of policies are recorded instead, for
    offline reinforcement learning; such a rollout begins again.
    """

    out: Path
    """Output directory of the dataset."""
    family: FamilyOrAll = "clutter"
    """Family of the scenarios: built in, module:function, or a file (.bank, .json)."""
    count: int = 100
    """Number of scenarios."""
    seed: int = 1000
    """First scenario seed: scenario i has seed SEED + i. At least 2, because the included banks have seeds 0 and 1."""
    recoveries: int = 0
    """Number of recoveries per scenario: demonstrations from perturbed states of the optimum."""
    noise: float = 0.0
    """Standard deviation of the noise on the actions. The infos contain the expert's actions without it."""
    policy: tuple[PolicyName, ...] = ()
    """Policies whose episodes are recorded instead of the optima, see leapnav evaluate --help; several take turns."""
    name: str | None = None
    """Last part of the Minari dataset id with --policy; by default the name of the policy, or "mixed"."""
    force: bool = False
    """Replace an existing dataset or unfinished rollout in the output directory."""
    json: Path | None = None
    """JSON file of the summary; "-" for standard output."""

    resumption = "the same command resumes where it stopped"

    def run(self) -> int:
        """Write the dataset."""
        check_outputs(self.json)
        if self.policy:
            return self._record()
        if self.name is not None:
            raise ValueError(f"name: expected --policy with it, got only {self.name!r}")
        from leapnav.envs.scenarios.families import task_of
        from leapnav.experts.data.datasets import dataset_id
        from leapnav.experts.data.rollouts import rollout

        summary = rollout(
            self.family,
            self.count,
            self.out,
            **self.task,
            seed=self.seed,
            recoveries=self.recoveries,
            noise=self.noise,
            **self.parallel,
            force=self.force,
        )
        print(
            f"wrote {self.out}: {summary.demonstrations} demonstrations, {summary.steps} environment steps "
            f"({summary.unsolved} scenarios without a certified optimum and "
            f"{summary.failed_replays} failed replays left out)"
        )
        robot, *kinds = task_of(self.family, **self.task)
        name = dataset_id(self.family, robot.model, *kinds)
        print(f"load it with minari.load_dataset({name!r}) and MINARI_DATASETS_PATH={self.out}")
        write_json(asdict(summary), self.json)
        return 0

    def _record(self) -> int:
        """Write the dataset of the episodes of policies."""
        from leapnav.training.runs.recording import record

        if self.recoveries:
            raise ValueError(f"recoveries: expected 0 with --policy, got {self.recoveries}")
        options = {"name": self.name, "seed": self.seed, "noise": self.noise, "force": self.force}
        summary = record(self.policy, self.family, self.count, self.out, **self.task, **options, **self.parallel)
        print(
            f"wrote {self.out}: {summary.episodes} episodes, {summary.steps} environment steps, success "
            f"{100 * summary.success:.1f} %, mean return {summary.mean_return:.2f}"
        )
        print(f"load it with minari.load_dataset({summary.name!r}) and MINARI_DATASETS_PATH={self.out}")
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
