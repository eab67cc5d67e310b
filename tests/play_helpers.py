"""The server of `leapnav play` in a thread, and its page in Chromium, for the tests."""

import http.client
import json
import shutil
import threading
import time
from contextlib import contextmanager

import pytest
import uvicorn

from leapnav.envs import Scenario
from leapnav.play.server import SCRIPTS, create_app
from leapnav.play.solving import PlaySolver

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SCENARIO = Scenario(
    name="one disc",
    arena=(0, 0, 8, 5),
    start=(1, 2.5, 0),
    goal=(7, 2.5, 0),
    horizon=8,
    obstacles=({"circle": {"center": (4, 4.2), "radius": 0.5}},),
)
REFUSED = "Failed to load resource: the server responded with a status of 400"  # expected by the tests


@contextmanager
def served(scenario=SCENARIO):
    """The port of a server."""
    server = uvicorn.Server(uvicorn.Config(create_app(PlaySolver(["open"]), scenario), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    try:
        yield server.servers[0].sockets[0].getsockname()[1]
    finally:  # a thread that still runs would keep the process of the tests alive
        server.should_exit = True
        thread.join()


def ask_server(port, path, question=None, *, headers=None, body=None):
    """Status and content of a response."""
    connection = http.client.HTTPConnection("127.0.0.1", port)
    body = json.dumps(question) if body is None and question is not None else body
    headers = {"Content-Type": "application/json", **(headers or {})}
    connection.request("GET" if body is None else "POST", path, body, headers)
    reply = connection.getresponse()
    content = reply.read()
    connection.close()
    is_json = reply.getheader("content-type") == "application/json"
    return reply.status, json.loads(content) if is_json else content


def fields(**changes):
    """The fields of the scenario, with changes."""
    return {**SCENARIO.to_dict(), **changes}


@contextmanager
def opened(port, **options):
    """The page in Chromium, after its first search; any error of a script fails the test."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_context(accept_downloads=True, **options).new_page()
        page.set_default_timeout(300_000)  # ms; an element that never appears must not stop the run
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.goto(f"http://127.0.0.1:{port}/")
        rest(page)
        expose(page)
        try:
            yield page
        finally:
            browser.close()
    assert not [problem for problem in problems if REFUSED not in problem]


def expose(page):
    """Makes what the scripts export global, for the expressions of the tests."""
    for name in SCRIPTS:
        page.evaluate("(name) => import(`/${name}`).then((module) => { Object.assign(window, module); })", name)


def until(page, condition):
    """Waits for a condition. Playwright's own function needs a page that allows the evaluation of text."""
    while not page.evaluate(condition):
        page.wait_for_timeout(20)


def rest(page):
    """Waits until no request is open."""
    until(page, "play.searched && play.pending === 0")


def load(page, scenario):
    """Shows a scenario as if its file had been opened."""
    page.evaluate("(scenario) => { closeLesson(); setScenario(scenario); }", scenario)
    rest(page)


def screen(page, point):
    """The position of a point (m) in the window (pixels)."""
    box = page.locator("#view").bounding_box()
    x, y = page.evaluate("(point) => toScreen(point)", point)
    return box["x"] + x, box["y"] + y


def dragged(page, start, end, steps=12):
    """Drags with the mouse between two points (m)."""
    page.mouse.move(*screen(page, start))
    page.mouse.down()
    page.mouse.move(*screen(page, end), steps=steps)
    page.mouse.up()
    rest(page)
