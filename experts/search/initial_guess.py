"""The initial guess of a scenario: the best path of the lattice search, improved by direct transcription."""

from __future__ import annotations

from collections.abc import Iterator

from leapnav.envs.scenarios.scenario import Scenario
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.local_optima import LocalOptima
from leapnav.experts.search.plane_paths import PlaneSearch, plane_lattice

REFINEMENTS = (1, 2)  # of the lattice; smaller cells are needed only where the larger ones contain no path


def initial_guess(scenario: Scenario, problem: OptimalControlProblem) -> Trajectory | None:
    """Return a path in the states of the robot, with costates; None if there is no `best_path`.

    It is the local optimum of the direct transcription from which a search begins with multiple shooting. Where the
    transcription does not converge, it is the last iterate. In 80 scenarios of clutter and rooms, single shooting
    converged from 40 of these guesses and from 28 paths of the lattice; Leapfrog took half of the time.

    Args:
        scenario: the scenario.
        problem: its optimal control problem.

    """
    path = best_path(scenario)
    if path is None:
        return None
    search = LocalOptima(scenario, problem)
    ((wound, direct),) = search.transcribe([path])
    direct = search.refine(wound, direct)
    return Trajectory(direct.times, direct.states, direct.costates)


def best_path(scenario: Scenario) -> Trajectory | None:
    """Return the best path of poses (N, 3) of the lattice search; None if there is none.

    If the lattice covers only a part of the arena and contains no path, a grid of positions covers all of it.
    """
    return next(_best_paths(scenario), None)


def _best_paths(scenario: Scenario) -> Iterator[Trajectory]:
    """Yield the best path of each lattice that contains one."""
    for refinement in REFINEMENTS:
        lattice = Lattice(scenario, refinement)
        yield from _first(CandidateSearch(lattice, partial=True))
        if lattice.cropped:
            yield from _first(PlaneSearch(plane_lattice(scenario, None)))


def _first(search: CandidateSearch) -> Iterator[Trajectory]:
    """Yield the best candidate of a search, if it has one."""
    candidate = next(search.candidates(), None)
    if candidate is not None:
        yield Trajectory(candidate.times, candidate.poses)
