"""Files of scenarios, given one by one, by a pattern, or as a directory."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from glob import glob
from pathlib import Path

from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario

PathLike = str | os.PathLike[str]


def read_scenarios(files: PathLike | Iterable[PathLike]) -> list[Scenario]:
    """Read scenario files, in the order of their names.

    A scenario whose file does not name it gets the name of the file.

    Args:
        files: a file, a pattern such as "worlds/*.json", a directory for the files `*.json` in it, or several of these.

    Raises:
        FileNotFoundError: there is no such file, or no file matches a pattern.
        ScenarioError: a file is not a valid scenario, which the message names, or two scenarios have the same name.

    """
    given = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    paths = [path for one in given for path in _matches(one)]
    scenarios = [_read(path) for path in paths]
    _check_names(scenarios)
    return scenarios


def check_collection(scenarios: Sequence[Scenario]) -> None:
    """Check that scenarios can be in one bank.

    Raises:
        ScenarioError: there are none, two have the same name, they have different robot models, kinds of horizon or
            kinds of obstacles, or the cost of one is not that of an environment; the message names the scenario.

    """
    if not scenarios:
        raise ScenarioError("scenarios: expected at least one, got none")
    _check_names(scenarios)
    for scenario in scenarios:
        _ = scenario.task  # refuses costs that an environment cannot have
        for name, found, expected in (
            ("robot", scenario.robot.model, scenarios[0].robot.model),
            ("horizon", scenario.horizon_kind, scenarios[0].horizon_kind),
            ("obstacles", scenario.cost.obstacles, scenarios[0].cost.obstacles),
        ):
            if found != expected:
                raise ScenarioError(
                    f"Scenario {scenario.name!r}: {name}: expected that of {scenarios[0].name!r}, {expected!r}, "
                    f"got {found!r}; build a bank for each"
                )


def _check_names(scenarios: Sequence[Scenario]) -> None:
    for name, count in Counter(scenario.name for scenario in scenarios).items():
        if count > 1:
            raise ScenarioError(f"scenarios: expected different names, {count} are named {name!r}")


def _matches(given: PathLike) -> list[Path]:
    """Return the files that a path or a pattern stands for."""
    path = Path(given)
    if path.is_dir():
        found = sorted(path.glob("*.json"))
    elif path.exists():
        found = [path]
    else:
        found = sorted(Path(name) for name in glob(str(given), recursive=True))
    if not found:
        raise FileNotFoundError(f"{given}: no such scenario file")
    return found


def _read(path: Path) -> Scenario:
    try:
        scenario = Scenario.from_json(path)
    except ScenarioError as error:
        message = str(error)
        raise ScenarioError(message if str(path) in message else f"{path}: {message}") from None
    return scenario if "name" in scenario.model_fields_set else scenario.model_copy(update={"name": path.stem})
