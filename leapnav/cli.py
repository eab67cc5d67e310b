"""The command line: `leapnav COMMAND`, one module of `leapnav.commands` per command.

Importing this module is quick, so that help appears at once: a command imports solvers and learners when it runs.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from typing import Any

import tyro

from leapnav.commands.bank import Bank
from leapnav.commands.demo import Demo
from leapnav.commands.evaluate import Evaluate
from leapnav.commands.export import Export
from leapnav.commands.installation.compile import Compile
from leapnav.commands.installation.completion import Completion
from leapnav.commands.installation.doctor import Doctor
from leapnav.commands.play import Play
from leapnav.commands.rollout import CheckDataset, Rollout
from leapnav.commands.scenario.prove import CheckProof, Prove
from leapnav.commands.scenario.solve import Solve
from leapnav.commands.train import (
    TrainCommand,
    default_configurations,
    probes,
    train_command,
    tuned_configurations,
)
from leapnav.commands.watch import Watch
from leapnav.commands.worlds import Worlds
from leapnav.commands.worlds.benchmark import Benchmark
from leapnav.outputs import FAILED, json_on_stdout

BAD_INPUT, INTERRUPTED = 2, 130  # exit codes
DESCRIPTION = """Wheeled-robot navigation in which the optimum is known: find optima, learn from them, score policies.

Optima: solve, prove, proof. Banks and worlds: bank, worlds, benchmark. Demonstrations: rollout, dataset.

Policies: train, evaluate, export, watch. To try: demo, play. Installation: compile, doctor, completion."""
COMMANDS = {
    "solve": Solve,
    "prove": Prove,
    "proof": CheckProof,
    "bank": Bank,
    "worlds": Worlds,
    "benchmark": Benchmark,
    "rollout": Rollout,
    "dataset": CheckDataset,
    "train": TrainCommand,  # `parse` replaces it by a class with default configurations
    "evaluate": Evaluate,
    "export": Export,
    "watch": Watch,
    "play": Play,
    "demo": Demo,
    "compile": Compile,
    "doctor": Doctor,
    "completion": Completion,
}


def parse(arguments: list[str]) -> Any:
    """Parse the command line.

    The default settings of a training run depend on its other settings. It is therefore parsed twice.

    Args:
        arguments: the words after `leapnav`.

    Returns:
        The command, or that of a group of commands; its method `run` returns the exit code.

    Raises:
        FileNotFoundError: there is no run to resume.
        ValueError: the family of a training run is unknown, or the run to resume is damaged.
        SystemExit: the arguments are invalid (exit code 2, with tyro's message), or ask for help.

    """
    command: Any = None
    if arguments[:1] == ["train"]:
        words = [word for word in arguments if word not in ("-h", "--help")]
        with suppress(SystemExit):  # the second time prints the error
            command = _parse(words, train_command(probes(), needs_out=False), console_outputs=False)
    defaults = default_configurations() if command is None else tuned_configurations(command.config)
    command = _parse(arguments, train_command(defaults))
    while not hasattr(command, "run"):
        command = command.action
    return command


def _parse(arguments: list[str], train: type[TrainCommand], *, console_outputs: bool = True) -> Any:
    return tyro.extras.subcommand_cli_from_dict(
        {**COMMANDS, "train": train},
        prog="leapnav",
        description=DESCRIPTION,
        args=arguments,
        console_outputs=console_outputs,
    )


def _as_paragraphs(text: str) -> str:
    """Join the lines of each paragraph of a docstring; a terminal wraps them."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text.strip()))


# tyro breaks help texts at indented lines, too, so that they are wrapped twice. The module is private.
with suppress(ImportError):
    from tyro import _strings as tyro_strings

    tyro_strings.remove_single_line_breaks = _as_paragraphs


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code.

    Invalid input is reported in one line on standard error, with exit code 2; a worker process that has ended before
    its work was done, with exit code 1.

    Args:
        arguments: the words after `leapnav`; None takes those of the process.

    """
    command = None
    try:
        words = sys.argv[1:] if arguments is None else arguments
        command = parse(words)
        with json_on_stdout(getattr(command, "json", None)), _warnings_in_one_line(), _stopped_workers():
            return command.run()
    except BrokenPipeError:  # the process that read the output has ended, as in `leapnav bank show ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"leapnav: {_message(error)}", file=sys.stderr)
        return BAD_INPUT
    except BrokenExecutor as error:  # a worker process has ended, for example because memory was short
        print(f"leapnav: {' '.join(str(error).split())}", file=sys.stderr)
        return FAILED
    except (KeyboardInterrupt, SystemError) as error:
        if not isinstance(error, KeyboardInterrupt) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise  # a kernel that is interrupted ends with a SystemError
        resumption = getattr(command, "resumption", None)
        print(f"leapnav: interrupted{f'; {resumption}' if resumption else ''}", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Print a warning to the user without the place in the code; those to developers as usual."""
    usual = warnings.formatwarning

    def formatted(message: Warning | str, category: type[Warning], *place: Any, **line: Any) -> str:
        return f"leapnav: warning: {message}\n" if category is UserWarning else usual(message, category, *place, **line)

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = usual


@contextmanager
def _stopped_workers() -> Iterator[None]:
    """Print no traceback of the thread of joblib that manages worker processes, which fails when they are stopped."""
    usual = threading.excepthook

    def hook(failure: threading.ExceptHookArgs) -> None:
        is_manager = failure.thread is not None and failure.thread.name == "ExecutorManagerThread"
        if not (is_manager and failure.exc_type is KeyError):
            usual(failure)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = usual


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        known = {errno.ENOENT: "no such file", errno.EISDIR: "is a directory", errno.EACCES: "permission denied"}
        return f"{error.filename}: {known.get(error.errno or 0, error.strerror)}"
    return str(error)
