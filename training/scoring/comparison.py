"""Comparison of policies on the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.families import ALL, BANK_ENDING, FAMILIES, check_family, families_of, is_built_in
from leapnav.envs.scenarios.scenario import check_robot
from leapnav.training.config import PPOConfig, RunConfig, read_config
from leapnav.training.policies.files import OBSERVED
from leapnav.training.scoring.adapters import PolicyOrFactory
from leapnav.training.scoring.evaluation import evaluate, known_environment
from leapnav.training.scoring.policy_specs import PolicySpec, group_by_row, load_policy_spec
from leapnav.training.scoring.results import Evaluation, bank_identity
from leapnav.training.scoring.scores import Score, score

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """The results of several policies on the same banks.

    Attributes:
        banks: the banks.
        runs: for each row of the table, the evaluations of its runs on all banks.
        seed: random seed of the bootstrap.
        specs: for each row, what is known of its policies.

    """

    banks: tuple[ScenarioBank, ...]
    runs: Mapping[str, Sequence[Evaluation]]
    seed: int
    specs: Mapping[str, Sequence[PolicySpec]] = field(default_factory=dict)

    @property
    def families(self) -> tuple[str, ...]:
        """The families of the banks."""
        return tuple(dict.fromkeys(bank.family for bank in self.banks))

    @property
    def bank_names(self) -> tuple[str, ...]:
        """Names of the banks that differ from each other: the family, with the file if the family has several banks."""
        forms = [
            lambda bank: bank.family,
            lambda bank: f"{bank.family} ({bank.path.name})",
            lambda bank: f"{bank.family} ({bank.path})",
        ]
        rows = [[form(bank) for form in forms] for bank in self.banks]
        return tuple(
            next((name for k, name in enumerate(row) if sum(other[k] == name for other in rows) == 1), row[-1])
            for row in rows
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas data frame with one row per episode: policy, run, and the columns of `Episode.to_dict`.

        The column `bank` contains the names of the banks.

        Raises:
            ImportError: pandas is not installed.

        """
        frames = []
        names = dict(zip(map(bank_identity, self.banks), self.bank_names, strict=True))
        for name, runs in self.runs.items():
            for number, run in enumerate(runs):
                frame = run.to_dataframe()
                frame.insert(0, "policy", name)
                frame.insert(1, "run", number)
                frame["bank"] = [names[identity] for identity in frame["bank"]]
                frames.append(frame)
        import pandas  # `Evaluation.to_dataframe` has reported if it is missing

        return pandas.concat(frames, ignore_index=True)

    def __repr__(self) -> str:
        rows = ", ".join(f"{row.policy} {row.soc.value:.3f}" for row in self.scores())
        return f"<Comparison: {', '.join(self.families)}; SOC: {rows}>"

    def scores(self) -> list[Score]:
        """Compute the rows of the table."""
        return [score(name, runs, self.seed) for name, runs in self.runs.items()]

    def of(self, part: str | ScenarioBank) -> Comparison:
        """Return the comparison restricted to one family, or to one of the banks."""
        banks = tuple(bank for bank in self.banks if part in (bank, bank.family))
        identities = {bank_identity(bank) for bank in banks}
        runs = {
            name: [replace(run, episodes=tuple(e for e in run if e.bank in identities)) for run in evaluations]
            for name, evaluations in self.runs.items()
        }
        return Comparison(banks, runs, self.seed, self.specs)

    @property
    def folders(self) -> dict[str, list[Path]]:
        """Directories of the training runs of the rows that have any."""
        found = {row: [spec.run for spec in specs if spec.run] for row, specs in self.specs.items()}
        return {row: folders for row, folders in found.items() if folders}

    def trained_on(self, bank: ScenarioBank) -> list[str]:
        """Return the rows with a run that was trained in the scenarios of a bank."""
        rows = self.folders.items()
        return [row for row, folders in rows if any(_trains_on(read_config(folder)[1], bank) for folder in folders)]

    def trained_elsewhere(self, bank: ScenarioBank) -> dict[str, str]:
        """Return in what the training differs from a bank, by row: the robot's parameters, and a built-in family."""
        found = {}
        for row, specs in self.specs.items():
            robots = [spec.trained_robot.differences(bank.robot) for spec in specs if spec.trained_robot]
            texts = [f"with another robot: {text}" for text in dict.fromkeys("; ".join(one) for one in robots if one)]
            families = dict.fromkeys(spec.family for spec in specs if spec.family and is_built_in(spec.family))
            others = [family for family in families if family != bank.family]
            texts += [f"in another family: {', '.join(others)}"] if others else []
            if texts:
                found[row] = "; ".join(texts)
        return found


def _trains_on(config: RunConfig, bank: ScenarioBank) -> bool:
    """Return whether the training scenarios of a run are those of a bank."""
    given: list[str | Path] = [config.family]
    if isinstance(config, PPOConfig) and config.levels != "fresh":
        given.append(config.level_bank or ScenarioBank.shipped(config.family, "train", **config.task).path)
    return any(Path(path).resolve() == bank.path.resolve() for path in given)


# A policy to compare: a name, an object or a function (see `evaluate`), one of these with the arguments of its
# environment, or a list of them, which are runs of one method.
PolicyToCompare = str | PolicyOrFactory | tuple[PolicyOrFactory, Mapping[str, Any]] | list[Any]


def compare(
    policies: Mapping[str, PolicyToCompare],
    bank: ScenarioBank | str | Sequence[ScenarioBank] = "clutter",
    *,
    count: int | None = None,
    environment: Mapping[str, Any] | None = None,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
) -> Comparison:
    """Evaluate policies on the same scenarios, against the optimum.

    The functions `print_scores`, `plot_scores`, `plot_episodes` and `write_report` present the result.

    Args:
        policies: the policies by the names of their rows. A policy is one of the following, or a list of them (runs of
            one method with other seeds, in one row):

            - the name of a baseline or of an included policy, the directory of a policy or a run, or a model saved by
              Stable-Baselines3 (`.zip`), see `leapnav evaluate --help`;
            - an object, a function or a class, see `evaluate`;
            - a tuple of one of these and the arguments of its environment.
        bank: a bank, its file (`.bank`), several banks, the name of a family for its test split, or "all" for those of
            all families, with the kinds of obstacles for which the policies were trained.
        count: number of scenarios of each bank, from the first; None: all.
        environment: arguments of the environment, such as `control_period`. Those that determine observations are not
            used for policies that are given by their names, and those of a model's environment, and of a tuple, take
            precedence.
        seed: random seed of the bootstrap intervals, the disturbances and the random policy.
        workers, dask: see `evaluate`.
        progress: show progress bars.

    Raises:
        FileNotFoundError: there is no policy of this name.
        TypeError: a policy is of no supported type.
        ValueError: an argument is invalid, or a policy expects other observations.

    """
    if not policies:
        raise ValueError("policies: expected at least one, got none")
    specs = []
    for label, given in policies.items():
        for number, member in enumerate(given if isinstance(given, list) else [given]):
            specs.append(_spec(label, f"{label}[{number}]", member, environment, seed))
    if isinstance(bank, str) and bank.endswith(BANK_ENDING):
        banks = [ScenarioBank(bank)]
    elif isinstance(bank, str):
        check_family(bank)
        kinds = sorted({spec.obstacles for spec in specs if spec.obstacles is not None} or {"cost"})
        banks = [one for kind in kinds for one in included_banks(specs, families_of(bank), obstacles=kind)]
    else:
        banks = [bank] if isinstance(bank, ScenarioBank) else list(bank)
    return compare_policies(specs, banks, count=count, seed=seed, workers=workers, dask=dask, progress=progress)


def _spec(label: str, name: str, given: Any, environment: Mapping[str, Any] | None, seed: int) -> PolicySpec:
    """Return the specification of a policy to compare."""
    own: Mapping[str, Any] | None = None
    if isinstance(given, tuple):
        if len(given) != 2:
            raise ValueError(
                f"policies: {label}: expected (policy, arguments of its environment), got {len(given)} values"
            )
        given, own = given
    if isinstance(given, (str, Path)):
        spec = replace(load_policy_spec(str(given), seed=seed, environment=own), name=name, label=label)
        common = {key: value for key, value in (environment or {}).items() if key not in OBSERVED}
    else:
        spec, common = PolicySpec(name, label, None, given, known_environment(given)), environment or {}
    return replace(spec, environment={**common, **spec.environment, **(own or {})})


def included_banks(
    specs: Sequence[PolicySpec],
    families: Sequence[str],
    split: str = "test",
    robot: str | None = None,
    horizon: str | None = None,
    *,
    obstacles: str = "cost",
) -> list[ScenarioBank]:
    """Return the included banks of families for the robot and the horizon of policies.

    Args:
        specs: the policies.
        families: the families.
        split: "train" or "test".
        robot: model of the robot, or JSON of its parameters; None: that of the policies, or the unicycle if all of them
            are baselines.
        horizon: "fixed" or "free"; None: that of the policies, or "fixed" if all of them are baselines.
        obstacles: "cost" or "hard", which a policy does not depend on.

    Raises:
        ValueError: there is no such bank, or the policies have different robots or horizons.

    """
    body = None if robot is None else check_robot(robot)
    model = _common("robot", [spec.robot for spec in specs], body.model if body else None) or "unicycle"
    name = robot if robot is not None and body != check_robot(model) else model
    kind = _common("horizon", [spec.horizon for spec in specs], horizon) or "fixed"
    return [ScenarioBank.shipped(family, split, name, kind, obstacles) for family in families]


def default_banks(
    specs: Sequence[PolicySpec],
    family: str | None = None,
    split: str = "test",
    robot: str | None = None,
    horizon: str | None = None,
    obstacles: str | None = None,
) -> list[ScenarioBank]:
    """Return the included banks on which policies are scored, or those in the directories of the training runs.

    Args:
        specs: the policies.
        family: a family, or "all"; None: those for which the policies were trained, or "clutter" without any.
        split: "train" or "test"; training runs have a test bank only.
        robot, horizon: see `included_banks`; the robot can be JSON text for a bank of a run.
        obstacles: "cost" or "hard"; None: those for which the policies were trained, or "cost" without any.

    Raises:
        FileNotFoundError, ValueError: the configuration of a run is damaged, or see `included_banks`.

    """
    configs = {spec.run: read_config(spec.run)[1] for spec in specs if spec.run is not None}
    if family is not None:
        check_family(family)
    trained = [config.family for config in configs.values()]
    trained += [spec.family for spec in specs if spec.run is None and spec.family in (*FAMILIES, ALL)]
    chosen = [family] if family is not None else trained or ["clutter"]
    families = {name for one in chosen for name in families_of(one)}
    trained_kinds = {config.task["obstacles"] for config in configs.values()}
    trained_kinds |= {spec.obstacles for spec in specs if spec.run is None and spec.obstacles is not None}
    kinds = trained_kinds or {"cost"} if obstacles is None else {obstacles}
    included, own = [], {}  # those of the runs by their identity: runs can have the same bank, or several of a family
    for name in sorted(families, key=lambda name: (*FAMILIES, name).index(name)):
        if name.endswith(BANK_ENDING):
            bank = ScenarioBank(name)
            own[bank_identity(bank)] = bank
            continue
        for kind in sorted(kinds):
            found = [
                bank
                for folder, config in configs.items()
                if config.task["obstacles"] == kind and split == "test"
                if name not in ScenarioBank.shipped_families(**config.task)
                if (path := own_bank(config, folder, name)).exists()
                if _has_robot(bank := ScenarioBank(path), robot, config)
            ]
            own |= {bank_identity(bank): bank for bank in found}
            if not found:
                included += included_banks(specs, [name], split, robot, horizon, obstacles=kind)
    return [*included, *own.values()]


def _has_robot(bank: ScenarioBank, robot: str | None, config: RunConfig) -> bool:
    """Return whether the bank of a run has a robot, which its family may determine, see `task_of`."""
    is_named = config.robot in (None, robot) and robot == bank.robot.model
    return robot is None or is_named or check_robot(robot) == bank.robot


def own_bank(config: RunConfig, folder: Path, family: str, split: str = "test") -> Path:
    """Return the file of the bank that the run in a directory builds for a family without an included one."""
    return folder / (f"{split}.bank" if family == config.family else f"{split}-{family}.bank")


def _common(name: str, values: Sequence[str | None], given: str | None) -> str | None:
    """Return the value that policies have in common, None for baselines, which have none; or the given one.

    Raises:
        ValueError: they have different values, or another one is given.

    """
    found = {value for value in values if value is not None}
    if len(found) > 1:
        raise ValueError(f"policies: expected policies of one {name}, got {', '.join(sorted(found))}")
    common = found.pop() if found else given
    if given is not None and common != given:
        raise ValueError(f"{name}: expected that of the policies, {common!r}, got {given!r}")
    return common


def _check_task(spec: PolicySpec, banks: Sequence[ScenarioBank]) -> None:
    """Check that banks have the kind of horizon and the model of the robot that a policy was trained with, if known."""
    trained = spec.environment.get("horizon"), spec.robot if "robot" in spec.environment else None
    policy = spec.label or spec.name
    for bank in banks:
        here = bank.horizon, bank.robot.model
        for name, own, value in zip(("horizon", "robot"), trained, here, strict=True):
            if own is not None and own != value:
                raise ValueError(f"{name}: {policy} was trained with {own!r}, {bank.path.name} has {value!r}")


def compare_policies(
    specs: Sequence[PolicySpec],
    banks: Sequence[ScenarioBank],
    *,
    count: int | None = None,
    seed: int = 0,
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
) -> Comparison:
    """Evaluate all policies on all scenarios of the banks.

    Args:
        specs: the policies, see `load_policy_spec`.
        banks: the banks, at least one.
        count: number of scenarios of each bank; None: all.
        seed: random seed of the bootstrap intervals and the disturbances.
        workers, dask: see `evaluate`.
        progress: show progress bars.

    Raises:
        ValueError: a bank is given twice, has another robot or horizon than a policy, or see `group_by_row` and
            `evaluate`.

    """
    given: dict[str, ScenarioBank] = {}
    for bank in banks:
        other = given.setdefault(bank_identity(bank), bank)
        if other is not bank:
            raise ValueError(f"banks: expected different ones, got the same content in {other.path} and {bank.path}")
    if len(given) < len(banks):
        raise ValueError("banks: expected different ones, got the same bank more than once")
    runs: dict[str, list[Evaluation]] = {}
    rows = group_by_row(specs)
    for spec in specs:
        _check_task(spec, banks)
    for row, members in rows.items():
        runs[row] = []
        for member in members:
            evaluations = [
                evaluate(
                    member.policy,
                    bank,
                    count=count,
                    environment=member.environment,
                    seed=seed,
                    workers=workers,
                    dask=dask,
                    label=f"{row if len(members) == 1 else member.name}: {bank.family}",
                    progress=progress,
                )
                for bank in banks
            ]
            episodes = tuple(episode for evaluation in evaluations for episode in evaluation)
            milliseconds = float(np.mean([evaluation.milliseconds for evaluation in evaluations]))
            runs[row].append(Evaluation(episodes, milliseconds, evaluations[0].settings))
    return Comparison(tuple(banks), runs, seed, rows)
