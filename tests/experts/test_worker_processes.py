"""Worker processes that end before their work is done."""

import os

from joblib import delayed

from leapnav.cli import main
from leapnav.commands.installation.compile import Compile
from leapnav.experts.pools import process_pool


def test_a_lost_process_of_a_pool_is_reported_in_one_line(monkeypatch, capsys):
    def run(_):
        with process_pool(2) as pool:
            return len(list(pool(delayed(os._exit)(3) for _ in range(2))))

    monkeypatch.setattr(Compile, "run", run)
    assert main(["compile"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("leapnav: A worker process")
    assert error.count("\n") == 1
