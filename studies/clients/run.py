"""Clients of the environment that others wrote: programs that use them, each with the return that it must measure.

python studies/clients/run.py                 # tries all clients, into results/
python studies/clients/run.py torchrl skrl    # tries only these

A program `programs/with_NAME.py` drives, or trains, in one scenario with the means of a client. The return that the
client measures is compared with that of `leapnav.training.evaluate` for the same policy. Each client is installed into
an environment of its own below runs/studies/clients, on top of the packages of this Python, which stay as they are.
`--tiny` tries Gymnasium only; it needs `--out`.
"""

import json
import os
import shutil
import site
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1]))
from common import read_arguments

HERE = Path(__file__).parent
TABLES = {"clients": "docs/guides/learners.md"}
TOLERANCE = 1e-3  # of returns; clients add rewards in single precision
# What pip installs for each client, call by call, beside leapnav with the extra `dev`.
CLIENTS: dict[str, tuple[str, ...]] = {
    "gymnasium": (),
    "stable-baselines3": (),
    "sb3-contrib": (),
    "onnxruntime": (),
    "minari": ("minari[create]",),
    "rl-zoo3": ("rl-zoo3==2.9.2",),
    "torchrl": ("torchrl==0.14.1",),
    "tianshou": ("tianshou==0.5.1",),
    "skrl": ("skrl==2.1.1",),
    "ray": ("ray[rllib]",),
    # These require versions of Gymnasium or Stable-Baselines3 that they do not need for what is tried.
    "d3rlpy": (f"--no-deps -r {HERE.parents[1] / 'examples' / 'requirements.txt'}",),
    "imitation": ("--no-deps imitation==1.0.1 datasets",),
    "lerobot": ("--no-deps lerobot==0.4.4", "datasets jsonlines==4.0.0 av torchvision accelerate"),
}
TINY = ("gymnasium",)


def python_of(name: str, folder: Path) -> Path:
    """Return the Python of an environment with a client, which sees the packages of this Python."""
    if not CLIENTS[name]:
        return Path(sys.executable)
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        (packages,) = folder.glob("lib/python*/site-packages")
        below = f"import site; site.addsitedir({site.getsitepackages()[0]!r})\n"
        (packages / "packages_below.pth").write_text(below, encoding="utf-8")
        for packages_of_call in CLIENTS[name]:
            command = [python, "-m", "pip", "install", "--quiet", *packages_of_call.split()]
            subprocess.run(command, check=True)
        (folder / "ready").touch()
    return python


def version_of(name: str, python: Path) -> str:
    """Return the version of a client."""
    if python == Path(sys.executable):
        return metadata.version(name)
    code = f"from importlib.metadata import version; print(version({name!r}))"
    return subprocess.run([python, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def try_client(name: str, folder: Path) -> dict[str, Any]:
    """Run the program of a client, and return what it printed."""
    python = python_of(name, folder / "environment")
    program, work = HERE / "programs" / f"with_{name.replace('-', '_')}.py", folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    variables = {**os.environ, "MINARI_DATASETS_PATH": str(work / "minari"), "PYTHONWARNINGS": "ignore"}
    command = [python, program]
    done = subprocess.run(command, cwd=work, env=variables, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{name}: {program.name} ended with exit status {done.returncode}\n{done.stderr}")
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"what"')]
    return {"client": name, "version": version_of(name, python), "tried": lines}


def is_right(line: dict[str, Any]) -> bool:
    """Return whether a client measured the return that it must."""
    return bool(abs(line["found"] - line["expected"]) <= TOLERANCE * max(1.0, abs(line["expected"])))


def tables(results: Path) -> dict[str, str]:
    """Return the table of the clients, in Markdown."""
    lines = ["| client | what was tried | return | by `evaluate` |", "|---|---|---|---|"]
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in results.glob("*.json")}
    for name in (name for name in CLIENTS if name in found):
        label = f"{name} {found[name]['version']}"
        for line in found[name]["tried"]:
            mark = "" if is_right(line) else " **differs**"
            lines.append(f"| {label} | {line['what']} | {line['found']:.3f} | {line['expected']:.3f}{mark} |")
            label = ""
    return {"clients": "\n".join(lines) + "\n"}


def main() -> None:
    """Try the clients."""
    arguments = read_arguments(__doc__, tuple(CLIENTS), HERE)
    results = arguments.results
    differing = []
    for name in TINY if arguments.tiny else arguments.names:
        found = try_client(name, arguments.runs.absolute() / "clients" / name)
        (results / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        wrong = [line["what"] for line in found["tried"] if not is_right(line)]
        print(f"{name} {found['version']}: {'differs: ' + ', '.join(wrong) if wrong else 'right'}", flush=True)
        differing += [name] if wrong else []
    print(tables(results)["clients"])
    if differing:
        sys.exit(f"other returns than evaluate: {', '.join(differing)}")


if __name__ == "__main__":
    main()
