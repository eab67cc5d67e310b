"""`find_optimum`: the best collision-free extremal of a scenario, from many path classes and driving modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np

from leapnav.envs.scenario import Scenario
from leapnav.experts.certificate import failure
from leapnav.experts.extremal import Extremal, Status
from leapnav.experts.lattice import Lattice, is_connected
from leapnav.experts.path_class import Mode, Side, driving_modes, heading_winding, path_sides
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.search import Search

ELSEWHERE = 4  # paths by other ways, which cost little more time and are the more interesting alternatives
MOST_ROUNDS = 4
# Refinement, margin (m) and extent of one lattice after the other, as long as nothing is certified or a better path may
# have been missed: all candidates may lead through a gap that is too narrow or in which the optimum grazes, which a
# margin shuts, and a gap or a short way may need smaller cells. The last one covers all of an arena that is too large
# for the others.
LATTICES = ((1, None, False), (1, 0.05, False), (2, None, False), (2, 0.05, False), (1, None, True))
# Evaluations of the flow, for each candidate asked for, that may go to what is dearer than the best path. In most
# families all of it takes a fifteenth of that, in slalom now and then a third more, and among hundreds of obstacles a
# single path takes a third. With 10,000 one of the scenarios that ship would lose its second-best optimum.
WORK_ON_ALTERNATIVES = 12_000


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Extremal):
    """A local optimum of a scenario; what `find_optimum` returns is the best one, and knows the others.

    Attributes:
        alternatives: the other distinct local optima found, certified, in order of cost (theirs are empty). Where
            each takes long, on long ways or among hundreds of obstacles, some are left out (not if there are more
            `candidates`).
        doubts: solutions found that are cheaper than this one but not certified: their status is COLLISION for those
            that cut into an obstacle by up to 0.4 of the robot's radius (a path that just touches may then be cheaper
            than this optimum), or says why there is no certificate. Extremals that cut deeper are no doubts: where the
            proximity cost is worth its name, no path near them is both clear and cheap.

    """

    alternatives: tuple[Optimum, ...] = ()
    doubts: tuple[Extremal, ...] = ()

    @property
    def path_class(self) -> tuple[Side, ...]:
        """On which side of the path each obstacle lies, in the scenario's order."""
        times = np.linspace(0.0, self.problem.horizon, 513)
        assert self.problem.field is not None
        return path_sides(self.interpolate(times)[:, :2], self.problem.field)

    @property
    def driving_modes(self) -> tuple[Mode, ...]:
        """Forwards and backwards, in turn."""
        return driving_modes(self.times, self.controls[:, 0])

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, lists and numbers, with the alternatives and their path classes."""
        described = {}
        if len(self.times):
            described = {
                "path_class": list(self.path_class),
                "driving_modes": list(self.driving_modes),
                "heading_winding": self.heading_winding,
            }
        return {
            **super().to_dict(),
            **described,
            "alternatives": [alternative.to_dict() for alternative in self.alternatives],
            "doubts": [doubt.to_dict() for doubt in self.doubts],
        }

    @property
    def heading_winding(self) -> int:
        """Full turns of the heading beyond the smaller angle between start and goal; positive: counter-clockwise."""
        return heading_winding(self.states[:, 2])


class Grids(NamedTuple):
    """What is sampled of a scenario, once each: a lattice by its arguments, and whether there is a way at all."""

    lattice: Callable[..., Lattice]
    connected: Callable[[], bool]


def find_optimum(scenario: Scenario, candidates: int = 12, *, thorough: bool = True) -> Optimum:
    """The reference of a scenario: the cheapest certified extremal among many.

    A search over position and heading in the problem's own metric proposes distinct paths (obstacles passed on either
    side, forwards, backwards, with cusps, other windings of the heading); direct transcription takes each to a local
    optimum and shows which are the same; multiple-shooting Newton turns those into extremals; the cheapest whose
    certificate holds is returned, with the others as `alternatives`.

    Args:
        candidates: how many distinct paths to try at once; more are tried only as long as none of them is certified, or
            a better one may have been missed. The work that goes to alternatives grows with it.
        thorough: False tries no more than these. Mostly the best path is among them, and where there is none this says
            so fifty times sooner; but it may miss the only one, and a status of failure is then a guess.

    Returns:
        An `Optimum`; if nothing is certified, a failure whose status says why.

    Raises:
        TypeError: no scenario.
        ValueError: candidates < 1.

    """
    if not isinstance(cast(object, scenario), Scenario):
        raise TypeError(f"scenario: expected a Scenario, got {type(scenario).__name__}")
    if not isinstance(cast(object, candidates), (int, np.integer)) or candidates < 1:
        raise ValueError(f"candidates: expected a whole number of at least 1, got {candidates!r}")
    problem = OptimalControlProblem.from_scenario(scenario)
    if np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2])) > scenario.robot.max_speed * scenario.horizon:
        return as_optimum(failure(problem, Status.HORIZON_TOO_SHORT))
    search = Search(scenario, problem, WORK_ON_ALTERNATIVES * candidates)
    grids = Grids(cache(partial(Lattice, scenario)), cache(partial(is_connected, scenario)))
    failed = _search(search, grids, candidates, thorough)
    if not search.certified and search.shut:  # the only way may lead close by a place that was shut
        search.shut, search.shutting = [], False
        failed = _search(search, grids, candidates, thorough)
    return _result(search) if failed is None else as_optimum(failure(problem, failed))


def _search(search: Search, grids: Grids, candidates: int, thorough: bool) -> Status | None:
    """Lattice after lattice, until the best path can be told to be found; why there is none, or None."""
    scenario = search.scenario
    shortest_time, cropped = np.inf, False
    for refinement, margin, whole in LATTICES[: None if thorough else 1]:
        lattice = grids.lattice(refinement, margin, whole=whole).without(search.shut)
        if whole and (search.certified or not cropped):
            break
        cropped = cropped or lattice.cropped
        paths = lattice.candidates()
        first, search.wasted, shut = None, 0, search.shut.copy()
        for _ in range(MOST_ROUNDS):
            batch = list(islice(paths, candidates))
            if not batch:
                break
            first = first or batch[0]
            shortest_time = min(shortest_time, *(_shortest_time(c.poses, scenario) for c in batch))
            search.add(Path(c.times, c.poses) for c in batch)
            if not thorough:
                break
            # A margin shuts ways that may be better.
            if search.certified and margin is None and lattice.explains(search.best.cost, first.cost, batch[-1].cost):
                search.add(Path(c.times, c.poses) for c in islice(lattice.elsewhere(), ELSEWHERE))
                return None
            if search.shut != shut:  # many combinations of detours elsewhere would lead through the same gap
                shut = search.shut.copy()
                lattice = lattice.without(search.shut)
                paths, first = lattice.candidates(), None
        # Looked at when it is in doubt: lattice paths may lead through gaps that are a little too narrow.
        if thorough and not search.certified and not grids.connected():
            return Status.NO_PATH
    if search.certified:
        return None
    if shortest_time == np.inf:
        return Status.NO_PATH
    return Status.HORIZON_TOO_SHORT if shortest_time > scenario.horizon else None


def _result(search: Search) -> Optimum:
    """The best extremal with the others, or, if none is certified, the likeliest of the failures."""
    if not search.certified:
        return as_optimum(search.likeliest)
    best, *others = sorted(search.certified, key=lambda extremal: extremal.cost)
    alternatives = tuple(map(as_optimum, others))
    return replace(as_optimum(best), alternatives=alternatives, doubts=search.doubts(best.cost))


def as_optimum(extremal: Extremal) -> Optimum:
    """The extremal as an `Optimum` without alternatives."""
    return Optimum(**{field.name: getattr(extremal, field.name) for field in fields(Extremal)})


def _shortest_time(poses: np.ndarray, scenario: Scenario) -> float:
    """How long (s) a path takes at the robot's limits."""
    step = np.abs(np.diff(poses, axis=0))
    driving = np.hypot(step[:, 0], step[:, 1]) / scenario.robot.max_speed
    return float(np.maximum(driving, step[:, 2] / scenario.robot.max_turn_rate).sum())
