"""Additional steps of the site's build: formulas, help texts of the command line, and files of the repository."""

import io
import os
import re
import shutil
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

from formulas import draw_formulas

from leapnav.cli import main

_HELP = re.compile(r"^::help (.*)$", re.MULTILINE)
_WIDTH = "84"  # characters, which fit beside the two menus of a page
_INCLUDE = re.compile(r"^::include (.*)$", re.MULTILINE)
_PICTURE = re.compile(r'<img [^>]*?src="([^"]*)"[^>]*>')
_LINK = re.compile(r"(?<=\]\()(?!https?:|#)([^)#]*)")
# Pages of the site by the paths of the files of the repository that they show.
_PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md"}
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
    """Replace "::help solve" by the output of `leapnav solve --help`, and "::include FILE" by a file."""
    return _HELP.sub(_help, _INCLUDE.sub(_include, markdown))


def _include(found: re.Match[str]) -> str:
    """Return a file of the repository, with links for the site."""
    return _LINK.sub(lambda link: _PAGES.get(link[1], link[1].removeprefix("docs/")), (_ROOT / found[1]).read_text())


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
    """Draw the formulas, and make each picture a link to itself, because it is small on a phone."""
    return _PICTURE.sub(r'<a class="picture" href="\1">\g<0></a>', draw_formulas(html))
