"""Additional steps of the site's build: formulas as MathML, and the help texts of the command line."""

import io
import os
import re
import shutil
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

from latex2mathml.converter import convert

from leapnav.cli import main

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_HELP = re.compile(r"^::help (.*)$", re.MULTILINE)
_WIDTH = "100"  # characters
_ROOT = Path(__file__).parent.parent
_PACKAGE = _ROOT / "build" / "package" / "leapnav"


def on_startup(**_: Any) -> None:
    """Assemble the package as it is installed, because the reference pages are made from source files."""
    shutil.rmtree(_PACKAGE, ignore_errors=True)
    _PACKAGE.mkdir(parents=True)
    packages = [_ROOT / name for name in ("envs", "experts", "training")]
    for path in (*packages, *(_ROOT / "leapnav").glob("*.py")):
        (_PACKAGE / path.name).symlink_to(path)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace lines such as "::help solve" by the output of `leapnav solve --help`."""
    return _HELP.sub(_help, markdown)


def _help(found: re.Match[str]) -> str:
    output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # with an encoding, for the frames of the help texts
    errors = io.StringIO()
    with (
        mock.patch.dict(os.environ, {"COLUMNS": _WIDTH, "NO_COLOR": "1"}),
        redirect_stdout(output),
        redirect_stderr(errors),
    ):
        try:
            code = main([*found[1].split(), "--help"])
        except SystemExit as end:
            code = end.code
    if code:
        raise RuntimeError(f"{found[0]}: {errors.getvalue()}")
    output.seek(0)
    return f"```text\n{output.read().strip()}\n```"


def on_page_content(html: str, **_: Any) -> str:
    """Replace the formulas that the extension arithmatex has marked; browsers draw MathML without a script."""
    return _FORMULA.sub(_mathml, html)


def _mathml(found: re.Match[str]) -> str:
    text = found[3].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return convert(text, display="block" if found[2] == "[" else "inline")
