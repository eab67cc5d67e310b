"""Formulas of the pages as SVG pictures, which need neither a script nor a font of the browser."""

import html
import re

import numpy as np
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath, text_to_path

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_FONT = FontProperties(math_fontfamily="stix")
_SCALE = 1000  # units of the picture per em
_SIZE = 1.1  # em of the text; the letters of the formulas are smaller than those of the text
_COMMANDS = {0: "", 1: "M", 2: "L", 3: "Q", 4: "C", 79: "Z"}  # by the codes of matplotlib.path.Path
# TeX that Matplotlib does not support (regular expressions), and its replacement.
_REPLACED = {
    r"\\[td]?frac(\d)(\d)": r"\\frac{\1}{\2}",
    r"\\le(?![a-z])": r"\\leq",
    r"\\[lr]vert": "|",
    r"\\big(?=[()])": "",
    r"\\Big\(": r"\\left(",
    r"\\Big\)": r"\\right)",
    r"\^\\top": r"^{\\mathsf{T}}",  # the symbol has wide margins
    r"\^\*": r"^{*}",  # without the margins of an operator
    r"\\min_u": r"\\underset{u}{\\min}",
}


def draw_formulas(page: str) -> str:
    """Replace the formulas that the extension arithmatex has marked in a page."""
    return _FORMULA.sub(_replace, page)


def _replace(found: re.Match[str]) -> str:
    tex = " ".join(html.unescape(found[3]).split())
    kind = "display" if found[2] == "[" else "inline"
    return f'<span class="formula formula--{kind}" role="img" aria-label="{html.escape(tex)}">{_svg(tex, kind)}</span>'


def _svg(tex: str, kind: str) -> str:
    """Return a formula as an SVG picture whose sizes are relative to the text's."""
    if kind == "display":
        tex = tex.replace(r"\frac", r"\dfrac")
    for old, new in _REPLACED.items():
        tex = re.sub(old, new, tex)
    text = f"${tex}$"
    width = text_to_path.get_text_width_height_descent(text, _FONT, ismath=True)[0] / _FONT.get_size_in_points()
    path = TextPath((0, 0), text, size=_SCALE, prop=_FONT)
    strokes = []
    for vertices, code in path.iter_segments(curves=True, simplify=False):
        points = " ".join(f"{x} {y}" for x, y in np.rint(vertices.reshape(-1, 2) * (1, -1)).astype(int))
        strokes.append(_COMMANDS[int(code)] + ("" if code == 79 else points))
    margin = 0.03  # em, for the parts of italic letters outside their boxes
    extents = path.get_extents()
    low, high = margin - extents.y0 / _SCALE, margin + extents.y1 / _SCALE  # em below and above the base line
    box = f"{-_SCALE * margin:.0f} {-_SCALE * high:.0f} {_SCALE * (width + 2 * margin):.0f} {_SCALE * (low + high):.0f}"
    sizes = {"width": width + 2 * margin, "height": low + high, "vertical-align": -low}
    style = ";".join(f"{name}:{_SIZE * em:.3f}em" for name, em in sizes.items())
    return f'<svg viewBox="{box}" style="{style}" aria-hidden="true"><path d="{"".join(strokes)}"/></svg>'
