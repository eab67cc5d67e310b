"""The page of `leapnav play`: the server by requests, and the page in Chromium if that is installed."""

import http.client
import json
import shutil
import threading
import time

import numpy as np
import pytest
import uvicorn

from leapnav.cli import main
from leapnav.envs import Scenario
from leapnav.experts import find_optimum
from leapnav.play.server import MAX_REQUEST_SIZE, create_app
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


@pytest.fixture(scope="module")
def port():
    server = uvicorn.Server(uvicorn.Config(create_app(PlaySolver(["open"]), SCENARIO), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()[1]
    server.should_exit = True
    thread.join()


@pytest.fixture
def ask(port):
    def ask(path, question=None, *, headers=None, body=None):
        connection = http.client.HTTPConnection("127.0.0.1", port)
        body = json.dumps(question) if body is None and question is not None else body
        headers = {"Content-Type": "application/json", **(headers or {})}
        connection.request("GET" if body is None else "POST", path, body, headers)
        reply = connection.getresponse()
        content = reply.read()
        connection.close()
        is_json = reply.getheader("content-type") == "application/json"
        return reply.status, json.loads(content) if is_json else content

    return ask


def fields(**changes):
    return {**SCENARIO.to_dict(), **changes}


def test_the_page_begins_with_its_scenario(ask):
    assert ask("/initial") == (200, {"scenario": SCENARIO.to_dict(), "policies": ["open"]})
    for path in ("/", "/canvas.js", "/page.js", "/page.css"):
        status, content = ask(path)
        assert status == 200 and len(content) > 1000
    status, found = ask("/bank?family=rooms&index=3")
    assert status == 200 and found["scenario"]["name"] == "rooms-1-3"


def test_the_optimum_and_its_alternatives_are_those_of_find_optimum(ask):
    status, found = ask("/search", {"scenario": fields()})
    optimum = find_optimum(SCENARIO)
    assert status == 200 and found["success"] and found["path"]["cost"] == optimum.cost
    assert [other["cost"] for other in found["alternatives"]] == [other.cost for other in optimum.alternatives]
    times = np.array(found["path"]["times"])
    np.testing.assert_allclose(found["path"]["states"], optimum.interpolate(times)[:, :3], atol=1e-6)
    np.testing.assert_allclose(found["path"]["hamiltonian"], optimum.hamiltonian[0], atol=1e-8)
    assert min(found["path"]["clearances"]) == pytest.approx(optimum.certificate.clearance, abs=1e-2)


def test_while_the_user_drags_the_optimum_is_followed(ask):
    _, found = ask("/follow", {"scenario": fields(), "previous": None})
    assert found["searched"] and found["success"]
    for y in np.arange(4.15, 3.0, -0.05):  # the disc moves onto the path
        scenario = fields(obstacles=[{"circle": {"center": [4, y], "radius": 0.5}}])
        status, found = ask("/follow", {"scenario": scenario, "previous": found["id"]})
        assert status == 200 and found["success"] and not found["searched"]
        assert found["path"]["clearance"] > 0
    assert np.array(found["path"]["states"])[:, 1].min() < 2.4  # the path avoids the disc
    _, found = ask("/follow", {"scenario": scenario, "previous": "what was never solved"})
    assert found["searched"] and found["success"]


def test_leapfrog_s_sweeps_come_down_to_the_optimum(ask):
    scenario = fields(obstacles=[{"circle": {"center": [4, 2.8], "radius": 0.7}}])
    _, found = ask("/sweeps", {"scenario": scenario})
    costs = [sweep["cost"] for sweep in found["sweeps"]]
    assert found["status"] == "SUCCESS" and len(costs) > 3 and costs == sorted(costs, reverse=True)
    _, best = ask("/search", {"scenario": scenario})
    assert costs[-1] == pytest.approx(best["path"]["cost"], rel=1e-3)
    assert found["sweeps"][0]["states"][-1][:2] == pytest.approx([7, 2.5], abs=1e-6)


def test_a_policy_drives_beside_it(ask):
    status, found = ask("/drive", {"scenario": fields(obstacles=[]), "policy": "open"})
    assert status == 200 and found["success"] and found["states"][0] == list(SCENARIO.start)
    status, found = ask("/drive", {"scenario": fields(), "policy": "../../somewhere"})
    assert (status, found["error"]) == (400, "policy: expected one of open, got '../../somewhere'")


def test_a_scenario_without_a_path_is_reported(ask):
    wall = [{"polygon": {"vertices": [[3.9, 0], [4.1, 0], [4.1, 5], [3.9, 5]]}}]
    for path in ("/follow", "/search"):
        status, found = ask(path, {"scenario": fields(obstacles=wall)})
        assert (status, found["success"], found["id"]) == (200, False, None)
        assert found["status"] == "NO_PATH" or path == "/follow"
    status, found = ask("/sweeps", {"scenario": fields(obstacles=wall)})
    assert (status == 200 and (found["status"], found["sweeps"]) == ("NO_PATH", [])) or found["sweeps"]


@pytest.mark.parametrize(
    ("question", "message"),
    [
        ({}, "a scenario is a JSON object, got None"),
        ({"scenario": [1, 2]}, "a scenario is a JSON object, got [1, 2]"),
        ({"scenario": {"name": "x"}}, "Scenario 'x': arena: field required"),
        ({"scenario": fields(goal=[4, 4.2, 0])}, "Scenario 'one disc': goal: (4, 4.2) is inside obstacles[0]"),
        ({"scenario": fields(horizon=0)}, "Scenario 'one disc': horizon: input should be greater than 0, got 0"),
        ({"scenario": fields(), "previous": 3}, "previous: expected a string, got 3"),
        ([], "expected a JSON object"),
    ],
)
def test_questions_are_validated_like_a_file(question, message, ask):
    status, found = ask("/follow", question)
    assert status == 400 and found["error"].startswith(message)


def test_invalid_requests_are_refused(ask):
    assert ask("/search", body="{")[0] == 400
    assert ask("/search", body="[" * 100_000)[0] == 400
    assert ask("/search", body=b"\xff\xfe")[0] == 400
    assert ask("/search", {"scenario": fields()}, headers={"Content-Type": "text/plain"})[0] == 415
    assert ask("/search", body=" " * (MAX_REQUEST_SIZE + 1))[0] == 413
    assert ask("/search")[0] == 405
    families = "open, clutter, polygons, rooms, slalom"
    for query, error in {
        "family=moon": f"family: expected one of {families} or all, got 'moon'",
        "family=open&index=x": "index: expected an integer, got 'x'",
        "family=open&index=200": "index: expected an integer from 0 to 199, got 200",
        "family=open&index=-1": "index: expected an integer from 0 to 199, got -1",
    }.items():
        assert ask(f"/bank?{query}") == (400, {"error": error})
    assert ask("/search", body="{")[1] == {"error": "the request is not valid JSON"}
    assert ask("/search", body='{"scenario": ' + "9" * 5000 + "}")[1] == {"error": "the request is not valid JSON"}
    _, found = ask("/search", {"scenario": fields(name="\ud800")})
    assert found == {"error": r"Scenario: name: expected printable characters, got '\ud800'"}
    _, found = ask("/drive", {"scenario": fields(horizon=1000), "policy": "open"})
    assert found == {"error": "horizon: expected at most 300 s for an episode, got 1000"}


def test_nothing_else_is_served_and_to_nobody_else(ask):
    for path in (
        "/../pyproject.toml",
        "/page.js/../../../x",
        "/..%2f..%2fpyproject.toml",
        "/solver.py",
        "//etc/passwd",
    ):
        assert ask(path)[0] == 404
    assert ask("/initial", headers={"Host": "elsewhere.example"})[0] == 400  # a name that resolves to this machine


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--port", "70000"], "port: expected an integer from 0 to 65535, got 70000"),
        (["--scenario", "missing.json"], "missing.json: No such file or directory"),
        (["--policies", "nowhere"], "nowhere"),
        (["--host", "no.such.host.invalid"], "host: expected an address of this machine, got 'no.such.host.invalid'"),
    ],
)
def test_bad_arguments_are_one_line(words, message, capsys):
    assert main(["play", "--no-browser", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_port_in_use_is_told(port, capsys):
    assert main(["play", "--no-browser", "--port", str(port)]) == 2
    assert capsys.readouterr().err == f"leapnav: port: {port} is in use; --port 0 selects a free one\n"


@pytest.fixture(scope="module")
def page(port):
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_context(accept_downloads=True).new_page()
        page.set_default_timeout(0)
        problems = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.goto(f"http://127.0.0.1:{port}/")
        rest(page)
        yield page
        browser.close()
    refused = "Failed to load resource: the server responded with a status of 400"  # expected by the tests
    assert not [problem for problem in problems if refused not in problem]


def until(page, condition):
    """Waits for a condition. Playwright's own function needs a page that allows the evaluation of text."""
    while not page.evaluate(condition):
        page.wait_for_timeout(20)


def rest(page):
    """Waits until no request is open."""
    until(page, "play.searched && play.pending === 0")


def screen(page, point):
    box = page.locator("#view").bounding_box()
    x, y = page.evaluate("(point) => toScreen(point)", point)
    return box["x"] + x, box["y"] + y


def dragged(page, start, end, steps=12):
    page.mouse.move(*screen(page, start))
    page.mouse.down()
    page.mouse.move(*screen(page, end), steps=steps)
    page.mouse.up()
    rest(page)


def test_an_obstacle_dragged_over_the_path_pushes_it_aside(page):
    before = page.evaluate("play.solution.path")
    middle = before["states"][100]
    dragged(page, [4, 4.2], [4, 2.7])
    center = page.evaluate("play.scenario.obstacles[0].circle.center")
    assert center == pytest.approx([4, 2.7], abs=0.05)
    after = page.evaluate("play.solution.path")
    distances = [np.hypot(x - center[0], y - center[1]) for x, y, _ in after["states"]]
    assert min(distances) > 0.75 > np.hypot(middle[0] - center[0], middle[1] - center[1])
    assert after["cost"] > before["cost"] and page.inner_text("#status") == "Certified optimum"
    assert page.inner_text("#cost") == f"{after['cost']:.6f}"
    assert page.locator("#alternatives tr").count() == 1 + len(page.evaluate("play.solution.alternatives"))


def test_a_click_asks_for_nothing_and_what_is_deleted_is_not_dragged_on(page):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.mouse.click(*screen(page, page.evaluate("play.scenario.obstacles[0].circle.center")))
    page.wait_for_timeout(400)
    assert page.evaluate("play.selected") == 0 and not asked
    before = page.evaluate("play.scenario")
    page.click("#add-disc")
    rest(page)
    center = page.evaluate("play.scenario.obstacles[1].circle.center")
    page.mouse.move(*screen(page, center))
    page.mouse.down()
    page.keyboard.press("Delete")
    page.mouse.move(*screen(page, [6, 4]), steps=4)
    page.mouse.up()
    rest(page)
    assert page.evaluate("play.scenario") == before


def test_goal_and_heading_can_be_dragged(page):
    dragged(page, [7, 2.5], [6.5, 1.2])
    x, y, heading = page.evaluate("play.scenario.goal")
    assert (x, y) == pytest.approx((6.5, 1.2), abs=0.05) and heading == 0
    dragged(page, page.evaluate("arrowTip(play.scenario.goal)"), [6.5, 2.2])
    assert page.evaluate("play.scenario.goal[2]") == pytest.approx(np.pi / 2, abs=0.05)
    end = page.evaluate("play.solution.path.states[200]")
    assert end == pytest.approx(page.evaluate("play.scenario.goal"), abs=1e-3)


def test_sweeps_policy_and_keys(page):
    page.click("#sweeps")
    until(page, "play.sweeps !== null && play.pending === 0")
    assert page.inner_text("#sweep").startswith("sweep 0: J = ")
    page.select_option("#policy", "open")
    until(page, "play.episode !== null")
    assert "J = " in page.inner_text("#episode")
    count = page.evaluate("play.scenario.obstacles.length")
    page.click("#add-box")
    rest(page)
    assert page.evaluate("play.scenario.obstacles.length") == count + 1
    page.focus("#view")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Delete")
    rest(page)
    assert page.evaluate("play.scenario.obstacles.length") == count
    until(page, "play.episode !== null")  # the policy drives in the new scenario


def test_a_pose_in_an_obstacle_is_refused_and_nothing_is_lost(page):
    center = page.evaluate("play.scenario.obstacles[0].circle.center")
    goal = page.evaluate("play.scenario.goal")
    page.mouse.move(*screen(page, goal))
    page.mouse.down()
    page.mouse.move(*screen(page, center), steps=5)
    until(page, "play.error !== null && play.pending === 0")
    assert "is inside obstacles[0]" in page.inner_text("#status")
    page.mouse.move(*screen(page, goal), steps=5)
    page.mouse.up()
    rest(page)
    assert page.inner_text("#status") == "Certified optimum"


def test_scenarios_are_saved_and_opened(page, tmp_path):
    with page.expect_download() as download:
        page.click("#save")
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    assert path.name == "one-disc.json"
    saved = Scenario.from_json(path)
    assert saved.to_dict() == page.evaluate("play.scenario")
    page.click("#load")
    until(page, "play.scenario.name === 'clutter-1-7'")
    rest(page)
    page.set_input_files("#file", path)
    until(page, "play.scenario.name === 'one disc'")
    rest(page)
    assert page.evaluate("play.solution.path.cost") == pytest.approx(find_optimum(saved).cost, rel=1e-6)
    broken = tmp_path / "broken.json"
    broken.write_text('{"name": "x"}')
    page.set_input_files("#file", broken)
    until(page, "play.error !== null")
    assert page.inner_text("#status") == "broken.json: Scenario 'x': arena: field required (and 3 more)"
