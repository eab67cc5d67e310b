"""A second search for the optimum of a scenario, with 100 times the effort and independent initial guesses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from typing import cast

import numpy as np
from joblib import delayed

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils.progress import progress_bar
from leapnav.envs.utils.validation import check_at_least
from leapnav.experts.hard_limits import follow_best
from leapnav.experts.optimum import find_optimum
from leapnav.experts.pools import process_pool
from leapnav.experts.problem.problem import OptimalControlProblem, Trajectory
from leapnav.experts.search.candidates import CandidateSearch, first_energy
from leapnav.experts.search.lattice import Lattice
from leapnav.experts.search.lifting import Lifting
from leapnav.experts.search.local_optima import LocalOptima
from leapnav.experts.solvers.initial_paths import local_minima
from leapnav.experts.spacetime.searches import time_searches

# Refinement, maximum cost relative to the first candidate, and number of candidates of the lattices.
LATTICES = ((1, 1.6, 80), (2, 1.4, 80))
SPACE_TIME = 80, 160  # among moving obstacles, path classes and candidates
N_VIA_POINTS, VIA_REACH = 100, 4.0  # number of points, maximum cost relative to the first candidate
N_STEERED = 40  # paths along the positions of others, with random headings: all driving modes
N_CONTROL_STARTS, CONTROL_INTERVALS = 16, 64
N_IPOPT_GUESSES, IPOPT_INTERVALS = 10, 60
WINDINGS = (0, 1, -1)


@dataclass(frozen=True)
class Opinion:
    """The result of a second search.

    Attributes:
        name: name of the scenario.
        cost: reference cost; infinite if there is no reference.
        best: minimum of the reference cost and the costs of the certified extremals of the second search.
        source: source of the best extremal: "lattice", "via points", "driving modes", "controls" or "IPOPT"; None if
            none costs less than the reference.
        tried: number of initial guesses.
        doubts: number of cheaper solutions without a certificate, see `Optimum`.

    """

    name: str
    cost: float
    best: float
    source: str | None
    tried: int
    doubts: int

    @property
    def improvement(self) -> float:
        """Relative reduction of the reference cost, 0 if there is none."""
        if not math.isfinite(self.cost):
            return float(math.isfinite(self.best))
        return max(0.0, 1.0 - self.best / self.cost) if self.cost > 0 else 0.0


def second_opinion(scenario: Scenario, cost: float | None = None, seed: int = 0) -> Opinion:
    """Search a scenario again from more and other initial guesses.

    The sources are finer lattices, random via-points, all driving modes, random controls and, if CasADi is installed,
    IPOPT.

    Args:
        scenario: the scenario.
        cost: reference cost; None computes it with `find_optimum`.
        seed: seed of the random guesses.

    """
    if cost is None:
        optimum = find_optimum(scenario)
        cost = optimum.cost if optimum.success else math.inf
    problem = OptimalControlProblem.from_scenario(scenario)
    rng = np.random.default_rng(seed)
    best, source, tried = cost, None, 0
    search, paths, via = _lattice_paths(scenario, problem, rng)

    def record(source_name: str, count: int) -> None:
        nonlocal best, source, tried
        tried += count
        if search.certified:
            found = follow_best(search.certified, scenario.cost.proximity_weight, alternatives=False)[0]
            if found.success and found.cost < best:
                best, source = found.cost, source_name

    search.add(paths)
    record("lattice", len(paths))
    if not paths:
        return Opinion(scenario.name, cost, best, None, 0, 0)
    search.add(via)
    record("via points", len(via))
    tracks = [*paths[:: max(1, len(paths) // N_STEERED)], *via]
    steered = [_steered(tracks[k], rng, keep_times=scenario.moves) for k in rng.integers(len(tracks), size=N_STEERED)]
    search.add(steered)
    record("driving modes", len(steered))
    timed = search.problem.with_horizon(problem.horizon_of(paths[0]))
    minima = [path for _, path in local_minima(timed, CONTROL_INTERVALS, N_CONTROL_STARTS)]
    search.add(minima)
    record("controls", len(minima))
    if find_spec("casadi") is not None:
        count = _add_ipopt(search, scenario, [*paths[: N_IPOPT_GUESSES // 2], *steered[: N_IPOPT_GUESSES // 2]])
        record("IPOPT", count)
    doubts = search.doubts(search.best.cost) if search.certified else ()
    return Opinion(scenario.name, cost, best, source, tried, len(doubts))


def _lattice_paths(
    scenario: Scenario, problem: OptimalControlProblem, rng: np.random.Generator
) -> tuple[LocalOptima, list[Trajectory], list[Trajectory]]:
    """Return an empty search, the candidates of fine lattices, and paths through random points."""
    if scenario.moves:
        search, lattices = time_searches(scenario, problem)
        paths = [path for lattice in lattices for path in lattice.candidates(*SPACE_TIME)]
        via = [path for lattice in lattices for path in lattice.random_candidates(N_VIA_POINTS, VIA_REACH, rng)]
        return search, paths, via
    first = Lattice(scenario)
    search = LocalOptima(scenario, problem, first_energy(first))
    weight, found = search.problem.proximity_weight, []
    for refinement, reach, count in LATTICES:
        lattice = first if refinement == 1 else Lattice(scenario, refinement)
        found += islice(CandidateSearch(lattice.with_weight(weight), reach).candidates(), count)
    through = (
        CandidateSearch(first.with_weight(weight), VIA_REACH).random_candidates(N_VIA_POINTS, rng) if found else ()
    )
    paths, via = ([Trajectory(one.times, one.poses) for one in candidates] for candidates in (found, through))
    return search, paths, via


def verify_bank(
    bank: ScenarioBank, workers: int = 1, progress: bool = True, *, dask: str | None = None
) -> list[Opinion]:
    """Search all scenarios of a bank again, see `second_opinion`.

    Args:
        bank: the bank.
        workers: number of processes.
        progress: show a progress bar.
        dask: address of a Dask scheduler whose workers are used instead, see `process_pool`.

    Returns:
        The results in the order of the bank.

    Raises:
        ValueError: workers < 1.
        ModuleNotFoundError, OSError: see `process_pool`.

    """
    check_at_least("workers", workers, 1)
    opinions: list[Opinion] = []
    with (
        process_pool(workers, dask, return_as="generator") as pool,
        progress_bar(total=len(bank), label=f"Verifying {bank.path.stem}", unit="scenarios", show=progress) as bar,
    ):
        tasks = (delayed(second_opinion)(bank[i], float(bank.costs[i]), seed=i) for i in range(len(bank)))
        for opinion in cast(Iterator[Opinion], pool(tasks)):
            opinions.append(opinion)
            bar.update()
    return opinions


def _steered(track: Trajectory, rng: np.random.Generator, keep_times: bool) -> Trajectory:
    """A path along the positions of another, with random driving modes, up to two cusps and a random winding.

    It has a constant speed unless it keeps the times.
    """
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track.states[:, :2], axis=0).T))])
    fraction = track.times / track.times[-1] if keep_times else distance / max(distance[-1], 1e-9)
    even = np.linspace(0.0, 1.0, len(fraction))
    x, y = (np.interp(even, fraction, column) for column in track.states[:, :2].T)
    tangent = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    cusps = np.sort(rng.uniform(0.0, 1.0, rng.integers(3)))
    reversed_ = (np.searchsorted(cusps, even) + rng.integers(2)) % 2
    heading = tangent + math.pi * reversed_ * rng.choice([-1, 1])
    start, goal = track.states[0, 2], track.states[-1, 2]
    heading += 2 * math.pi * round((start - heading[0]) / (2 * math.pi))
    heading[0] = start
    heading[-1] = goal + 2 * math.pi * (round((heading[-2] - goal) / (2 * math.pi)) + int(rng.choice(WINDINGS)))
    return Trajectory(track.times[-1] * even, np.column_stack([x, y, heading]))


def _add_ipopt(search: LocalOptima, scenario: Scenario, paths: list[Trajectory]) -> int:
    """Add IPOPT's solutions from several guesses; return the number of guesses."""
    # CasADi is an optional dependency.
    from leapnav.experts.ipopt import Transcription

    transcription = Transcription(scenario, search.problem, IPOPT_INTERVALS)
    lift = Lifting(scenario, search.problem, search.problem.proximity_weight)
    for path in paths:
        lifted = lift(path)
        if lifted is None:
            continue
        problem = search.problem.with_winding_of(lifted.states)
        solution = transcription.solve(problem, lifted)
        if solution is not None:
            search.add([solution])
    return len(paths)
