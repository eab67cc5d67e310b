"""Solve the problems with published solutions, and print the table of `docs/published_problems.md`.

python scripts/solve_published_problems.py            # some minutes

The problems are those of the tests: `tests/data/published_problems.json`, `tests/data/known_problems.json`, and tasks
of minimum time whose closed forms are in `tests/shortest_words.py`.
"""

import json
import sys
from pathlib import Path

from leapnav.experts import minimum_time, solve
from leapnav.experts.solve import METHODS

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path.append(str(TESTS))
from helpers import known_problems, published_problems  # noqa: E402


def main() -> None:
    rows = [(name, problem, value, METHODS) for name, (problem, value, _) in published_problems().items()]
    found: dict[str, tuple[object, float, list[str]]] = {}
    for entry in known_problems():
        found.setdefault(entry.name, (entry.problem, entry.value, []))[2].append(entry.method)
    rows += [(name, problem, value, methods) for name, (problem, value, methods) in found.items()]
    sources = _sources()
    print("| problem | source | known value | ours | method | relative deviation | certified |")
    print("|---|---|---|---|---|---|---|")
    for name, problem, value, methods in rows:
        results = [(method, *_solved(problem, method)) for method in methods]
        method, ours, certified = min(results, key=lambda result: (not result[2], abs(result[1] - value)))
        count = sum(result[2] for result in results)
        known = f"{value:.10g}"
        print(
            f"| {name} | {sources[name]} | {known} | {ours:.10g} | {method.replace('_', ' ')} | "
            f"{(ours - value) / abs(value):.1e} | {'yes' if certified else 'no'}, by {count} of {len(methods)} |",
            flush=True,
        )


def _solved(problem: object, method: str) -> tuple[float, bool]:
    if method == "minimum_time":
        extremal = minimum_time(problem).extremal
        return extremal.horizon, extremal.success
    extremal = solve(problem, method)
    return extremal.cost, extremal.success


def _sources() -> dict[str, str]:
    sources, last = {}, ""
    for name in ("published_problems", "known_problems"):
        for entry in json.loads((TESTS / "data" / f"{name}.json").read_text()):
            if not entry["source"].startswith("as above"):
                last = entry["source"].split(";")[0]
            sources[entry["name"]] = last
    return sources


if __name__ == "__main__":
    main()
