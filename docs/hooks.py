"""What the site's build does beside what its plugins do: formulas as MathML, and the command line's own help."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_HELP = re.compile(r"^::help (.*)$", re.MULTILINE)
_WIDTH = "100"  # characters
_ROOT = Path(__file__).parent.parent
_PACKAGE = _ROOT / "build" / "package" / "leapnav"


def on_startup(**_: Any) -> None:
    """Puts the package together as it is installed: the reference is read from its source, not by importing it."""
    shutil.rmtree(_PACKAGE, ignore_errors=True)
    _PACKAGE.mkdir(parents=True)
    parts = [_ROOT / name for name in ("envs", "experts", "training")]
    for path in (*parts, *(_ROOT / "leapnav").glob("*.py")):
        (_PACKAGE / path.name).symlink_to(path)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replaces lines "::help solve" by what `leapnav solve --help` prints."""
    return _HELP.sub(_help, markdown)


def _help(found: re.Match[str]) -> str:
    command = [sys.executable, "-m", "leapnav", *found[1].split(), "--help"]
    environment = {**os.environ, "COLUMNS": _WIDTH, "NO_COLOR": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        raise RuntimeError(f"{found[0]}: {done.stderr}")
    return f"```text\n{done.stdout.strip()}\n```"


def on_page_content(html: str, **_: Any) -> str:
    """Replaces what the extension arithmatex has marked; browsers draw MathML without a script."""
    return _FORMULA.sub(_mathml, html)


def _mathml(found: re.Match[str]) -> str:
    text = found[3].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return convert(text, display="block" if found[2] == "[" else "inline")
