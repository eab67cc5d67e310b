"""Extension of griffe: the sections of the docstrings as the reference pages show them.

The docstrings list several names in one entry and write shapes after the names:

    states (N, 3), controls (N, 2): rows of the path.

Griffe reads one name per entry and takes the text in parentheses for a type. This extension rewrites such an entry as
one entry per name, with the shape in the description. The types then come from the annotations in the code. The asterisk of J*, which Markdown takes for emphasis, is escaped.
"""

import re
from typing import Any

import griffe

_SECTION = re.compile(r"(Args|Attributes|Raises):")
_INDENT = "    "
_NAME = r"\*{0,2}[\w.]+"
_ENTRY = re.compile(rf"{_INDENT}(?P<head>{_NAME}(?:,? [^:]*?)?|{_NAME}): ?(?P<text>.*)")
_STAR = re.compile(r"(`[^`]*`)|(?<=\b[JTUtu])\*(?!\*)")  # of J* and u*, but not in code
_PART = re.compile(rf"(?P<name>{_NAME})(?: (?P<shape>\(.*))?")


class OneRowPerName(griffe.Extension):
    """Rewrite the docstrings of a package after it has been loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite the docstrings of all objects of a package."""
        _rewrite(pkg)


def _rewrite(found: griffe.Object) -> None:
    if found.docstring is not None:
        if isinstance(found, griffe.Class) and any(str(base) == "_Frozen" for base in found.bases):
            # A pydantic model has no `__init__`; its arguments are its attributes.
            found.docstring.value = found.docstring.value.replace("Args:", "Attributes:", 1)
        found.docstring.value = _STAR.sub(lambda star: star[1] or r"\*", rewritten(found.docstring.value))
    for member in found.members.values():
        if not member.is_alias:
            _rewrite(member)


def rewritten(docstring: str) -> str:
    """Return a docstring with one name per entry in the sections Args, Attributes and Raises."""
    lines: list[str] = []
    entries: list[list[str]] = []  # of the current section; each with its continuation lines
    in_section = False
    for line in docstring.split("\n"):
        if entries and (not line or line.startswith(2 * _INDENT)):
            entries[-1].append(line)
        elif in_section and line.startswith(_INDENT):
            entries.append([line])
        else:
            lines += [row for entry in entries for row in _split(entry)]
            lines.append(line)
            entries, in_section = [], _SECTION.fullmatch(line) is not None
    lines += [row for entry in entries for row in _split(entry)]
    return "\n".join(lines).rstrip("\n")


def _split(entry: list[str]) -> list[str]:
    """Return the lines of an entry as those of one entry per name."""
    found = _ENTRY.fullmatch(entry[0])
    if found is None:
        return entry
    parts = [_PART.fullmatch(part) for part in re.split(r", (?![^()]*\))", found["head"])]
    if not all(parts):  # prose after the first name
        name, _, rest = found["head"].partition(" ")
        names, shapes = [name], [rest]
    else:
        names = [part["name"] for part in parts if part]
        shapes = [part["shape"] or "" for part in parts if part]
        if not any(shapes[:-1]):  # one shape for all names
            shapes = [shapes[-1]] * len(names)
    lines = []
    for name, shape in zip(names, shapes, strict=True):
        text = f"{shape.rstrip(',')}, {found['text']}" if shape else found["text"]
        lines += [f"{_INDENT}{name}: {text}", *entry[1:]]
    return lines
