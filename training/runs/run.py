"""Run directories: configuration, policy, evaluations, logs, and checkpoints to resume from."""

from __future__ import annotations

import json
import platform
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.policies import BasePolicy

import leapnav
from leapnav.envs.robots import RobotModel
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import ALL, BANK_ENDING, FAMILIES, families_of, sample_scenario, task_of
from leapnav.envs.utils.files import digest, write_text
from leapnav.envs.utils.json_utils import encode, plain
from leapnav.experts.data.banks import build_bank
from leapnav.training.config import LATER_SENSORS, LATER_SETTINGS, RunConfig
from leapnav.training.policies.files import write_policy
from leapnav.training.runs.checks import check_config
from leapnav.training.scoring.adapters import PolicyOrFactory
from leapnav.training.scoring.comparison import own_bank
from leapnav.training.scoring.evaluation import evaluate
from leapnav.training.scoring.results import Evaluation

FINAL_SCENARIOS: int | None = None  # in the final evaluation; None: all of the bank
# Number of scenarios and seeds of the banks for the evaluations of a family that is not built in.
BANK_COUNT, BANK_SEEDS = 100, {"train": 0, "test": 1}
N_SAMPLED = 8  # scenarios of a function whose robots are compared
LIBRARIES = ("gymnasium", "numpy", "numba", "stable-baselines3", "torch")  # with their versions in config.json
# Settings that may differ when a run is resumed.
FREE_SETTINGS = ("out", "resume")
# Settings by which a resumed run is extended; `config.json` records the changes.
EXTENSIONS = ("total_timesteps", "learning_rate", "dagger.rounds")
LENGTHS = ("total_timesteps", "dagger.rounds")  # those that may only increase
MEASURES = ("success", "collision", "soc", "regret", "reached_regret")  # of an evaluation, for each family


class Run:
    """The directory of a training run.

    | File | Content |
    |---|---|
    | `config.json` | algorithm, configuration, versions of the libraries, earlier values of changed settings |
    | `policy.json`, `weights.pt` | the policy of the last evaluation, see `load_policy` |
    | `evaluations.jsonl` | one line per evaluation: step, seconds, split; the `MEASURES` per family |
    | `tensorboard/` | logs |
    | `train.bank`, `test.bank` | scenarios of the evaluations, if there are no included ones |
    | `checkpoint/` | state to resume from; it contains pickle files, so resume only runs from a trusted source |

    Args:
        algorithm: name of the algorithm.
        config: the configuration; with `resume`, the directory must contain a run with the same configuration.

    Attributes:
        folder: the run directory.
        evaluations: the lines of `evaluations.jsonl`.
        logger: writer of the TensorBoard logs.

    Raises:
        FileExistsError: the directory is not empty, and `resume` is not set.
        FileNotFoundError: there is no run to resume.
        ValueError: a setting is invalid, or the directory contains a run with another configuration; the message
            contains the setting and both values.

    """

    def __init__(self, algorithm: str, config: RunConfig) -> None:
        check_config(config)
        self._robot = _robot_of(config)  # before the directory exists: the function of a family may fail
        self.algorithm, self.config, self.folder = algorithm, config, Path(config.out)
        self._settings: dict[str, Any] = {"algorithm": algorithm, **plain(config)}
        path = self.folder / "config.json"
        if config.resume:
            self._check_settings(path)
        elif self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder}: exists; use --resume to continue this run, or another directory")
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            content = {"leapnav": leapnav.__version__, "config": self._settings, "versions": _versions()}
            write_text(path, encode(content, indent=1) + "\n")
        self.evaluations: list[dict[str, Any]] = []
        self.logger: Logger = configure(str(self.folder / "tensorboard"), ["tensorboard"])
        self._started, self._seconds_before = time.monotonic(), 0.0

    @property
    def families(self) -> tuple[str, ...]:
        """The families of the run's scenarios."""
        return families_of(self.config.family)

    @property
    def seconds(self) -> float:
        """Wall-clock time of the run (s), with evaluations and without interruptions."""
        return self._seconds_before + time.monotonic() - self._started

    def _check_settings(self, path: Path) -> None:
        """Check that the stored configuration is that of this run, apart from `EXTENSIONS`, which are recorded."""
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such run to resume")
        try:
            record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            stored: dict[str, Any] = record["config"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not the configuration of a run: {error!r}") from None
        if stored.get("algorithm") != self.algorithm:
            raise ValueError(
                f"{self.folder}: a run of {str(stored.get('algorithm')).upper()}, not of {self.algorithm.upper()}; "
                f"resume it by `leapnav train {stored.get('algorithm')}`"
            )
        after = _flat(self._settings)
        later = {name: value for name, value in (LATER_SENSORS | LATER_SETTINGS).items() if name in after}
        missing = sorted(set(self._settings) - set(stored) - set(later))
        if missing:
            raise ValueError(f"{path}: a run of another version of leapnav, without {missing[0]}; it cannot be resumed")
        before = {**later, **_flat(stored)}
        names = sorted({*before, *after} - set(FREE_SETTINGS))
        changed = [name for name in names if before.get(name) != after.get(name)]
        for name in changed:
            old, new = before.get(name), after.get(name)
            if name not in EXTENSIONS:
                raise ValueError(
                    f"{name}: the run in {self.folder} has {old!r}, got {new!r}; resume a run with its own "
                    f"configuration, apart from {', '.join(EXTENSIONS[:-1])} and {EXTENSIONS[-1]}"
                )
            if name in LENGTHS and (old is None or new is None or new < old):
                raise ValueError(f"{name}: expected at least {old!r}, those of the run in {self.folder}, got {new!r}")
        if changed:
            earlier = {name: before.get(name) for name in changed}
            record["changes"] = [*record.get("changes", []), {"before": earlier, "date": _now()}]
            record["config"] = self._settings
            write_text(path, encode(record, indent=1) + "\n")

    def evaluate(self, policy: PolicyOrFactory, step: int, *, final: bool = False) -> list[Evaluation]:
        """Evaluate a policy on the training splits of the run's families, at the end on the test splits; record it.

        Nothing that is chosen during a run depends on the test splits.

        Args:
            policy: the policy.
            step: number of samples or environment steps from which the policy has learned.
            final: play all scenarios of the test splits (`FINAL_SCENARIOS`) instead of the first `evaluation_scenarios`
                of the training splits.

        Returns:
            One evaluation for each family.

        """
        split, count = ("test", FINAL_SCENARIOS) if final else ("train", self.config.evaluation_scenarios)
        options: dict[str, Any] = {"environment": self.config.environment, "timed": False, "progress": False}
        evaluations = [evaluate(policy, self._bank(family, split), count=count, **options) for family in self.families]
        line: dict[str, Any] = {"step": step, "seconds": round(self.seconds, 3), "split": split, "final": final}
        for family, evaluation in zip(self.families, evaluations, strict=True):
            line[family] = plain({name: getattr(evaluation, name) for name in MEASURES})
            for name, value in line[family].items():
                if value is not None:
                    self.logger.record(f"optimum/{family}/{name}", value)
        self.logger.dump(step)
        self.evaluations.append(line)
        self._write_evaluations()
        return evaluations

    def _bank(self, family: str, split: str) -> ScenarioBank:
        """Return the included bank of a family, the family if it is a bank, or one built in the run directory."""
        task: dict[str, Any] = self.config.task
        if family.endswith(BANK_ENDING):
            return ScenarioBank(family)
        if family in ScenarioBank.shipped_families(**task, split=split):
            return ScenarioBank.shipped(family, split, **task)
        path, seed = own_bank(self.config, self.folder, family, split), BANK_SEEDS[split]
        return build_bank(family, BANK_COUNT, path, **task, seed=seed, progress=False)

    def _write_evaluations(self) -> None:
        write_text(self.folder / "evaluations.jsonl", "".join(encode(line) + "\n" for line in self.evaluations))

    def save_policy(self, model: BaseAlgorithm | BasePolicy) -> None:
        """Save the policy with the settings of the run, by which runs that differ only in their seed are grouped."""
        excluded = (*FREE_SETTINGS, "evaluation_scenarios")  # no influence on the policy
        training = {name: value for name, value in self._settings.items() if name not in excluded}
        training["robot"] = self._robot
        write_policy(model, self.folder, self.config.environment, training=training)

    def save_checkpoint(self, write: Callable[[Path], None], progress: Mapping[str, Any]) -> None:
        """Replace the checkpoint; if the process is killed meanwhile, the old one or the new one can be loaded.

        Args:
            write: function that writes files into a directory.
            progress: further state to store, as JSON.

        """
        partial, current = self.folder / ".checkpoint-partial", self.folder / "checkpoint"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        write(partial)
        manifest = {
            "files": {path.name: digest(path) for path in sorted(partial.iterdir())},
            "progress": dict(progress),
            "seconds": self.seconds,
            "evaluations": len(self.evaluations),
        }
        # Not `encode`: NaN in the progress has to be restored as NaN.
        (partial / "manifest.json").write_text(json.dumps(manifest) + "\n", encoding="utf-8")
        old = self.folder / ".checkpoint-old"
        shutil.rmtree(old, ignore_errors=True)
        if current.exists():
            current.rename(old)
        partial.rename(current)
        shutil.rmtree(old, ignore_errors=True)

    def load_checkpoint(self) -> tuple[Path, dict[str, Any]] | None:
        """Load the checkpoint, and discard the evaluations recorded after it.

        Returns:
            The directory and the progress of the checkpoint; None if there is no checkpoint.

        Raises:
            ValueError: the checkpoint is damaged; the message contains the file.

        """
        folder = self.folder / "checkpoint"
        if not folder.exists() and (self.folder / ".checkpoint-old").exists():
            # The process was killed between the two renames in `save_checkpoint`.
            (self.folder / ".checkpoint-old").rename(folder)
        if not folder.exists():
            return None
        try:
            manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            digests, progress = dict(manifest["files"]), dict(manifest["progress"])
            self._seconds_before, count = float(manifest["seconds"]), int(manifest["evaluations"])
            lines = (self.folder / "evaluations.jsonl").read_text(encoding="utf-8").splitlines() if count else []
            self.evaluations = [json.loads(line) for line in lines[:count]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{folder}: a damaged checkpoint: {error}") from None
        for name, expected in digests.items():
            if not (folder / name).is_file() or digest(folder / name) != expected:
                raise ValueError(f"{folder / name}: damaged; the run cannot be resumed")
        self._started = time.monotonic()
        if count:
            self._write_evaluations()
        return folder, progress


def _robot_of(config: RunConfig) -> dict[str, Any] | None:
    """Return the robot of a run; None if scenarios of a bank, or the first ones of a function, have different ones."""
    robot, *_ = task_of(config.family, config.robot, config.horizon, config.obstacles)
    found: Iterable[RobotModel] = ()
    if config.family.endswith(BANK_ENDING):
        found = (scenario.robot for scenario in ScenarioBank(config.family))
    elif config.family not in (*FAMILIES, ALL):
        found = (sample_scenario(config.family, seed, **config.task).robot for seed in range(N_SAMPLED))
    return robot.model_dump(mode="json") if all(one == robot for one in found) else None


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings of a run with those of its parts under names such as "dagger.rounds"."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
        "threads": str(th.get_num_threads()),
        "begun": _now(),
    }


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
