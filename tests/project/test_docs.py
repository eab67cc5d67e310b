import io
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from contextlib import redirect_stdout

import pytest
import yaml
from helpers import ROOT

import leapnav
import leapnav.training
from leapnav.cli import parse
from leapnav.envs import Scenario

CHECK_LINKS = ROOT / "scripts" / "check_links.py"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PHONE = {"width": 390, "height": 844}
README = (ROOT / "README.md").read_text()
BANK = r"rooms-1-7 (\d+\.\d+)\n200 \1\d* \(\d+, 3\)( \(\d+, 3\))?\n"
NUMBER = r"\d+\.\d+(e-\d+)?"
RATE = r"(0\.9\d*|1\.0)"
# What the blocks of the README print; each block is a program of its own.
BLOCKS = [
    r"True \d\.\d+\n",
    r"(.*\n)*41 2 3\n",
    rf"(.*\n)*{RATE}\n",
    r"",
    r"(.*\n)* expert +100\.0 +0\.0 +1\.000 (.*\n)*",
]
# What the pages print; the blocks of a page build on each other.
PRINTED = {
    "banks.md": BANK.replace(r"\n200", rf" {NUMBER}\n200") + r"mine 3 \{\}\n",
    "index.md": rf"True {NUMBER} times the optimal cost\nTrue 3 True\n",
    "lower_bounds.md": r"True\n",
    "recipes.md": r"\(1024, 41\) \(1024,\)\nTrue\n" + BANK + r"True 0\.99\d*\nTrue True\nTrue True 3 3\n"
    r"\['reward_collision', 'reward_effort', 'reward_miss', 'reward_proximity'\]\n\(8,\)\n"
    r"\(58,\)\n2\.0\n\[-1\.1, -1\.1, 11\.1, 11\.1\]\n\(172,\)\n1\.0\n",
    "training.md": r"20 True\n\(548,\)\n1\n2 True\nTrue \(400,\)\nleapnav/open/mixed-v0 True\n\(3,\) True\n",
    "tutorial.md": rf"True {NUMBER} 0\.300\d+\n\[5\.1999\d+, .*\]\nTrue 1\.0000\d*\n"
    rf"RolloutSummary\(demonstrations=50, .*\)\n{NUMBER} {RATE} {RATE} 0\.00\d*\n{RATE}\n",
    "guides/compare.md": r"(.*\n)* expert +100\.0 +0\.0 +1\.000 (.*\n)*1\.0\n",
    "guides/deploy.md": r"open\.onnx\.json\n0 goal\.ahead m\n(\d .*\n){8}9 lidar\[0\], .*\n"
    r"\['speed / max_speed', 'turn_rate / max_turn_rate'\]\nTrue\n",
    "guides/learners.md": r"0\.\d+ 0\.\d+ 0\.\d+\n8 \(\d+, 41\) \['control', 'cost_to_go', 'costate', .*\]\n",
    "guides/obstacles.md": rf"True {NUMBER}\nTrue\n\('right',\) \[\('left',\)\]\n8 4 True\nrooms-3\n",
    "robots/dynamic_car.md": rf"{NUMBER}\n",
    "robots/own_robot.md": r"True 4\n",
    "robots/trailer.md": rf"{NUMBER}\n",
    "guides/own_family.md": r"warehouse-0 \(0\.0, 0\.0, 12\.0, 10\.0\) 4\nTrue\n5 warehouse\n",
    "guides/own_shape.md": r"True 3\.14\n",
    "guides/robots.md": r"1\.7322 \[ 4\. +1\. +-?0\. +-0\.2402\] \[-0\.7902 -0\.2627 +0\.0862 +-?0\. *\]\n",
}

SLOW = ("training.md", "lower_bounds.md", "guides/compare.md")  # their blocks take more than 5 s


def blocks_of(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def output_of(code, name):
    """Run an example in this process, which has imported the libraries, and return what it prints."""
    module, printed = "example", io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(printed):
        warnings.filterwarnings("error", category=DeprecationWarning, module=module)
        exec(compile(code, name, "exec"), {"__name__": module})
    return printed.getvalue()


@pytest.mark.usefixtures("coarse_decisions")
def test_the_readme_s_examples_run_as_printed(tmp_path, monkeypatch):
    """In one directory, so that the second rollout finds the demonstrations of the first."""
    monkeypatch.chdir(tmp_path)
    for number, (block, expected) in enumerate(zip(blocks_of(README), BLOCKS, strict=True)):
        assert re.search(r"^(import|from) leapnav\b", block, re.MULTILINE), block  # which registers the environments
        printed = output_of(block, f"README.md, block {number}")
        assert re.fullmatch(expected, printed), (block, printed)


def test_every_public_name_of_the_training_is_in_the_reference():
    texts = (
        (ROOT / "docs" / "reference" / f"{page}.md").read_text() for page in ("training", "learning", "evaluation")
    )
    members = [re.search(r"::: leapnav\.training\n(?: .*\n)*? +members: \[([^]]*)\]", text)[1] for text in texts]
    assert sorted(re.findall(r"\w+", " ".join(members))) == sorted(leapnav.training.__all__)


def test_every_page_with_code_is_run():
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "```python" in path.read_text()]
    assert {str(path.relative_to(ROOT / "docs")) for path in pages} == set(PRINTED)


@pytest.mark.usefixtures("coarse_decisions")
@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow if page in SLOW else ()) for page in PRINTED]
)
def test_the_blocks_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    printed = output_of("\n".join(blocks_of((ROOT / "docs" / page).read_text())), page)
    assert re.fullmatch(PRINTED[page], printed), printed


def test_every_command_that_the_pages_show_is_one(tmp_path, monkeypatch):
    (tmp_path / "worlds.py").write_text("def warehouse(rng):\n    raise NotImplementedError\n")
    monkeypatch.syspath_prepend(tmp_path)
    shown = 0
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        text = path.read_text().replace("\\\n", " ")
        for line in re.findall(r"^    .*?(leapnav [^`\n]*)", text, re.MULTILINE):
            command = line.partition(" > ")[0].rstrip(" &").replace("$seed", "0")
            parse(shlex.split(command, comments=True)[1:])
            shown += 1
    assert shown > 30


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    checked = subprocess.run([sys.executable, CHECK_LINKS, tmp_path], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    theory, reference, learning, evaluation, commands, changes = (
        (tmp_path / page / "index.html").read_text()
        for page in (
            "theory",
            *(f"reference/{name}" for name in ("experts", "learning", "evaluation", "cli")),
            "changelog",
        )
    )
    assert theory.count('class="formula formula--') > 50
    assert "arithmatex" not in theory
    for name in ("solve.solve", "find_optimum", "ExpertPolicy", "rollout"):
        assert f'id="leapnav.experts.{name}"' in reference
    for row in (("family", "str"), ("index", "int"), ("scenario", "str"), ("states", "ndarray")):
        assert row in documented(evaluation, "leapnav.training.Episode")
    assert ("costates", "ndarray") in documented(reference, "leapnav.experts.Extremal")
    assert ("max_failures", "int") in documented(learning, "leapnav.training.DAggerConfig")
    assert "usage: leapnav train ppo" in commands
    assert "::help" not in commands
    assert 'href="../contributing/"' in changes
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed, which loads the pages; the site was built without a warning")
    assert check_in_the_browser(tmp_path) == []


def check_in_the_browser(site):
    """Return the pages that are wider than a phone, or that send requests to other places."""
    from playwright.sync_api import sync_playwright

    found = []
    with sync_playwright() as driver:
        page = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]).new_page(viewport=PHONE)
        page.on("request", lambda request: request.url.startswith("http") and found.append(request.url))
        for path in sorted(site.rglob("index.html")):
            page.goto(path.as_uri())
            width = page.evaluate("document.documentElement.scrollWidth")
            if width > PHONE["width"]:
                found.append(f"{path.relative_to(site)} is {width} pixels wide")
        page.context.browser.close()
    return found


def documented(page, name):
    """Return the names and types in the table of attributes or arguments of a class or function."""
    (section,) = re.findall(rf'<h\d id="{name}".*?</table>', page, re.DOTALL)
    rows = re.findall(r'<tr class="doc-section-item">\s*<td>(.*?)</td>\s*<td>(.*?)</td>', section, re.DOTALL)
    return [tuple(re.sub(r"<[^>]*>|\s", "", cell) for cell in row) for row in rows]


def test_broken_links_are_found(tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "index.html").write_text('<h1 id="here">Other</h1><a href="../index.html">back</a>')
    links = ("other/#here", "other/#there", "missing.png", "https://example.org/x", "http:///x", "../outside", "#here")
    page = "".join(f'<a href="{link}">link</a>' for link in links) + '<img src="missing.png">'
    (tmp_path / "index.html").write_text(page)
    done = subprocess.run([sys.executable, CHECK_LINKS, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        "index.html: other/#there: no such anchor",
        "index.html: missing.png: no such file",
        "index.html: http:///x: not a valid address",
        "index.html: ../outside: outside the site",
        "index.html: #here: no such anchor",
    ]


def test_an_entry_of_several_names_is_divided(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    from griffe_docstrings import rewritten

    entries = """Result.

Attributes:
    family, index: the scenario: its family,
        and its index.
    states (N, 3), costs (N,): of the path.
    achieved, desired (..., 4): poses.
    cost: J.

        A second paragraph.

Raises:
    TypeError, ValueError: see `solve`."""
    assert rewritten(entries).split("\n")[3:] == [
        "    family: the scenario: its family,",
        "        and its index.",
        "    index: the scenario: its family,",
        "        and its index.",
        "    states: (N, 3), of the path.",
        "    costs: (N,), of the path.",
        "    achieved: (..., 4), poses.",
        "    desired: (..., 4), poses.",
        "    cost: J.",
        "",
        "        A second paragraph.",
        "",
        "Raises:",
        "    TypeError: see `solve`.",
        "    ValueError: see `solve`.",
    ]


def test_the_citation_names_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == leapnav.__version__
    page = (ROOT / "docs" / "citing.md").read_text()
    assert f"version = {{{leapnav.__version__}}}" in page
    assert f"url     = {{{citation['url']}}}" in page


def test_the_readme_s_scenario_is_valid():
    (text,) = re.findall(r"```json\n(.*?)```", README, re.DOTALL)
    assert Scenario.from_json(text).obstacles
