"""An hour of mixed work in one process: solving, driving, serving the page. Checks for leaks of memory, threads, files.

python benchmarks/soak.py --minutes 60
"""

import argparse
import http.client
import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
import uvicorn

from leapnav.envs import FAMILIES, NavigateEnv, NavigateVectorEnv, sample_scenario
from leapnav.envs.episodes import act_with, play_episode
from leapnav.experts import ExpertPolicy, find_optimum, solve
from leapnav.play.server import create_app
from leapnav.play.solving import PlaySolver

WARM_UP = 0.25  # fraction of the time; resources are compared after it
MAX_GROWTH = 1.05  # of the resident memory after the warm-up
METHODS = ("leapfrog", "multiple_shooting", "collocation")


def resources() -> tuple[float, int, int]:
    """Resident memory (MiB), number of threads and number of open files of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, threading.active_count(), len(os.listdir("/proc/self/fd"))


def post(port: int, path: str, content: dict) -> dict:
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("POST", path, json.dumps(content), {"Content-Type": "application/json"})
    response = connection.getresponse()
    result = json.loads(response.read())
    connection.close()
    if response.status not in (200, 400):
        raise RuntimeError(f"{path}: {response.status}: {result}")
    return result


def work(rng: np.random.Generator, port: int) -> None:
    """Solve a scenario, drive in it, and send it to the server."""
    family = str(rng.choice(list(FAMILIES)))
    scenario = sample_scenario(family, int(rng.integers(10**6, 10**9)))
    optimum = find_optimum(scenario)
    solve(scenario, method=str(rng.choice(METHODS)))  # type: ignore[arg-type]
    if optimum.success:
        env = NavigateEnv(scenario=scenario)
        _, _, steps = play_episode(env, act_with(ExpertPolicy(env)), seed=0)
        for _ in steps:
            pass
        env.close()
    actuation = str(rng.choice(["velocity", "motor"]))
    venv = NavigateVectorEnv(32, family=family, split="fresh", actuation=actuation)
    venv.reset(seed=int(rng.integers(2**31)))
    for _ in range(100):
        venv.step(venv.action_space.sample())
    venv.close()
    fields, previous = scenario.to_dict(), None
    for _ in range(5):
        fields["start"][2] += 0.02
        previous = post(port, "/follow", {"scenario": fields, "previous": previous}).get("id")
    post(port, "/sweeps", {"scenario": fields})
    post(port, "/drive", {"scenario": fields, "policy": family})
    post(port, "/search", {"scenario": {"name": "invalid"}})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="duration")
    arguments = parser.parse_args()
    app = create_app(PlaySolver(list(FAMILIES)), sample_scenario("open", 10))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    threading.Thread(target=server.run, daemon=True).start()
    while not server.started:
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    rng, rows, count = np.random.default_rng(0), [], 0
    start = shown = time.monotonic()
    print("minute  rounds  memory (MiB)  threads  files")
    while (now := time.monotonic()) - start < 60 * arguments.minutes:
        work(rng, port)
        count += 1
        rows.append(((now - start) / 60, *resources()))
        if now - shown > 60:
            shown = now
            minute, memory, threads, files = rows[-1]
            print(f"{minute:6.1f}  {count:6d}  {memory:12.0f}  {threads:7d}  {files:5d}", flush=True)
    server.should_exit = True
    measured = np.array(rows)
    warm = measured[measured[:, 0] >= WARM_UP * arguments.minutes]
    if len(warm) < 8:
        print("too short to measure growth")
        return 1
    first, last = np.split(warm, [len(warm) // 4])[0], warm[-len(warm) // 4 :]
    growth = float(np.median(last[:, 1]) / np.median(first[:, 1]))
    threads, files = (int(last[:, i].max() - first[:, i].max()) for i in (2, 3))
    print(f"{count} rounds; memory {growth:.3f} times, {threads:+d} threads, {files:+d} files")
    return 0 if growth <= MAX_GROWTH and threads <= 0 and files <= 0 else 1


if __name__ == "__main__":
    sys.exit(main())
