"""Old names that keep working for one version, each with a DeprecationWarning."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, TypeVar

T = TypeVar("T")

# Modules of version 0.1, and where their content is now.
_ENVS = {
    "arcs": "simulation.arcs",
    "bank": "scenarios.bank",
    "crowds": "shapes.proximity",
    "driving": "simulation.stepping",
    "families": "scenarios.families",
    "fields": "shapes.field",
    "fleet": "simulation.simulator",
    "maps": "scenarios.maps",
    "observations": "simulation.observations",
    "observer": "simulation.observer",
    "physics": "simulation.bodies",
    "rendering": "simulation.rendering",
    "scenario": "scenarios.scenario",
    "sensing": "simulation.sensing",
    "tasks": "scenarios.sources",
}
_EXPERTS = {
    "banks": "data.banks",
    "certificate": "problem.certificate",
    "collocation": "solvers.collocation",
    "conjugate_points": "problem.conjugate_points",
    "demonstrations": "data.demonstrations",
    "direct": "transcription.direct",
    "dynamics": "problem.dynamics",
    "extremal": "problem.extremal",
    "feasible_path": "solvers.feasible_path",
    "feedback": "acting.feedback",
    "homotopy": "continuation",
    "initial_path": "solvers.initial_paths",
    "integrator": "numerics.integrator",
    "ipopt": "search.ipopt",
    "lattice": "search.lattice",
    "leapfrog": "solvers.leapfrog",
    "linear": "numerics.linear",
    "methods": "solve",
    "multiple_shooting": "solvers.multiple_shooting",
    "nodes": "solvers.nodes",
    "path_class": "search.path_class",
    "policy": "acting.policy",
    "rollouts": "data.rollouts",
    "shortest_paths": "search.shortest_paths",
    "single_shooting": "solvers.single_shooting",
    "system": "problem.system",
}
_TRAINING = {
    "actors": "policies.actors",
    "anchored": "policies.kl_regularized",
    "baselines": "policies.baselines",
    "checks": "runs.checks",
    "cloning": "learning.cloning",
    "contest": "scoring.comparison",
    "dagger": "learning.dagger",
    "dataset": "learning.dataset",
    "entrants": "scoring.policy_specs",
    "evaluation": "scoring.evaluation",
    "html_report": "scoring.html_report",
    "imitation": "runs.imitation",
    "jump_start": "robots.jump_start",
    "reinforcement": "runs.reinforcement",
    "replay": "learning.replay",
    "reports": "scoring.reports",
    "rewards": "robots.rewards",
    "scores": "scoring.scores",
    "symmetries": "learning.symmetries",
    "vec_env": "robots.vec_env",
    "warmstart": "learning.warm_start",
}
MOVED = {
    f"leapnav.{package}.{old}": f"leapnav.{package}.{new}"
    for package, table in (("envs", _ENVS), ("experts", _EXPERTS), ("training", _TRAINING))
    for old, new in table.items()
}
# Names that have changed as well, by their old module.
RENAMED = {
    "leapnav.envs.fleet": {"Fleet": "BatchSimulator"},
    "leapnav.envs.tasks": {"Tasks": "ScenarioSource"},
    "leapnav.envs.observations": {"Layout": "ObservationLayout"},
    "leapnav.experts.nodes": {"Settings": "SolverOptions"},
    "leapnav.training.anchored": {"AnchoredPolicy": "KLRegularizedPolicy"},
    "leapnav.training.contest": {"Contest": "Comparison", "contest": "compare_policies"},
    "leapnav.training.entrants": {
        "NamedEntrant": "PolicySpec",
        "grouped": "group_by_row",
        "load_entrant": "load_policy_spec",
        "make_entrant": "make_policy_from_spec",
    },
}


class _MovedModules(MetaPathFinder, Loader):
    """Finds modules by their old names."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The specification of an old name, None for any other."""
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Lets the old module look its names up in the new one."""
        old, new = module.__name__, MOVED[module.__name__]
        _warn(old, new)
        content, renamed = import_module(new), RENAMED.get(old, {})
        module.__doc__ = content.__doc__

        def find(name: str) -> Any:
            return getattr(content, renamed.get(name, name))

        module.__dict__["__getattr__"] = find


def install() -> None:
    """Makes the old modules importable; a second call does nothing."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(_MovedModules())


def deprecated_names(module: str, renamed: Mapping[str, str]) -> Callable[[str], Any]:
    """A module's `__getattr__` that supports old names of its content.

    Args:
        module: name of the module.
        renamed: old names, and the new ones in the same module.

    """

    def find(name: str) -> Any:
        if name not in renamed:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", f"{module}.{renamed[name]}")
        return getattr(import_module(module), renamed[name])

    return find


def moved_names(package: str, *modules: str) -> Callable[[str], Any]:
    """The `__getattr__` of a package that was a module: supports the names that are in its modules now.

    Args:
        package: name of the package.
        modules: names of its modules that have the content of the old module.

    """

    def find(name: str) -> Any:
        for module in modules if not name.startswith("__") else ():
            content = import_module(f"{package}.{module}")
            if hasattr(content, name):
                _warn(f"{package}.{name}", f"{package}.{module}.{name}")
                return getattr(content, name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return find


def renamed_fields(**renamed: str) -> Callable[[type[T]], type[T]]:
    """A class decorator for a dataclass whose fields have been renamed: the old names are accepted and readable.

    Args:
        renamed: old names, and the new ones.

    """

    def decorate(cls: type[T]) -> type[T]:
        initialise: Any = cls.__init__

        @wraps(initialise)
        def init(self: Any, *args: Any, **fields: Any) -> None:
            for old in renamed.keys() & fields.keys():
                _warn(f"{cls.__name__}.{old}", f"{cls.__name__}.{renamed[old]}")
                fields[renamed[old]] = fields.pop(old)
            initialise(self, *args, **fields)

        setattr(cls, "__init__", init)  # noqa: B010 (a type checker forbids the assignment)
        for old, new in renamed.items():
            setattr(cls, old, property(_renamed_field(cls.__name__, old, new)))
        return cls

    return decorate


def _renamed_field(owner: str, old: str, new: str) -> Callable[[Any], Any]:
    def find(instance: Any) -> Any:
        _warn(f"{owner}.{old}", f"{owner}.{new}")
        return getattr(instance, new)

    return find


def _warn(old: str, new: str) -> None:
    message = f"{old} is now {new}; the old name is removed in the next version"
    warnings.warn(message, DeprecationWarning, stacklevel=_caller_level())


def _caller_level() -> int:
    """The stack level, as `warnings.warn` counts it, of the code that uses the old name."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None:
        name = frame.f_code.co_filename
        is_bootstrap = "importlib" in name and "_bootstrap" in name  # `warnings.warn` does not count these frames
        is_ours = name == __file__ or frame.f_code.co_name == "__getattr__" or name.endswith("importlib/__init__.py")
        if not (is_bootstrap or is_ours):
            break
        level, frame = level + (not is_bootstrap), frame.f_back
    return level
