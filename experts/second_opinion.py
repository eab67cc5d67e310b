"""A second opinion on an optimum: a hundred times the effort, from sources that the search itself does not use."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from typing import cast

import numpy as np
from joblib import Parallel, delayed
from tqdm.auto import tqdm

from leapnav.envs.bank import ScenarioBank
from leapnav.envs.scenario import Scenario
from leapnav.experts.initial_path import local_minima
from leapnav.experts.lattice import Lattice
from leapnav.experts.optimum import find_optimum
from leapnav.experts.problem import OptimalControlProblem, Path
from leapnav.experts.search import Search

# Refinement, margin (m), reach and number of candidates of the lattices that are searched.
LATTICES = ((1, None, 1.6, 80), (2, None, 1.4, 80), (1, 0.05, 1.6, 40))
VIA_POINTS, VIA_REACH = 100, 4.0
STEERED = 40  # paths with headings of their own: every mode along the tracks of other paths
CONTROL_STARTS, CONTROL_INTERVALS = 16, 64
IPOPT_GUESSES, IPOPT_INTERVALS = 10, 60
WINDINGS = (0, 1, -1)


@dataclass(frozen=True)
class Opinion:
    """What the second search found.

    Attributes:
        name: of the scenario.
        cost: of the reference; infinite if it has none.
        best: least cost of a certified extremal of the second search, the reference's own not left out.
        source: where a better one came from: "lattice", "via points", "driving modes", "controls" or "IPOPT"; None if
            nothing better was found.
        tried: how many paths were taken to local optima.
        doubts: how many cheaper solutions were found that are not certified, see `Optimum`.

    """

    name: str
    cost: float
    best: float
    source: str | None
    tried: int
    doubts: int

    @property
    def improvement(self) -> float:
        """By which share of the reference's cost the second search is better (0: not at all)."""
        if not math.isfinite(self.cost):
            return float(math.isfinite(self.best))
        return max(0.0, 1.0 - self.best / self.cost) if self.cost > 0 else 0.0


def second_opinion(scenario: Scenario, cost: float | None = None, seed: int = 0) -> Opinion:
    """Searches a scenario again: other lattices, random via-points, every driving mode, random controls, and IPOPT.

    Args:
        scenario: any.
        cost: of the reference; None: `find_optimum`'s.
        seed: of the random paths.

    """
    if cost is None:
        optimum = find_optimum(scenario)
        cost = optimum.cost if optimum.success else math.inf
    problem = OptimalControlProblem.from_scenario(scenario)
    rng = np.random.default_rng(seed)
    search = Search(scenario, problem)
    best, source, tried = cost, None, 0
    paths: list[Path] = []

    def note(name: str, count: int) -> None:
        nonlocal best, source, tried
        tried += count
        search.wasted = 0  # each source has the whole patience for Newton's failures
        if search.certified and search.best.cost < best:
            best, source = search.best.cost, name

    for refinement, margin, reach, count in LATTICES:
        found = Lattice(scenario, refinement, margin, reach).candidates()
        paths += [Path(candidate.times, candidate.poses) for candidate in islice(found, count)]
    search.add(paths)
    note("lattice", len(paths))
    if not paths:
        return Opinion(scenario.name, cost, best, None, 0, 0)
    through = Lattice(scenario, reach=VIA_REACH).random_candidates(VIA_POINTS, rng)
    detours = [Path(candidate.times, candidate.poses) for candidate in through]
    search.add(detours)
    note("via points", len(detours))
    tracks = [*paths[:: max(1, len(paths) // STEERED)], *detours]
    steered = [_steered(tracks[k], rng) for k in rng.integers(len(tracks), size=STEERED)]
    search.add(steered)
    note("driving modes", len(steered))
    minima = [path for _, path in local_minima(problem, CONTROL_INTERVALS, CONTROL_STARTS)]
    search.add(minima)
    note("controls", len(minima))
    if find_spec("casadi") is not None:
        count = _add_ipopt(search, scenario, [*paths[: IPOPT_GUESSES // 2], *steered[: IPOPT_GUESSES // 2]])
        note("IPOPT", count)
    return Opinion(scenario.name, cost, best, source, tried, len(search.doubts(best)))


def verify_bank(bank: ScenarioBank, workers: int = 1, progress: bool = True) -> list[Opinion]:
    """A second opinion on every scenario of a bank, in its order.

    Args:
        bank: any.
        workers: processes.
        progress: show a progress bar.

    Raises:
        ValueError: workers < 1.

    """
    if workers < 1:
        raise ValueError(f"workers: expected at least 1, got {workers!r}")
    pool = Parallel(n_jobs=workers, return_as="generator", pre_dispatch="4 * n_jobs")
    results = pool(delayed(_opinion)(bank, index) for index in range(len(bank)))
    bar = tqdm(results, total=len(bank), desc=f"Verifying {bank.path.stem}", unit="scenario", disable=not progress)
    return list(cast(Iterator[Opinion], bar))


def _opinion(bank: ScenarioBank, index: int) -> Opinion:
    return second_opinion(bank[index], float(bank.costs[index]), seed=index)


def _steered(track: Path, rng: np.random.Generator) -> Path:
    """A path along the track of another, in a random gear, with up to two cusps and at times a full turn more."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track.states[:, :2], axis=0).T))])
    share = way / max(way[-1], 1e-9)
    even = np.linspace(0.0, 1.0, len(share))
    x, y = (np.interp(even, share, column) for column in track.states[:, :2].T)
    tangent = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    cusps = np.sort(rng.uniform(0.0, 1.0, rng.integers(3)))
    reversed_ = (np.searchsorted(cusps, even) + rng.integers(2)) % 2
    heading = tangent + math.pi * reversed_ * rng.choice([-1, 1])
    start, goal = track.states[0, 2], track.states[-1, 2]
    heading += 2 * math.pi * round((start - heading[0]) / (2 * math.pi))
    heading[0] = start
    heading[-1] = goal + 2 * math.pi * (round((heading[-2] - goal) / (2 * math.pi)) + int(rng.choice(WINDINGS)))
    return Path(track.times[-1] * even, np.column_stack([x, y, heading]))


def _add_ipopt(search: Search, scenario: Scenario, paths: list[Path]) -> int:
    # An extra: nobody needs CasADi to solve a scenario.
    from leapnav.experts.ipopt import Transcription

    transcription = Transcription(scenario, IPOPT_INTERVALS)
    for path in paths:
        problem = search.problem.with_winding_of(path.states)
        solution = transcription.solve(problem, path)
        if solution is not None:
            search.add([solution])
    return len(paths)
