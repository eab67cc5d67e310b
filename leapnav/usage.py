"""The command line's own errors in one line: tyro prints them in a box of several lines."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from typing import Any
from unittest import mock

from leapnav.training.config import ALGORITHMS

_BORDER = re.compile(r"[╭╮╰╯│─]+|^[|+]|[|+]$|-{5,}|^\+- | -+\+$")
_OPTION = re.compile(r"--[A-Za-z][\w.-]*")
_WIDTH = "2000"  # characters, so that tyro does not wrap its messages


def suggestion(word: str, known: Sequence[str]) -> str:
    """Return "; did you mean 'x'?" if a known word is close to this one, else an empty text."""
    from leapnav.envs.utils.validation import suggestion as suggest  # imports NumPy, which only an error needs

    return suggest(word, known)


class UsageError(ValueError):
    """The words after `leapnav` are invalid. The message is one line with the command, the word and the remedy."""


def parse_or_explain(parse: Callable[[list[str]], Any], arguments: list[str], commands: Sequence[str]) -> Any:
    """Parse a command line; if the words are invalid, raise an error of one line.

    Args:
        parse: parses the words, or prints an error and raises SystemExit.
        arguments: the words.
        commands: the names of the commands.

    Raises:
        UsageError: the words are invalid.
        SystemExit: help or a completion script has been printed.

    """
    if arguments and not arguments[0].startswith("-") and arguments[0] not in commands:
        raise UsageError(
            f"command: expected one of {', '.join(commands)}, got {arguments[0]!r}{suggestion(arguments[0], commands)}"
        )
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            parsed = parse(arguments)
        print(printed.getvalue(), end="", file=sys.stderr)  # warnings
        return parsed
    except SystemExit as end:
        if not end.code:
            raise
    raise UsageError(_explain(_printed_error(parse, arguments), arguments, lambda words: _options(parse, words)))


def _printed_error(parse: Callable[[list[str]], Any], arguments: list[str]) -> list[str]:
    """Return the lines of tyro's message, without its frame."""
    output = io.StringIO()
    wide = mock.patch.dict(os.environ, {"COLUMNS": _WIDTH})
    with redirect_stderr(output), redirect_stdout(output), wide, suppress(SystemExit):
        parse(arguments)
    lines = [_BORDER.sub("", line).strip() for line in output.getvalue().splitlines()]
    return [line for line in lines if line]


def _options(parse: Callable[[list[str]], Any], words: list[str]) -> list[str]:
    """Return the options of a command, from its help text."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output), suppress(SystemExit):
        parse([*words, "--help"])
    return sorted(set(_OPTION.findall(output.getvalue())))


def _explain(lines: list[str], arguments: list[str], options: Callable[[list[str]], list[str]]) -> str:
    """Return tyro's message in one line."""
    title, body = (lines[0], lines[1:]) if lines else ("", [])
    text = " ".join(line for line in body if not line.startswith("For full helptext"))
    command = _command(arguments)
    name = " ".join(command) or "leapnav"
    see = f"see `leapnav {' '.join([*command, '--help'])}`"
    if title.startswith("Missing subcommand"):
        found = re.search(r"\{(.*?)\}", text)
        return f"{name}: expected one of {found[1] if found else text}; {see}"
    if title.startswith("Unrecognized"):
        return _explain_unknown(text, command, name, see, options)
    if title.startswith("Required"):
        missing = next((line for line in body[1:]), "an argument")
        description = next((line for line in body[2:] if not line.startswith("For full")), "")
        return f"{name}: {missing.split()[0]} is missing: {description.replace(' (required)', '')} ({see})"
    if found := re.match(r"invalid choice (.*?) for argument '(.*?)'\. Expected one of \((.*?)\)\.", text):
        choices = re.findall(r"'([^']*)'", found[3])
        value = found[1].strip("'\"")
        return f"{found[2]}: expected one of {', '.join(choices)}, got {value!r}{suggestion(value, choices)}"
    if found := re.match(r"Missing value for argument '(.*?)'", text):
        return f"{name}: {found[1]}: expected a value ({see})"
    if found := re.match(r"Error parsing ([\w.-]+): (.*)", text):
        kind = re.search(r"\|?(INT|FLOAT|PATH|STR|\{True,False\})", found[2])
        kinds = {"INT": "an integer", "FLOAT": "a number", "{True,False}": "True or False"}
        values = re.search(r"\['(.*?)'\]|literal for int\(\) with base 10: '(.*?)'|to float: '(.*?)'", text)
        got = next((value for value in values.groups() if value is not None), "") if values else ""
        return f"{name}: {found[1]}: expected {kinds.get(kind[1], 'a value') if kind else 'another value'}, got {got!r}"
    return f"{name}: {text} ({see})"


def _explain_unknown(
    text: str, command: list[str], name: str, see: str, options: Callable[[list[str]], list[str]]
) -> str:
    """Return the message for words that the command does not have."""
    found = re.search(r"Unrecognized(?: or misplaced)? options: (.*?)(?= Available subcommands| Perhaps you|$)", text)
    unknown = re.sub(r"\(applied to [^)]*\)", ",", found[1] if found else text).split("Arguments are applied")[0]
    words = [word for word in (part.strip() for part in re.split(r",\s*|\s+", unknown)) if word]
    first = next((word for word in words if word.startswith("--")), words[0] if words else "")
    available = re.search(r"Available subcommands: (.*?)(?= Perhaps you|$)", text)
    if available and (not words or not words[0].startswith("-")):
        choices = [choice.strip() for choice in available[1].split(",")]
        return f"{name}: expected one of {', '.join(choices)}, got {words[0]!r}{suggestion(words[0], choices)}"
    if first.startswith("-"):
        hint = suggestion(first.partition("=")[0], options(command))
        return f"{name}: unknown option {first}{hint or f'; {see}'}"
    return f"{name}: unexpected argument {first!r}; {see}"


def _command(arguments: Sequence[str]) -> list[str]:
    """Return the command and its subcommand, the words before the first option or file."""
    nested = {"bank": ("build", "show"), "train": tuple(ALGORITHMS)}
    words = list(arguments[:1]) if arguments and not arguments[0].startswith("-") else []
    if words and arguments[1:2] and arguments[1] in nested.get(words[0], ()):
        words.append(arguments[1])
    return words
