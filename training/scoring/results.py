"""Results of an evaluation: an episode of a policy, and all episodes on a bank."""

from __future__ import annotations

import gzip
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from leapnav.envs.scenarios.bank import ADDED, ScenarioBank, digest
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.utils.json_utils import encode, plain

if TYPE_CHECKING:
    import pandas

MEASURES = ("soc", "spl", "sct", "regret", "reached_soc", "reached_regret")
_ARRAYS = ("states", "costs")  # not in the record of an episode


@dataclass(frozen=True, eq=False)
class Episode:
    """The result of a policy on one scenario.

    Attributes:
        family, bank, index, scenario: the scenario: its family, the identity of its bank (see `bank_identity`), its
            index in the bank, its name.
        success, collision: outcome of the episode.
        cost: cost J of the episode.
        episode_return: sum of the rewards.
        reference_cost: optimal cost J* of the scenario.
        reached_reference: optimal cost J* for the state that a successful episode has reached, see
            `find_reached_optimum`; NaN for other episodes, and if no certified extremal was found.
        clearance: minimum clearance of the episode (m).
        reference_clearance: minimum clearance of the optimum (m).
        reversing: whether the optimum contains backward driving.
        states (K + 1, n): the states before and after each environment step.
        costs (K + 1,): the cost J so far at these states.
        lower_bound: proved lower bound of the cost of the scenario; NaN if none is known.
        truncated: whether the time limit of a free horizon ended the episode, without a penalty for the missed goal.
        length: length (m) of the path of the robot's position.
        duration: of the episode (s).
        goal_distance, heading_error: of the last pose from the goal (m, rad): by how much a failure missed it.
        shortest_length: length (m) of the shortest path of the scenario without contact; NaN if it is not known.
        shortest_time: minimum time (s) of the scenario without contact; NaN if it is not known.

    """

    family: str
    bank: str
    index: int
    scenario: str
    success: bool
    collision: bool
    cost: float
    episode_return: float
    reference_cost: float
    reached_reference: float
    clearance: float
    reference_clearance: float
    reversing: bool
    states: np.ndarray
    costs: np.ndarray
    lower_bound: float = math.nan
    truncated: bool = False
    length: float = math.nan
    duration: float = math.nan
    goal_distance: float = math.nan
    heading_error: float = math.nan
    shortest_length: float = math.nan
    shortest_time: float = math.nan

    @property
    def spl(self) -> float:
        """Success weighted by path length: S l / max(p, l), with the length p and the shortest length l.

        P. Anderson et al., On evaluation of embodied navigation agents, 2018. NaN if the shortest length is not known.
        """
        return self._weighted(self.shortest_length, self.length)

    @property
    def sct(self) -> float:
        """Success weighted by completion time: S T* / max(T, T*), with the duration T and the minimum time T*.

        N. Yokoyama, S. Ha, D. Batra, Success weighted by completion time, 2021. NaN if the minimum time is not known.
        """
        return self._weighted(self.shortest_time, self.duration)

    def _weighted(self, least: float, value: float) -> float:
        if math.isnan(least):
            return math.nan
        return least / max(value, least) if self.success and least > 0.0 else float(self.success)

    @property
    def soc(self) -> float:
        """Success weighted by optimal cost: S J* / max(J, J*), with J* of the scenario."""
        return self._weighted(self.reference_cost, self.cost)

    @property
    def reached_soc(self) -> float:
        """SOC for the pose reached: as `soc`, with J* for that pose; NaN if that is not known."""
        return self._weighted(self.reached_reference, self.cost) if self.success else 0.0

    @property
    def ratio(self) -> float:
        """Cost ratio J / J* of the performance profile, with J* of the scenario; infinite for a failure."""
        return self.cost / self.reference_cost if self.success else math.inf

    @property
    def regret(self) -> float:
        """Regret (J - J*) / J* of a successful episode, with J* of the scenario; NaN for others.

        J* is the cost of the best known optimum. A robot may stop within the tolerances of the goal, so the regret can
        be slightly negative; see `reached_regret`.
        """
        return self.cost / self.reference_cost - 1.0 if self.success else math.nan

    @property
    def reached_regret(self) -> float:
        """Regret for the pose reached: (J - J*) / J* of a successful episode with J* for that pose; NaN if not known.

        It is negative only if the episode is cheaper than the best optimum that the search found, or if the robot
        slips: its path then violates the unicycle model.
        """
        return self.cost / self.reached_reference - 1.0

    @property
    def true_regret(self) -> tuple[float, float]:
        """Proved limits of J / J_0 - 1, where J_0 is the infimum of the cost of collision-free paths to the goal pose.

        J_0 is between `lower_bound` and `reference_cost`. A robot may stop within the tolerances of the goal, so the
        limits can be negative and need not contain `reached_regret`. NaN if no lower bound is known or the episode is
        no success; the upper limit is infinite if the lower bound is not positive.
        """
        if math.isnan(self.lower_bound) or not self.success:
            return math.nan, math.nan
        high = self.cost / self.lower_bound - 1.0 if self.lower_bound > 0 else math.inf
        return self.cost / self.reference_cost - 1.0, high

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes without the states and their costs, and the measures that follow from them."""
        record = {name: value for name, value in vars(self).items() if name not in (*_ARRAYS, "episode_return")}
        derived = {name: getattr(self, name) for name in MEASURES}
        return {**record, "return": self.episode_return, **derived}


def write_episodes(runs: Mapping[str, Sequence[Evaluation]], path: str | os.PathLike[str]) -> None:
    """Write the episodes of evaluations as compressed JSON lines (`.jsonl.gz`), one for each episode.

    A line contains the policy, the number of its run, and the attributes of the `Episode` without the states and their
    costs; numbers have seven significant digits. `pandas.read_json(path, lines=True)` reads the file too.

    Args:
        runs: the evaluations of each policy, as in `Comparison.runs`.
        path: the file.

    """
    lines = []
    for policy, evaluations in runs.items():
        for number, evaluation in enumerate(evaluations):
            for episode in evaluation:
                values = {name: value for name, value in vars(episode).items() if name not in _ARRAYS}
                values = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in values.items()}
                lines.append(encode(plain({"policy": policy, "run": number, **values})) + "\n")
    # Without the time, so that the same episodes give the same bytes.
    Path(path).write_bytes(gzip.compress("".join(lines).encode(), mtime=0))


def read_episodes(path: str | os.PathLike[str]) -> dict[str, list[Evaluation]]:
    """Read a file of `write_episodes`: the evaluations of each policy, without states, times and settings.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it contains something else.

    """
    runs: dict[str, dict[int, list[Episode]]] = {}
    values: dict[str, Any]
    try:
        text = gzip.decompress(Path(path).read_bytes()).decode()
        for line in text.splitlines():
            values = {name: math.nan if value is None else value for name, value in json.loads(line).items()}
            policy, number = values.pop("policy"), values.pop("run")
            episode = Episode(**values, states=np.empty((0, 3)), costs=np.empty(0))
            runs.setdefault(policy, {}).setdefault(number, []).append(episode)
    except (ValueError, TypeError, KeyError, AttributeError, EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path}: no file of episodes: {error!r}") from None
    return {
        policy: [Evaluation(tuple(members[number]), math.nan) for number in sorted(members)]
        for policy, members in runs.items()
    }


def bank_identity(bank: ScenarioBank) -> str:
    """Return a digest of the scenarios and the optima of a bank, by which banks of one family are distinguished.

    It depends neither on the path of the file nor on datasets that can be added later.
    """
    content = {name: value for name, value in bank.checksums.items() if name not in (*ADDED, "attributes")}
    return digest(json.dumps(content, sort_keys=True).encode())


def bank_of(episode: Episode, banks: Sequence[ScenarioBank]) -> ScenarioBank:
    """Return the bank of an episode.

    Raises:
        ValueError: it is none of the given ones.

    """
    for bank in banks:
        if bank_identity(bank) == episode.bank:
            return bank
    given = ", ".join(str(bank.path) for bank in banks) or "none"
    raise ValueError(f"banks: expected that of the episode {episode.scenario!r} ({episode.family}), got {given}")


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of a policy on a bank.

    Attributes:
        episodes: the episodes, in the order of the bank.
        milliseconds: median computation time of one action (ms).
        settings: settings of the environment.

    """

    episodes: tuple[Episode, ...]
    milliseconds: float
    settings: EnvironmentSettings = field(default_factory=EnvironmentSettings)

    def __repr__(self) -> str:
        families = ", ".join(dict.fromkeys(episode.family for episode in self.episodes))
        return (
            f"<Evaluation: {len(self)} episodes ({families}), success {100 * self.success:.1f} %, collision "
            f"{100 * self.collision:.1f} %, SOC {self.soc:.3f}, median regret {100 * self.regret:z.2f} %>"
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas data frame with one row per episode and the columns of `Episode.to_dict`.

        Raises:
            ImportError: pandas is not installed.

        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError('to_dataframe needs pandas: pip install "leapnav[pandas]"') from error
        return pandas.DataFrame([episode.to_dict() for episode in self.episodes])

    def __len__(self) -> int:
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)

    @property
    def success(self) -> float:
        """Success rate."""
        return float(np.mean([episode.success for episode in self.episodes]))

    @property
    def collision(self) -> float:
        """Collision rate."""
        return float(np.mean([episode.collision for episode in self.episodes]))

    @property
    def soc(self) -> float:
        """Mean success weighted by optimal cost."""
        return float(np.mean([episode.soc for episode in self.episodes]))

    @property
    def regret(self) -> float:
        """Median regret of the successful episodes; NaN if there are none."""
        values = [episode.regret for episode in self.episodes if episode.success]
        return float(np.median(values)) if values else math.nan

    @property
    def reached_regret(self) -> float:
        """Median regret for the pose reached, of the episodes for which it is known; NaN if there are none."""
        values = [episode.reached_regret for episode in self.episodes if not math.isnan(episode.reached_regret)]
        return float(np.median(values)) if values else math.nan
