"""The folder of a training run: its configuration, checkpoints, logs and evaluations, and going on where it was."""

from __future__ import annotations

import hashlib
import json
import platform
import random
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.policies import BasePolicy

import leapnav
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.families import ALL, FAMILIES
from leapnav.training.checks import check_config
from leapnav.training.config import RunConfig
from leapnav.training.evaluation import Entrant, Evaluation, evaluate
from leapnav.training.policies import save_policy

LIBRARIES = ("gymnasium", "numpy", "numba", "stable-baselines3", "torch")
# Settings that may differ when a run is taken up again.
FREE = ("out", "resume")


class Run:
    """A run's folder.

    | File | Content |
    |---|---|
    | `config.json` | algorithm, configuration, versions |
    | `policy.json`, `weights.pt` | the policy, see `load_policy`; during the run that of the last evaluation |
    | `evaluations.jsonl` | a line for each evaluation: step, seconds, each family's success, collision, SOC, regret |
    | `tensorboard/` | logs |
    | `checkpoint/` | what the run goes on from; a pickle is among its files, so resume only runs that you trust |

    Args:
        algorithm: its name.
        config: the configuration; with `resume` the folder must hold a run of the same.

    Attributes:
        folder: the run's.
        evaluations: the lines so far.
        logger: writes TensorBoard logs.

    Raises:
        FileExistsError: the folder is not empty, and the run is not to be resumed.
        FileNotFoundError: there is nothing to resume.
        ValueError: a setting is impossible, or the folder holds a run of another configuration; the message names the
            setting and both values.

    """

    def __init__(self, algorithm: str, config: RunConfig) -> None:
        check_config(config)
        self.algorithm, self.config, self.folder = algorithm, config, Path(config.out)
        self._plain = {"algorithm": algorithm, **_plain(asdict(config))}
        record = self.folder / "config.json"
        if config.resume:
            self._check_record(record)
        elif self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{self.folder}: exists; --resume goes on with it, or choose another folder")
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            content = {"leapnav": leapnav.__version__, "config": self._plain, "versions": _versions()}
            _write(record, json.dumps(content, indent=1) + "\n")
        self.evaluations: list[dict[str, Any]] = []
        self.logger: Logger = configure(str(self.folder / "tensorboard"), ["tensorboard"])
        self._begun, self._before = time.monotonic(), 0.0

    @property
    def families(self) -> tuple[str, ...]:
        """The families whose scenarios the run learns."""
        return tuple(FAMILIES) if self.config.family == ALL else (self.config.family,)

    @property
    def seconds(self) -> float:
        """Wall-clock time of the run so far, evaluations included, interruptions not."""
        return self._before + time.monotonic() - self._begun

    def _check_record(self, record: Path) -> None:
        if not record.is_file():
            raise FileNotFoundError(f"{record}: no such run to resume")
        try:
            found: dict[str, Any] = json.loads(record.read_text())["config"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{record}: not a run's configuration: {error!r}") from None
        missing = sorted(set(self._plain) - set(found))
        if missing:
            raise ValueError(
                f"{record}: a run of another version of leapnav, without {missing[0]}; it cannot be resumed"
            )
        for name in sorted({*found, *self._plain} - set(FREE)):
            if found.get(name) != self._plain.get(name):
                raise ValueError(
                    f"{name}: the run in {self.folder} has {found.get(name)!r}, got {self._plain.get(name)!r}; a run "
                    "is resumed with its own configuration"
                )

    def evaluate(self, policy: Entrant, step: int, *, final: bool = False) -> list[Evaluation]:
        """Plays the test splits of the run's families, and records what comes of it.

        Args:
            policy: what is evaluated.
            step: samples, or steps of the environment, that it has learned from.
            final: play all scenarios, not only some.

        """
        count = None if final else self.config.evaluation_scenarios
        options: dict[str, Any] = {"environment": self.config.environment, "timed": False, "progress": False}
        found = [
            evaluate(policy, ScenarioBank.shipped(family, "test"), count=count, **options) for family in self.families
        ]
        line: dict[str, Any] = {"step": step, "seconds": round(self.seconds, 3), "final": final}
        for family, evaluation in zip(self.families, found, strict=True):
            line[family] = {
                name: _number(getattr(evaluation, name)) for name in ("success", "collision", "soc", "regret")
            }
            for name, value in line[family].items():
                if value is not None:
                    self.logger.record(f"optimum/{family}/{name}", value)
        self.logger.dump(step)
        self.evaluations.append(line)
        self._write_evaluations()
        return found

    def _write_evaluations(self) -> None:
        _write(self.folder / "evaluations.jsonl", "".join(json.dumps(line) + "\n" for line in self.evaluations))

    def save_policy(self, model: BaseAlgorithm | BasePolicy) -> None:
        """Writes the policy, with what the run is, so that runs that differ in their seed alone can be told."""
        # What the run is, not where it lies or how it is watched.
        training = {name: value for name, value in self._plain.items() if name not in (*FREE, "evaluation_scenarios")}
        save_policy(model, self.folder, self.config.environment, training=training)

    def save_checkpoint(self, write: Callable[[Path], None], progress: Mapping[str, Any]) -> None:
        """Replaces the checkpoint; a run that is killed meanwhile has the old one or the new one.

        Args:
            write: writes files into a folder.
            progress: what else to remember, JSON.

        """
        partial, kept = self.folder / ".checkpoint-partial", self.folder / "checkpoint"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        write(partial)
        th.save(_generators(), partial / "generators.pt")
        manifest = {
            "files": {path.name: _digest(path) for path in sorted(partial.iterdir())},
            "progress": dict(progress),
            "seconds": self.seconds,
            "evaluations": len(self.evaluations),
        }
        (partial / "manifest.json").write_text(json.dumps(manifest) + "\n")
        old = self.folder / ".checkpoint-old"
        shutil.rmtree(old, ignore_errors=True)
        if kept.exists():
            kept.rename(old)
        partial.rename(kept)
        shutil.rmtree(old, ignore_errors=True)

    def load_checkpoint(self) -> tuple[Path, dict[str, Any]] | None:
        """The checkpoint's folder and progress, once its files are checked; None if there is none yet.

        What was recorded after the checkpoint is forgotten. `restore_generators` comes last.

        Raises:
            ValueError: the checkpoint is damaged; the message says which file.

        """
        folder = self.folder / "checkpoint"
        if not folder.exists() and (self.folder / ".checkpoint-old").exists():
            # Killed between the two renamings.
            (self.folder / ".checkpoint-old").rename(folder)
        if not folder.exists():
            return None
        try:
            manifest = json.loads((folder / "manifest.json").read_text())
            digests, progress = dict(manifest["files"]), dict(manifest["progress"])
            self._before, count = float(manifest["seconds"]), int(manifest["evaluations"])
            lines = (self.folder / "evaluations.jsonl").read_text().splitlines() if count else []
            self.evaluations = [json.loads(line) for line in lines[:count]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{folder}: a damaged checkpoint: {error}") from None
        for name, digest in digests.items():
            if not (folder / name).is_file() or _digest(folder / name) != digest:
                raise ValueError(f"{folder / name}: damaged; the run cannot be resumed")
        self._begun = time.monotonic()
        if count:
            self._write_evaluations()
        return folder, progress

    def restore_generators(self) -> None:
        """Sets the global generators of Python, NumPy and torch as they were at the checkpoint."""
        state = th.load(self.folder / "checkpoint" / "generators.pt", weights_only=True)
        th.set_rng_state(state["torch"])
        np.random.set_state(("MT19937", state["numpy"].numpy().astype(np.uint32), *state["numpy_rest"]))  # noqa: NPY002
        random.setstate((state["python"][0], tuple(state["python"][1]), state["python"][2]))


def _generators() -> dict[str, Any]:
    numpy_state: Any = np.random.get_state()  # noqa: NPY002 (Stable-Baselines3 draws from it)
    _, keys, *rest = numpy_state
    return {
        "torch": th.get_rng_state(),
        "numpy": th.as_tensor(keys.astype(np.int64)),
        "numpy_rest": rest,
        "python": list(random.getstate()),
    }


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
        "threads": str(th.get_num_threads()),
        "begun": datetime.now().astimezone().isoformat(timespec="seconds"),
    }


def _plain(value: Any) -> Any:
    """As JSON has it."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(path: Path, text: str) -> None:
    """Writes a file; an interruption leaves no half of one."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)
