"""The commands `doctor` and `compile`."""

import json
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from helpers import failing

from leapnav.cli import main


def test_doctor_reports_versions_and_passed_checks(tmp_path, capsys):
    assert main(["doctor", "--json", str(tmp_path / "doctor.json")]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^torch +2\.", out, re.MULTILINE)
    assert out.count("ok    ") == 4
    found = json.loads((tmp_path / "doctor.json").read_text())
    assert found["versions"]["leapnav"] == version("leapnav")
    assert "missing" not in found["versions"].values()
    assert all(check["passed"] for check in found["checks"])


def test_doctor_reports_failed_checks(capsys, monkeypatch):
    monkeypatch.setattr("leapnav.training.policies.files.SHIPPED", Path("/nowhere"))
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert re.search(r"FAILED  load a policy .*: \w+Error: .*clutter", out)
    assert "ok      drive the expert" in out


def test_what_is_compiled_is_not_compiled_again(tmp_path, capsys):
    assert main(["compile"]) == 0  # compiles what no other test has compiled yet
    assert "cache: " in capsys.readouterr().out
    assert main(["compile", "--json", str(tmp_path / "compiled.json")]) == 0
    assert re.match(r"compiled 0 kernels in [\d.]+ s; cache: ", capsys.readouterr().out)
    found = json.loads((tmp_path / "compiled.json").read_text())
    assert found["compiled"] == 0
    assert Path(found["cache"]).is_dir()
    assert failing(["compile", "--jobs", "0"], capsys) == (2, "leapnav: jobs: expected an integer >= 1, got 0\n")


def test_kernels_are_compiled_without_the_packages_of_extras():
    extras = ("casadi", "dask", "distributed", "moviepy", "onnx", "onnxruntime", "sb3_contrib", "starlette", "yaml")
    code = (
        f"import sys\nsys.modules.update(dict.fromkeys({extras}))\n"  # importing them raises ModuleNotFoundError
        "from leapnav.commands.installation.compile import compile_missing\n"
        "print(compile_missing()['compiled'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().isdigit()
