"""Search for the optimum of a scenario: the minimum-cost certified extremal over path classes and driving modes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast, get_args

import numpy as np

from leapnav.envs.kernels import prepare
from leapnav.envs.kernels.compilation import GENERATED
from leapnav.envs.kernels.decorator import kernels_of
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import as_scenario
from leapnav.envs.utils.caching import computed_once
from leapnav.envs.utils.records import MAX_MAGNITUDE
from leapnav.envs.utils.validation import check_choice, check_positive
from leapnav.experts.hard_limits import BARRIER_TOLERANCE, FACTOR, follow_best
from leapnav.experts.problem.certificate import failure
from leapnav.experts.problem.extremal import Extremal, Status
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.candidates import (
    LATTICE_ERROR,
    Candidate,
    CandidateSearch,
    first_energy,
    shortest_durations,
)
from leapnav.experts.search.lattice import Lattice, is_connected
from leapnav.experts.search.local_optima import LocalOptima
from leapnav.experts.search.manoeuvres import manoeuvres
from leapnav.experts.search.path_class import Mode, Side, driving_modes, heading_winding, path_sides
from leapnav.experts.search.plane_paths import PlaneSearch, plane_lattice
from leapnav.experts.solve import local_optima, solve
from leapnav.experts.spacetime.searches import time_searches
from leapnav.experts.transcription.direct import generated_functions

# Factor of the number of candidates for a robot that cannot rotate in place: the costs of its lattice paths differ from
# those of the extremals by up to 20 %. Of 400 test scenarios of the car, 13 optima would be missed without this factor,
# by up to 12 %; 4 with a factor of 2; and 2 with a factor of 3, by less than 0.5 %.
NOT_ROTATING_FACTOR = 3
N_CANDIDATES = 12  # of a round
N_FIRST = 3  # candidates after which, without alternatives, those that are too long are omitted
# Distance (m) from start to goal above which many candidates are about as long as the shortest.
PARTIAL_DISTANCE = 20.0
N_ELSEWHERE = 4  # additional candidates far from the others: inexpensive, and the most distinct alternatives
MAX_ROUNDS = 4  # rounds of candidates of a lattice
REFINEMENT = 2  # of the second lattice, which is searched while a better path may have been missed
# The same of a robot that cannot stop, for which both lattices are searched: in 60 fresh tasks, the first one alone
# misses optima by up to 46 %, the second one alone by up to 1.5 %, and in one problem of dynobench by 36 %.
REFINEMENT_OF_TURNS = 2.5
# Distance (m) from start to goal above which shortest paths in the plane are the candidates, and their number.
LONG_DISTANCE, N_PLANE_PATHS = 40.0, 4
# Evaluations of the flow that may be spent on candidates that cost more than the best one. With 144,000, 3 of 40
# alternatives in 12 scenarios of `slalom` would be missed; 360,000 find no others.
ALTERNATIVES_BUDGET = 240_000
# Of a second search with hard limits, see `LocalOptima`: with 1, a box of 0.5 x 0.25 m does not pass through a gap
# of 0.26 m from the side.
SHARPNESS = 4.0
# `shortest_horizon`: relative tolerance, and largest multiple of the scenario's horizon.
HORIZON_TOLERANCE, MAX_HORIZON_FACTOR = 0.02, 1000.0


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Extremal):
    """A local optimum; `find_optimum` returns the best one that it found.

    Attributes:
        alternatives: the other distinct local optima that were found and certified, in order of cost; their own
            `alternatives` are empty. If each takes long, on long paths or among hundreds of obstacles, some are
            missing.
        doubts: solutions without a certificate that cost less than this optimum. The status is the reason for the
            missing certificate.

    """

    alternatives: tuple[Optimum, ...] = ()
    doubts: tuple[Extremal, ...] = ()

    @property
    def path_class(self) -> tuple[Side, ...]:
        """The side of the path on which each obstacle lies, in the order of the scenario."""
        if self.problem.field is None:
            return ()
        times = np.linspace(0.0, self.horizon, 513)
        return path_sides(times, self.interpolate(times)[:, :2], self.problem.field)

    @property
    def speeds(self) -> np.ndarray:
        """The speed (N,) of a robot along its heading (m/s), negative backwards."""
        drift, fields = self.problem.dynamics(self.states)
        rates = drift + np.einsum("kij,kj->ki", fields, self.controls)
        return rates[:, 0] * np.cos(self.states[:, 2]) + rates[:, 1] * np.sin(self.states[:, 2])

    @property
    def driving_modes(self) -> tuple[Mode, ...]:
        """The sequence of driving modes of a robot."""
        return driving_modes(self.times, self.speeds)

    def to_dict(self) -> dict[str, Any]:
        """Convert to dictionaries, lists and numbers, including the alternatives and, of a robot, path classes."""
        described = {}
        if len(self.times) and self.is_of_robot:
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
    def is_of_robot(self) -> bool:
        """Whether the states begin with position and heading, on which driving modes and path classes are defined."""
        system = self.problem.system
        return system.heading is not None and system.state[:3] == (*(system.position or ()), system.heading)

    @property
    def heading_winding(self) -> int:
        """Full turns of the heading beyond the smaller angle from start to goal; positive: counter-clockwise."""
        return heading_winding(self.states[:, 2])


# The modules with the kernels of a search.
SEARCH_MODULES = (
    "leapnav.envs.field",
    "leapnav.experts.numerics",
    "leapnav.experts.problem",
    "leapnav.experts.search",
    "leapnav.experts.solvers.newton",
    "leapnav.experts.spacetime",
    "leapnav.experts.transcription",
    GENERATED,
)


@computed_once(maxsize=64)
def _compile_kernels(*_: FunctionPointer) -> None:
    """Compile the kernels of a search that are not in the cache, once for the generated functions of a problem."""
    prepare(*kernels_of(*SEARCH_MODULES))


Effort = Literal["low", "medium", "high"]
EFFORTS: tuple[Effort, ...] = get_args(Effort)


def find_optimum(
    problem: Scenario | Mapping[str, Any] | str | os.PathLike[str] | OptimalControlProblem,
    effort: Effort = "high",
    *,
    barrier_tolerance: float = BARRIER_TOLERANCE,
) -> Optimum:
    """Find the minimum-cost certified extremal of a scenario or of another optimal control problem.

    For a scenario, a lattice search over position and heading, in the metric of the problem, proposes distinct
    candidates: different sides of the obstacles, driving modes with cusps, and windings of the heading. Direct
    transcription improves each to a local optimum and identifies duplicates. Multiple-shooting Newton steps turn the
    local optima into extremals. The cheapest one with a valid certificate is returned, with the others as
    `alternatives`.

    For a problem of another system there is no lattice. Local minima over piecewise constant controls are computed
    from the straight line and from random controls of a fixed seed, for each winding of the goal angles, and multiple
    shooting continues from all that differ in cost, up to 20 times the lowest cost. Of two mirror images only one is
    found. Give a scenario itself rather than its problem, for which this search may find no more than a worse local
    optimum.

    With the proximity weight 0, obstacles cost nothing and must not be touched. The search then uses a small weight,
    and the best local optima are followed to the weight at which the proximity cost is negligible, see
    `leapnav.experts.hard_limits`.

    Args:
        problem: a scenario, also as a dict, JSON text or a file, or an optimal control problem.
        effort: "high" finds the optimum and its alternatives. "medium" finds the optimum: candidates and local optima
            that cost more are omitted, which takes 0.3 to 0.5 of the time, and `alternatives` contains only what was
            found on the way. "low" examines the first round of candidates only, of which there are 12, or 36 for a
            robot that cannot rotate in place. It usually contains the optimum, and a scenario without a path is
            recognised 50 times faster; but the only path may be missed, and the status of a failure is a guess.
            For a problem that is no scenario, "medium" and "low" solve at most four initial paths, until one costs 5 %
            more than the best, as `solve` does.
        barrier_tolerance: with the proximity weight 0, largest proximity cost that remains, as a fraction of the cost.

    Returns:
        An `Optimum`; if nothing is certified, its status is the reason.

    Raises:
        TypeError: `problem` is neither a scenario nor a problem.
        ValueError: the effort is unknown, or the tolerance is not positive.
        ScenarioError, OSError: the scenario is invalid, or its file cannot be read.

    """
    check_choice("effort", effort, EFFORTS)
    check_positive("barrier_tolerance", barrier_tolerance)
    if isinstance(problem, (Scenario, Mapping, str, os.PathLike)):
        return _of_scenario(as_scenario(problem), effort, barrier_tolerance)
    if not isinstance(cast(object, problem), OptimalControlProblem):
        expected = "a Scenario (see Scenario.from_dict) or an OptimalControlProblem"
        raise TypeError(f"problem: expected {expected}, got {type(problem).__name__}")
    if effort != "high":
        return as_optimum(solve(problem, "multiple_shooting", barrier_tolerance=barrier_tolerance))
    best, *others = local_optima(problem, barrier_tolerance)
    return replace(as_optimum(best), alternatives=tuple(map(as_optimum, others)))


def _of_scenario(scenario: Scenario, effort: Effort, barrier_tolerance: float) -> Optimum:
    problem = OptimalControlProblem.from_scenario(scenario)
    _compile_kernels(*generated_functions(problem))
    if problem.horizon is None and problem.starts_at_goal:
        return as_optimum(failure(problem, Status.ZERO_HORIZON))
    horizon = math.inf if scenario.horizon is None else scenario.horizon
    if np.hypot(*np.subtract(scenario.goal[:2], scenario.start[:2])) > scenario.robot.speed_limits()[0] * horizon:
        return as_optimum(failure(problem, Status.HORIZON_TOO_SHORT))
    search = _search_in_time if scenario.moves else _search
    optima, failed = search(scenario, problem, effort)
    if optima is None or (failed is not None and not optima.certified):
        return as_optimum(failure(problem, failed or Status.NO_PATH))
    found = _result(optima, barrier_tolerance, effort)
    stalled = [one for one in (*found.doubts, found) if one.problem.barrier_weight > 0.0 and not one.success]
    if stalled:
        # The continuation stalled at a barrier weight, or the barrier makes the flow in a narrow gap too sensitive.
        weight = max(FACTOR**2 * stalled[0].problem.barrier_weight, scenario.cost.proximity_weight)
        optima, _ = search(scenario, problem.with_barrier(weight), effort, SHARPNESS)
        if optima is not None and optima.certified:
            again = _result(optima, barrier_tolerance, effort)
            if not found.success or (again.success and again.cost < found.cost):
                found = again
    return found


def find_reached_optimum(
    scenario: Scenario, state: Sequence[float] | np.ndarray, cost: float, guess: Trajectory | Extremal | None = None
) -> Extremal:
    """Find the optimum to the state that an episode has reached, with which the cost of the episode is compared.

    An episode that stops short of the goal, within the tolerances, can cost less than the optimum of the scenario.
    Multiple shooting from the guess solves the problem with the reached state as the goal. If it fails, or if the
    episode costs less than its result (the episode is then in a better path class), the full search follows.

    Args:
        scenario: the scenario of the episode.
        state: the last state (n,) of the episode: x, y (m), heading (rad; any winding), further states of the robot.
        cost: the cost of the episode.
        guess: the optimum of the scenario; without it the full search is made.

    Returns:
        The optimum; without `success` if nothing is certified.

    Raises:
        ScenarioError: the robot is in contact with an obstacle at the state.

    """
    reached = scenario.to_state(state)
    followed = None if guess is None else solve(reached, "multiple_shooting", guess=guess)
    if followed is not None and followed.success and followed.cost <= cost:
        return followed
    found = find_optimum(reached, "medium")
    if followed is not None and followed.success and not (found.success and found.cost <= followed.cost):
        return followed
    return found


def shortest_horizon(scenario: Scenario) -> float | None:
    """Find the shortest horizon with which the scenario has a certified optimum, by bisection.

    Args:
        scenario: the scenario, for example one with the status HORIZON_TOO_SHORT.

    Returns:
        The horizon (s), rounded up to 0.1 s; the search before the rounding is accurate to 2 %. None if no horizon up
        to 1,000 times that of the scenario suffices.

    Raises:
        ValueError: the horizon of the scenario is free.

    """
    if scenario.horizon is None:
        raise ValueError("horizon: expected a number, got None: a free horizon is never too short")

    def suffices(horizon: float) -> bool:
        changed = scenario.model_copy(update={"horizon": horizon})
        return find_optimum(changed, "low").success

    low, high = 0.0, scenario.horizon
    while not suffices(high):
        low, high = high, 2 * high
        if high > MAX_HORIZON_FACTOR * scenario.horizon or high > MAX_MAGNITUDE:
            return None
    while high - low > HORIZON_TOLERANCE * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return min(math.ceil(10 * high) / 10, MAX_MAGNITUDE)


def _search(
    scenario: Scenario, problem: OptimalControlProblem, effort: Effort, sharpness: float = 1.0
) -> tuple[LocalOptima | None, Status | None]:
    """Search the lattices until a better path is unlikely.

    Returns:
        The local optima, None if no lattice contains a path; and the reason of a failure, None if there is none.

    """
    optima, shortest_time = None, np.inf
    cannot_stop = scenario.robot.slowest_speed() > 0.0
    for build, is_optional in _lattices(scenario, effort):
        if is_optional and optima is not None and optima.certified:
            break
        lattice = build()
        energy = first_energy(lattice)
        if energy > 0.0:
            if optima is None:
                budget = ALTERNATIVES_BUDGET if effort == "high" else 0.0
                optima = LocalOptima(scenario, problem, energy, budget, sharpness)
            found = _candidate_search(lattice.with_weight(optima.problem.proximity_weight), energy, effort)
            for _ in range(1 if lattice.is_whole or effort == "low" else MAX_ROUNDS):
                batch, last = _add(optima, found, effort)
                if not batch:
                    break
                shortest_time = min(shortest_time, *(_shortest_time(c, scenario) for c in batch))
                if optima.certified and found.suffices(optima.best.cost, last):
                    if cannot_stop and lattice.refinement == 1 and effort != "low":
                        break  # the optimum may need the tighter turns of the finer lattice
                    if not _omits(lattice, effort) and not lattice.is_whole:
                        optima.add(_trajectories(found.take_elsewhere(N_ELSEWHERE)))
                    return optima, None
        # Lattice paths may lead through passages that are slightly too narrow, so this is checked separately.
        if effort != "low" and (optima is None or not optima.certified) and not is_connected(scenario):
            return optima, Status.NO_PATH
        is_first = effort != "low" and lattice.refinement == 1
        if is_first and optima is not None and optima.add_manoeuvres(manoeuvres(scenario)):
            return optima, None
    horizon = math.inf if scenario.horizon is None else scenario.horizon
    if shortest_time == np.inf:
        return optima, Status.NO_PATH
    return optima, Status.HORIZON_TOO_SHORT if shortest_time > horizon else None


def _search_in_time(
    scenario: Scenario, problem: OptimalControlProblem, effort: Effort, sharpness: float = 1.0
) -> tuple[LocalOptima | None, Status | None]:
    """Search paths over position and time among moving obstacles; returns the same as `_search`."""
    optima, searches = time_searches(scenario, problem, ALTERNATIVES_BUDGET if effort == "high" else 0.0, sharpness)
    for search in searches:
        optima.add(search.candidates())
    return (optima, None) if searches else (None, Status.NO_PATH)


def _lattices(scenario: Scenario, effort: Effort) -> Iterator[tuple[Callable[[], Lattice], bool]]:
    """Yield functions that build the lattices to search, each with whether a certified extremal makes it unnecessary.

    The first one covers the surroundings of start and goal.
    """
    if math.dist(scenario.start[:2], scenario.goal[:2]) > LONG_DISTANCE:
        yield lambda: plane_lattice(scenario), True
        return
    first = Lattice(scenario)
    yield lambda: first, False
    if first.cropped:  # the path may leave the surroundings of start and goal
        yield lambda: plane_lattice(scenario), True
    elif effort != "low":  # a passage or a short path may need smaller cells, or all paths may have been in collision
        refinement = REFINEMENT if scenario.robot.slowest_speed() == 0.0 else REFINEMENT_OF_TURNS
        yield lambda: Lattice(scenario, refinement), False
        yield lambda: Lattice(scenario, refinement, strict=True), True


def _candidate_search(lattice: Lattice, energy: float, effort: Effort) -> CandidateSearch:
    if lattice.is_whole:
        return PlaneSearch(lattice, energy=energy)
    return CandidateSearch(lattice, partial=_is_partial(lattice, effort), energy=energy)


def _add(search: LocalOptima, found: CandidateSearch, effort: Effort) -> tuple[list[Candidate], float]:
    """Add the next candidates; without alternatives, only those that may lead to the best extremal.

    Returns:
        The candidates, and the cost up to which all candidates are taken.

    """
    count = N_CANDIDATES * (1 if found.lattice.moves.rotating else NOT_ROTATING_FACTOR)
    if found.lattice.is_whole:
        batch = found.take(N_PLANE_PATHS, LATTICE_ERROR * found.cheapest)
        search.add(_trajectories(batch))
        return batch, math.inf
    first = found.take(min(N_FIRST, count), found.limit) if _omits(found.lattice, effort) else []
    if not first:
        batch = found.take(count)
        search.add(_trajectories(batch))
        return batch, batch[-1].cost if batch else math.inf
    transcribed = search.transcribe(_trajectories(first))
    max_cost = found.max_cost(search.lowest_cost(transcribed))
    others = found.take(count - len(first), max_cost)
    search.solve([*transcribed, *search.transcribe(_trajectories(others))])
    batch = [*first, *others]
    return batch, max_cost if len(batch) < count and max_cost < math.inf else batch[-1].cost


def _trajectories(candidates: Iterable[Candidate]) -> Iterator[Trajectory]:
    return (Trajectory(candidate.times, candidate.poses) for candidate in candidates)


def _is_partial(lattice: Lattice, effort: Effort) -> bool:
    """Return whether a search probably needs only candidates that cost little more than the cheapest."""
    scenario = lattice.scenario
    return _omits(lattice, effort) or math.dist(scenario.start[:2], scenario.goal[:2]) > PARTIAL_DISTANCE


def _omits(lattice: Lattice, effort: Effort) -> bool:
    """Return whether the search may omit candidates by their length.

    It may not if the robot cannot rotate in place, because the lengths of its lattice paths are not accurate enough.
    """
    return effort != "high" and lattice.moves.rotating


def _shortest_time(candidate: Candidate, scenario: Scenario) -> float:
    """Return the duration (s) of a path at the limits of the robot; 0 with a free horizon, which is never too short."""
    return 0.0 if scenario.horizon is None else float(shortest_durations(candidate.poses, scenario).sum())


def _result(optima: LocalOptima, tolerance: float, effort: Effort) -> Optimum:
    """The best extremal with its alternatives, or the most informative failure."""
    if not optima.certified:
        worst = optima.best_failure
        return as_optimum(failure(optima.problem, Status.STALLED) if worst is None else worst)
    doubts = optima.doubts(optima.best.cost)
    weight = optima.scenario.cost.proximity_weight
    best, *others = follow_best(optima.certified, weight, tolerance, alternatives=effort == "high")
    # The path of a continuation that stalled is feasible, so that its cost is an upper bound.
    doubts += tuple(one for one in others if not one.success and one.cost < best.cost)
    found = tuple(as_optimum(one) for one in others if one.success and best.success)
    return replace(as_optimum(best), alternatives=found, doubts=doubts)


def as_optimum(extremal: Extremal) -> Optimum:
    """Convert an extremal to an `Optimum` without alternatives."""
    return Optimum(**{field.name: getattr(extremal, field.name) for field in fields(Extremal)})
