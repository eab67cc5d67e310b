"""`leapnav doctor`: what is installed, where compiled code is kept, and whether all of it works."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from time import perf_counter

from leapnav.outputs import check_outputs, write_json

FAILED = 1
BANK, INDEX = "clutter", 7  # the scenario of the checks
AGREEMENT = 1e-6  # of costs, relative


@dataclass(frozen=True)
class Check:
    """What a check found."""

    name: str
    passed: bool
    seconds: float
    found: str


@dataclass(frozen=True)
class Doctor:
    """Versions, where compiled code is kept, and a self-test of a few seconds.

    Exit code 0: everything works; 1: something does not, and which.
    """

    json: Path | None = None
    """Write the same as JSON."""

    def run(self) -> int:
        """Checks and reports."""
        check_outputs(self.json)
        versions = installed_versions()
        width = max(map(len, versions))
        for name, number in versions.items():
            print(f"{name:{width}}  {number}")
        checks = []
        for check in (find_an_optimum, keep_compiled_code, drive_it, load_a_policy):
            checks.append(_run(check))
            done = checks[-1]
            print(
                f"{'ok    ' if done.passed else 'FAILED'}  {done.name} ({done.seconds:.2f} s): {done.found}", flush=True
            )
        write_json({"versions": versions, "checks": [asdict(check) for check in checks]}, self.json)
        return 0 if all(check.passed for check in checks) else FAILED


def installed_versions() -> dict[str, str]:
    """The versions of leapnav, of Python, of the machine, and of what leapnav requires."""
    found = {"leapnav": version("leapnav"), "python": sys.version.split()[0], "machine": platform.platform(terse=True)}
    for line in requires("leapnav") or ():
        if "extra ==" not in line and (start := re.match(r"[\w.-]+", line)):
            name = start[0]
            try:
                found[name] = version(name)
            except PackageNotFoundError:
                found[name] = "missing"
    return found


def find_an_optimum() -> str:
    """The optimum of a scenario of a bank is that of the bank."""
    from leapnav.envs.bank import ScenarioBank
    from leapnav.experts import find_optimum

    bank = ScenarioBank.shipped(BANK, "test")
    optimum, reference = find_optimum(bank[INDEX]), bank.reference(INDEX).cost
    if not optimum.success or abs(optimum.cost - reference) > AGREEMENT * reference:
        raise RuntimeError(f"{optimum.status.name}, cost {optimum.cost:.9g}; the bank's is {reference:.9g}")
    return f"cost {optimum.cost:.6f}, as in the bank"


def keep_compiled_code() -> str:
    """Compiled code is found again by the next process."""
    from leapnav.envs.obstacles import clearance
    from leapnav.experts.system import cache_directory, chosen_cache_directory

    kernels, systems = clearance.stats.cache_path, chosen_cache_directory()
    if not kernels or not os.access(kernels, os.W_OK):
        raise RuntimeError(f"{kernels}: cannot be written; set NUMBA_CACHE_DIR to where kernels can be kept")
    if cache_directory() != systems:
        raise RuntimeError(f"{systems}: cannot be written; set LEAPNAV_CACHE_DIR to where systems can be kept")
    return f"kernels in {kernels}, systems in {systems}"


def drive_it() -> str:
    """The expert drives a scenario, and pays the optimum's cost."""
    import gymnasium as gym

    from leapnav.experts import ExpertPolicy

    env = gym.make("leapnav/Navigate-v0", family=BANK, split="test")
    expert, done = ExpertPolicy(env), False
    observation, info = env.reset(options={"index": INDEX})
    reference = info["reference_cost"]
    while not done:
        observation, _, done, _, info = env.step(expert.predict(observation)[0])
    ratio = info["cost"] / reference
    if not info["is_success"] or abs(ratio - 1) > 1e-3:
        raise RuntimeError(f"success {info['is_success']}, {ratio:.6f} times the optimum's cost")
    return f"{ratio:.5f} times the optimum's cost"


def load_a_policy() -> str:
    """A policy that ships drives a few scenarios."""
    from leapnav.training import evaluate, load_policy, policy_environment

    sensors = policy_environment(BANK)
    found = evaluate(load_policy(BANK), BANK, count=10, environment=sensors, progress=False)
    if found.success < 0.8:
        raise RuntimeError(f"{100 * found.success:.0f} % of ten scenarios succeed")
    return f"{100 * found.success:.0f} % of ten scenarios succeed"


def _run(check: Callable[[], str]) -> Check:
    name, start = check.__name__.replace("_", " "), perf_counter()
    try:
        passed, found = True, check()
    except Exception as error:  # whatever is wrong is what a doctor tells
        passed, found = False, f"{type(error).__name__}: {error}"
    return Check(name, passed, perf_counter() - start, found)
