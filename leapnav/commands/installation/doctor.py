"""`leapnav doctor`: versions and a self-test of the installation."""

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

from leapnav.outputs import FAILED, check_outputs, write_json

FAMILY, INDEX = "clutter", 7  # the test scenario of the checks
COST_TOLERANCE = 1e-6  # relative, between the optimum found and the reference
TRACKING_TOLERANCE = 1e-3  # relative, between the expert's cost in the environment and the reference
EPISODES, MIN_SUCCESS = 10, 0.8  # of the included policy


@dataclass(frozen=True)
class Check:
    """The result of one check; `found` is a measurement or an error message."""

    name: str
    passed: bool
    seconds: float
    found: str


@dataclass(frozen=True)
class Doctor:
    """Print versions, compile the kernels that are not in the cache, and run a self-test of a few seconds.

    The compilation takes minutes after the installation.

    Exit code 0: all checks passed; 1: a check failed.
    """

    json: Path | None = None
    """JSON file of the versions and the checks; "-" for standard output."""

    def run(self) -> int:
        """Run the checks and report."""
        check_outputs(self.json)
        versions = installed_versions()
        width = max(map(len, versions))
        for name, number in versions.items():
            print(f"{name:{width}}  {number}", flush=True)
        from leapnav.commands.installation.compile import compile_missing

        print("compiling the kernels that are not in the cache", flush=True)
        compile_missing()
        checks = []
        for function in (find_an_optimum, keep_compiled_code, drive_the_expert, load_a_policy):
            check = _run(function)
            checks.append(check)
            print(f"{'ok    ' if check.passed else 'FAILED'}  {check.name} ({check.seconds:.2f} s): {check.found}")
        write_json({"versions": versions, "checks": [asdict(check) for check in checks]}, self.json)
        return 0 if all(check.passed for check in checks) else FAILED


def installed_versions() -> dict[str, str]:
    """Return the versions of leapnav, Python, the operating system and the dependencies."""
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
    """Check that the search finds the reference of a test scenario."""
    from leapnav.envs.scenarios.bank import ScenarioBank
    from leapnav.experts import find_optimum

    bank = ScenarioBank.shipped(FAMILY, "test")
    optimum, reference = find_optimum(bank[INDEX]), bank.reference(INDEX).cost
    if not optimum.success or abs(optimum.cost - reference) > COST_TOLERANCE * reference:
        raise RuntimeError(f"{optimum.status.name}, cost {optimum.cost:.9g}; the reference cost is {reference:.9g}")
    return f"cost {optimum.cost:.6f}, equal to the reference cost"


def keep_compiled_code() -> str:
    """Check that compiled code is kept for the next process."""
    from leapnav.envs.kernels.decorator import cache_root, kernel_cache, requested_cache_root

    kernels, root = kernel_cache(), requested_cache_root()
    if not os.access(kernels, os.W_OK):
        raise RuntimeError(f"{kernels}: not writable; set NUMBA_CACHE_DIR to a writable directory")
    if cache_root() != root:
        raise RuntimeError(f"{root}: not writable; set LEAPNAV_CACHE_DIR to a writable directory")
    return f"kernels in {kernels}, generated systems in {root}"


def drive_the_expert() -> str:
    """Check that the expert drives the scenario at the reference cost."""
    import gymnasium as gym

    from leapnav.envs.episodes import act_with, play_episode
    from leapnav.experts import ExpertPolicy

    env = gym.make("leapnav/Navigate-v0", family=FAMILY, split="test")
    _, info, steps = play_episode(env, act_with(ExpertPolicy(env)), options={"index": INDEX})
    reference = info["reference_cost"]
    for step in steps:
        info = step.info
    ratio = info["cost"] / reference
    if not info["is_success"] or abs(ratio - 1) > TRACKING_TOLERANCE:
        raise RuntimeError(f"success {info['is_success']}, {ratio:.6f} times the reference cost")
    return f"{ratio:.5f} times the reference cost"


def load_a_policy() -> str:
    """Check that an included policy loads and drives."""
    from leapnav.training import evaluate, load_policy, policy_environment

    sensors = policy_environment(FAMILY)
    success = evaluate(load_policy(FAMILY), FAMILY, count=EPISODES, environment=sensors, progress=False).success
    found = f"{100 * success:.0f} % of {EPISODES} episodes succeed"
    if success < MIN_SUCCESS:
        raise RuntimeError(found)
    return found


def _run(check: Callable[[], str]) -> Check:
    name, start = check.__name__.replace("_", " "), perf_counter()
    try:
        passed, found = True, check()
    except Exception as error:  # any failure is a finding
        passed, found = False, f"{type(error).__name__}: {error}"
    return Check(name, passed, perf_counter() - start, found)
