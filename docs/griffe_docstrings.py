"""Extension of griffe: the sections of the docstrings as the reference pages show them.

The docstrings list several names in one entry and write shapes after the names:

    states (N, 3), controls (N, 2): rows of the path.

Griffe reads one name per entry and takes the text in parentheses for a type. This extension rewrites such an entry as
one entry per name, with the shape in the description. The types then come from the annotations in the code.

Docstrings of the fields of a dataclass become rows of one table, instead of a heading each. The asterisk of J*, which
Markdown takes for emphasis, is escaped.
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
        described = [found for found in _classes(pkg) if _own_fields(found)]
        sections = [_attributes_section(found) for found in described]
        for found, section in zip(described, sections, strict=True):
            text = found.docstring.value if found.docstring else ""
            found.docstring = griffe.Docstring(
                f"{text}\n\n{section}",
                parent=found,
                parser=found.docstring.parser if found.docstring else None,
                parser_options=found.docstring.parser_options if found.docstring else None,
            )
            for field in _own_fields(found):
                field.docstring = None  # else it has a heading of its own
        _rewrite(pkg)


def _classes(found: griffe.Object) -> list[griffe.Class]:
    """Return the classes in an object, at any depth."""
    classes = []
    for member in found.members.values():
        if not member.is_alias:
            classes += ([member] if isinstance(member, griffe.Class) else []) + _classes(member)
    return classes


def _own_fields(found: griffe.Class) -> list[griffe.Attribute]:
    """Return the fields of a dataclass that have a docstring each, without those of its bases."""
    if not any("dataclass" in str(decorator.value) for decorator in found.decorators):
        return []
    return [
        member
        for member in found.members.values()
        if isinstance(member, griffe.Attribute) and member.docstring is not None and "property" not in member.labels
    ]


def _attributes_section(found: griffe.Class) -> str:
    """Return a section with the docstrings of the fields of a dataclass and of its bases."""
    fields = {field.name: field for base in reversed(found.mro()) for field in _own_fields(base)}
    fields |= {field.name: field for field in _own_fields(found)}
    lines = ["Attributes:"]
    for name, field in fields.items():
        assert field.docstring is not None
        first, *others = field.docstring.value.split("\n")
        lines += [f"{_INDENT}{name}: {first}", *(f"{2 * _INDENT}{line}" for line in others)]
    return "\n".join(lines)


def _rewrite(found: griffe.Object) -> None:
    if found.docstring is not None:
        if isinstance(found, griffe.Class) and any(
            str(base) in ("Frozen", "RobotModel", "Unicycle") for base in found.bases
        ):
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
