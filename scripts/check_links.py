"""Check the links of the built documentation site.

    python scripts/check_links.py build/site

Links, anchors and pictures inside the site must exist; addresses of other sites are only checked for their syntax,
without a request. Exit code 1, with one line per broken link, if there is any.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ATTRIBUTES = {"a": ("href",), "area": ("href",), "img": ("src",), "link": ("href",), "script": ("src",)}
EXTERNAL = ("http", "https", "mailto")


class Page(HTMLParser):
    """The anchors and links of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        self.links += [found[name] for name in ATTRIBUTES.get(tag, ()) if name in found]


def broken_links(site: Path) -> list[str]:
    """Return a line for each broken link of a site."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    lines = []
    for path, page in pages.items():
        for link in dict.fromkeys(page.links):
            # The page for missing addresses has absolute links, because it is shown at any address.
            problem = _problem(link, path, site, pages)
            if problem:
                lines.append(f"{path.relative_to(site)}: {link}: {problem}")
    return lines


def _problem(link: str, path: Path, site: Path, pages: dict[Path, Page]) -> str:
    """Return what is wrong with a link of a page; empty if nothing is."""
    try:
        parts = urlsplit(link)
    except ValueError as error:
        return str(error)
    if parts.scheme == "data":
        return ""
    if parts.scheme or parts.netloc:
        is_complete = bool(parts.path if parts.scheme == "mailto" else parts.netloc)
        is_valid = parts.scheme in EXTERNAL and is_complete and " " not in link
        return "" if is_valid else "not a valid address"
    folder = site if parts.path.startswith("/") else path.parent
    target = (folder / unquote(parts.path).lstrip("/")).resolve() if parts.path else path
    if not target.is_relative_to(site):
        return "outside the site"
    if target.is_dir():
        target /= "index.html"
    if not target.is_file():
        return "no such file"
    anchor = unquote(parts.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return "no such anchor"
    return ""


def main() -> int:
    if len(sys.argv) != 2:
        print("usage: python scripts/check_links.py SITE_DIR", file=sys.stderr)
        return 2
    site = Path(sys.argv[1]).resolve()
    if not (site / "index.html").is_file():
        print(f"{sys.argv[1]}: no index.html; build the site first", file=sys.stderr)
        return 2
    lines = broken_links(site)
    for line in lines:
        print(line)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
