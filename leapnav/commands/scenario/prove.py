"""`leapnav prove` and `leapnav proof check`: proved lower bounds of the cost of a scenario."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal

import tyro

from leapnav.outputs import FAILED, check_outputs, write_json


@dataclass(frozen=True)
class Prove:
    """Prove that no collision-free path of a scenario is cheaper than the optimum by more than a gap.

    Exit code 0: proved; 1: no optimum, or only a larger gap is proved; 2: invalid input.
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (JSON)."""
    gap: float = 0.05
    """Relative optimality gap to prove."""
    time_limit: float = 60.0
    """Time (s) after which the best bound proved so far is the result."""
    threads: Literal[1, 2] = 2
    """Number of threads."""
    plot: Path | None = None
    """Picture (.png, .pdf or .svg) of the cells that each spacing leaves, with the optimum and its alternatives."""
    proof: Path | None = None
    """File for the proof; `leapnav proof check` checks it."""
    json: Path | None = None
    """JSON file of the result; "-" for standard output."""

    def run(self) -> int:
        """Find the optimum, prove, and report."""
        from leapnav.envs.scenarios.scenario import Scenario
        from leapnav.experts import find_optimum, lower_bound

        scenario = Scenario.from_json(self.scenario)
        check_outputs(self.json, self.plot)
        check_outputs(self.proof)
        optimum = find_optimum(scenario)
        if not optimum.success:
            print(f"{scenario.name}: {optimum.status.name}: {optimum.status.value}")
            return FAILED
        bound = lower_bound(scenario, optimum, self.gap, self.time_limit, threads=self.threads)
        proved = bound.gap <= self.gap * (1 + 1e-9)
        print(f"{scenario.name}: {'proved' if proved else 'a larger gap is proved; try a longer --time-limit'}")
        print(f"  optimum            {optimum.cost:.9f}")
        print(f"  lower bound        {bound.value:.9f}")
        print(f"  gap                {100 * bound.gap:.3f} %")
        if bound.duality_gap > 1e-4:
            print(f"  duality gap        {100 * bound.duality_gap:.3f} % (estimate), because the horizon is fixed")
        print(f"  excluded           {100 * bound.excluded:.3f} % of the collision-free configuration space")
        print(f"  resolution         {bound.resolution:.4g} m")
        print(f"  time               {bound.seconds:.1f} s")
        if self.proof is not None:
            bound.proof.save(self.proof)
            print(f"wrote {self.proof}")
        if self.plot is not None:
            from leapnav.experts.bounds.plotting import plot_tube

            plot_tube(bound, self.plot, optimum)
            print(f"wrote {self.plot}")
        write_json({"name": scenario.name, "cost": optimum.cost, **bound.to_dict()}, self.json)
        return 0 if proved else FAILED


@dataclass(frozen=True)
class CheckProof:
    """Check the proof of a lower bound, whatever wrote it.

    Exit code 0: the proof is correct; 1: it is not; 2: the file is not a proof.
    """

    action: tyro.conf.Positional[Literal["check"]]
    """What to do."""
    file: tyro.conf.Positional[Path]
    """File written by `leapnav prove --proof`."""
    scenario: Path | None = None
    """Scenario file (JSON) that must be the one of the proof."""

    def run(self) -> int:
        """Check and report."""
        from leapnav.envs.scenarios.scenario import Scenario
        from leapnav.experts import Proof, check_proof
        from leapnav.experts.proofs.proof import ProofError

        proof = Proof.load(self.file)
        if self.scenario is not None and Scenario.from_json(self.scenario) != proof.scenario:
            print(f"{proof.scenario.name}: the proof is for another scenario than {self.scenario}")
            return FAILED
        start = perf_counter()
        try:
            value = check_proof(proof)
        except ProofError as error:
            print(f"{proof.scenario.name}: the proof is wrong: {error}")
            return FAILED
        print(f"{proof.scenario.name}: no collision-free path costs less than {value!r}")
        print(f"  start {proof.scenario.start}, goal {proof.scenario.goal}, {len(proof.scenario.obstacles)} obstacles")
        print(f"  checked {len(proof.stages)} stages in {perf_counter() - start:.1f} s")
        return 0
