"""The page of `leapnav play` in Chromium, if that is installed: editing, plots, links and lessons."""

import json

import numpy as np
import pytest
from play_helpers import SCENARIO, dragged, expose, fields, load, opened, rest, screen, served, until

from leapnav.envs import Scenario
from leapnav.experts import find_optimum

ALTERNATIVES = fields(obstacles=[{"circle": {"center": [4, 2.6], "radius": 0.5}}])  # paths on either side


@pytest.fixture(scope="module")
def page():
    with served() as port, opened(port) as page:
        yield page


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
    latencies = page.evaluate("play.latencies")
    assert latencies
    print(f"pointer move to redraw with the followed optimum: median {np.median(latencies):.1f} ms")  # shown by -s


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
    page.click("#add-capsule")
    page.focus("#view")
    for key in ("e", "+", "ArrowUp"):
        page.keyboard.press(key)
    rest(page)
    capsule = page.evaluate("play.scenario.obstacles.at(-1).capsule")
    assert capsule["radius"] == pytest.approx(0.22)
    assert capsule["end"][1] < capsule["start"][1]  # rotated clockwise
    assert "capsule" in page.inner_text("#selection")
    page.keyboard.press("Delete")
    rest(page)


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
    assert page.inner_text("#status").startswith("broken.json: Scenario 'x': arena: ")
    page.click("[data-action=undo]")  # what was open before
    until(page, "play.scenario.name === 'clutter-1-7'")
    rest(page)


def test_changes_are_undone_and_redone_and_a_drag_is_one_change(page):
    load(page, SCENARIO.to_dict())
    count = page.evaluate("play.undo.length")
    dragged(page, [4, 4.2], [4.5, 3.2])
    after = page.evaluate("play.scenario")
    assert page.evaluate("play.undo.length") == count + 1
    page.click("#add-disc")
    page.keyboard.press("Control+z")
    assert page.evaluate("play.scenario") == after
    page.keyboard.press("Control+z")
    assert page.evaluate("play.scenario") == SCENARIO.to_dict()
    page.keyboard.press("Control+Shift+Z")
    assert page.evaluate("play.scenario") == after
    page.keyboard.press("Control+y")
    assert page.evaluate("play.scenario.obstacles.length") == 2 and page.is_disabled("[data-action=redo]")
    page.click("[data-action=undo]")
    rest(page)
    assert page.evaluate("play.scenario") == after and page.is_enabled("[data-action=redo]")
    assert page.inner_text("#cost") == f"{find_optimum(Scenario.from_dict(after)).cost:.6f}"


def test_everything_can_be_edited_by_keyboard(page):
    load(page, SCENARIO.to_dict())
    page.focus("#view")
    press = page.keyboard.press
    press("n")  # the start
    for key in ("ArrowUp", "Shift+ArrowUp", "q"):
        press(key)
    assert page.evaluate("play.scenario.start") == pytest.approx([1, 2.56, np.pi / 36])
    press("n")
    press("e")
    press("Shift+>")  # as a keyboard sends Shift and the key of the full stop
    assert page.evaluate("play.scenario.goal") == pytest.approx([7, 2.5, -np.pi / 36 - np.pi / 180])
    assert page.inner_text("#selection") == "goal (7.00, 2.50) m, heading -6°"
    press("f")
    assert page.evaluate("poseOf('goal')") == [7, 2.5, None]
    rest(page)
    assert page.inner_text("#status") == "Certified optimum"
    press("f")
    press("a")
    press("b")
    assert page.evaluate("play.selected") == 2
    press("+")
    press("q")
    box = page.evaluate("play.scenario.obstacles[2].polygon.vertices")
    assert np.hypot(*np.subtract(box[1], box[0])) == pytest.approx(1.1 * 1.2)
    assert np.arctan2(*np.subtract(box[1], box[0])[::-1]) == pytest.approx(np.pi / 36)
    press("Delete")
    press("p")
    assert page.evaluate("[play.selected, play.scenario.obstacles.length]") == [1, 2]
    press("Backspace")
    rest(page)
    assert page.evaluate("play.scenario.obstacles.length") == 1
    press("Tab")  # leaves the canvas
    assert page.evaluate("document.activeElement.id") != "view"


def open_robot_and_cost(page):
    if not page.is_visible("#radius"):
        page.click("text=Robot and cost")


def test_robot_and_cost_are_edited_and_an_invalid_number_is_reported(page):
    load(page, SCENARIO.to_dict())
    open_robot_and_cost(page)
    page.fill("#radius", "0.4")
    page.fill("#turn-weight", "2")
    page.keyboard.press("Enter")
    rest(page)
    scenario = Scenario.from_dict(page.evaluate("play.scenario"))
    assert (scenario.robot.radius, scenario.cost.turn_weight) == (0.4, 2)
    assert page.inner_text("#cost") == f"{find_optimum(scenario).cost:.6f}"
    page.fill("#radius", "-1")
    page.keyboard.press("Enter")
    until(page, "play.error !== null && play.pending === 0")
    assert "radius" in page.inner_text("#status") and page.evaluate("play.scenario.obstacles.length") == 1
    page.click("[data-action=undo]")
    rest(page)
    assert page.evaluate("play.scenario") == scenario.to_dict() and page.inner_text("#status") == "Certified optimum"


@pytest.mark.parametrize("model", ["car", "dynamic_unicycle", "differential_drive"])
def test_another_robot_is_chosen(page, model):
    load(page, SCENARIO.to_dict())
    open_robot_and_cost(page)
    page.select_option("#model", model)
    rest(page)
    scenario = Scenario.from_dict(page.evaluate("play.scenario"))
    assert scenario.robot.model == model
    assert page.inner_text("#cost") == f"{find_optimum(scenario).cost:.6f}"
    assert page.is_enabled("#drive")
    assert page.is_disabled("#turn-weight") == ("turn_weight" not in scenario.robot.cost_fields)
    field = {"car": "wheelbase", "dynamic_unicycle": "max_acceleration", "differential_drive": "track"}[model]
    page.fill(f"#{field.replace('_', '-')}", "0.8")
    page.keyboard.press("Enter")
    rest(page)
    changed = Scenario.from_dict(page.evaluate("play.scenario"))
    assert getattr(changed.robot, field) == 0.8
    page.select_option("#model", "unicycle")
    rest(page)
    assert Scenario.from_dict(page.evaluate("play.scenario")) == SCENARIO


def test_a_link_contains_the_scenario(page):
    scenario = fields(name="ein Weg, 42 °", goal=[6.5, 3, 0.25])
    load(page, scenario)
    page.click("#link")
    until(page, "play.notice !== null")
    link = page.evaluate("location.href")
    assert "#z." in link and page.evaluate("scenarioLink(play.scenario)") == link
    load(page, SCENARIO.to_dict())
    assert page.evaluate("location.hash") == ""  # the address does not promise an outdated scenario
    page.evaluate("(hash) => { location.hash = hash; }", link.split("#")[1])
    until(page, "play.scenario.name !== 'one disc'")
    rest(page)
    assert page.evaluate("play.scenario") == scenario
    page.reload()
    expose(page)
    rest(page)
    assert page.evaluate("play.scenario") == scenario
    plain = page.evaluate("(text) => encodeBase64(new TextEncoder().encode(text))", json.dumps(SCENARIO.to_dict()))
    page.evaluate("(hash) => { location.hash = hash; }", f"j.{plain}")
    until(page, "play.scenario.name === 'one disc'")
    rest(page)
    invalid = page.evaluate("(text) => encodeBase64(new TextEncoder().encode(text))", '{"name": "x"}')
    for damaged in ("z.AAAA", link.split("#")[1][:-8], "j.e30x", "z.", "x.abc", "%00", f"j.{invalid}"):
        page.evaluate("(hash) => { play.notice = null; location.hash = hash; }", damaged)
        until(page, "play.notice !== null && play.pending === 0")
        (line,) = page.inner_text("#notice").splitlines()
        assert line.startswith("link: ") and page.evaluate("play.scenario.name") == "one disc"
    page.evaluate("history.replaceState(null, '', location.pathname)")


def test_the_curves_of_an_alternative_are_plotted(page):
    load(page, ALTERNATIVES)
    count = page.evaluate("play.solution.alternatives.length")
    assert count > 0 and page.evaluate("shownPathName()").startswith("Optimum, J = ")
    pixels = "byId('plots').toDataURL()"
    before = page.evaluate(pixels)
    page.click("#alternatives tr:nth-child(2)")
    cost = page.evaluate("play.solution.alternatives[0].cost")
    assert page.evaluate("shownPathName()").startswith(f"Alternative 1, J = {cost:.4f} (+")
    assert page.evaluate("shownPathColor()") == page.evaluate("play.colors.alternatives[0]")
    assert page.evaluate("shownPath().costates[0].length") == 3 and page.evaluate(pixels) != before
    page.keyboard.press("ArrowUp")  # to the row of the optimum
    page.keyboard.press("Enter")
    assert page.evaluate("play.highlighted") == 0 and page.evaluate(pixels) == before


def test_the_horizon_that_is_needed_is_shown_and_used(page):
    load(page, fields(horizon=2))
    needed = page.evaluate("play.solution.needed_horizon")
    text = f"The goal is out of reach in 2\u00a0s at the robot's limits; {needed:g}\u00a0s are needed."
    assert page.inner_text("#status") == text
    page.click("#use-horizon")
    rest(page)
    assert page.input_value("#horizon") == f"{needed:g}" and page.inner_text("#status") == "Certified optimum"
    assert page.is_hidden("#use-horizon")


def test_the_lessons_are_stepped_through_by_keyboard(page):
    scenario = page.evaluate("play.scenario")
    for name, steps in (("methods", 17), ("conjugate", 18)):
        page.click(f"[data-lesson={name}]")
        until(page, "play.lesson && play.lesson.content !== null && play.pending === 0")
        assert page.evaluate("play.lesson.content.steps.length") == steps
        seen = set()
        for _ in range(steps):
            text = page.inner_text("#lesson-text")
            seen.add(page.evaluate("canvas.toDataURL().length + byId('plots').toDataURL()"))
            assert len(text) > 50 and page.locator("#lesson-table tr").count() >= 3
            page.keyboard.press("ArrowRight")
        assert page.evaluate("play.lesson.step") == steps - 1 and len(seen) == steps
        assert page.is_disabled("#lesson-next")
        page.click("#lesson-previous")
        assert page.evaluate("play.lesson.step") == steps - 2
        page.fill("#lesson-slider", "3")
        assert page.evaluate("play.lesson.step") == 3 and "(4/" in page.inner_text("#lesson-step")
        page.mouse.click(*screen(page, page.evaluate("lessonScenario().goal")))  # a lesson is not edited
        page.focus("#lesson-next")
        page.keyboard.press("Escape")
        assert page.evaluate("play.lesson") is None
    assert page.evaluate("play.scenario") == scenario and page.is_visible("#toolbar")


@pytest.mark.parametrize("width", [1280, 3840])
def test_wide_windows_show_everything_without_scrolling(page, width):
    page.set_viewport_size({"width": width, "height": width * 9 // 16})
    load(page, ALTERNATIVES)
    width, height, *sizes = page.evaluate(
        """[innerWidth, innerHeight, document.documentElement.scrollWidth, document.documentElement.scrollHeight]"""
    )
    assert sizes[0] <= width and sizes[1] <= height
    panel = page.evaluate("[byId('optima').parentElement.scrollWidth, byId('optima').parentElement.clientWidth]")
    assert panel[0] <= panel[1]
    assert page.evaluate("parseFloat(getComputedStyle(document.body).fontSize)") >= 14 * (width / 1280) ** 0.4
    assert page.evaluate("canvas.clientWidth * canvas.clientHeight") > 0.25 * width * height
