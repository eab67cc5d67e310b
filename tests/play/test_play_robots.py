"""The page of `leapnav play` in Chromium with robots that have a footprint, and with the larger families."""

import numpy as np
import pytest
from play_helpers import SCENARIO, dragged, fields, load, opened, rest, screen, served

from leapnav.envs import Scenario
from leapnav.envs.scenarios.families import FAMILIES
from leapnav.play.episodes import Driving

FOOTPRINT = [{"offset": offset, "radius": 0.24} for offset in (-0.06, 0.21, 0.49, 0.66)]  # the front is 0.9 m ahead
CAR = fields(robot={"model": "car", "footprint": FOOTPRINT}, start=[1, 2.5, np.pi / 2], goal=[6, 2.5, 0], horizon=12)


@pytest.fixture(scope="module")
def page():
    with served() as port, opened(port) as page:
        yield page


def opacity(page, point):
    """The opacity of the plane at a point (m), from 0 to 255."""
    return page.evaluate(
        """(point) => {
          const [x, y] = toScreen(point).map((value) => Math.round(value * window.devicePixelRatio));
          return canvas.getContext("2d").getImageData(x, y, 1, 1).data[3];
        }""",
        point,
    )


def test_every_disc_of_a_robot_is_drawn_and_can_be_dragged(page):
    load(page, CAR)
    assert page.inner_text("#status") == "Certified optimum"
    front, side = FOOTPRINT[-1]["offset"], 0.6 * FOOTPRINT[-1]["radius"]
    for x, y in ((1 + side, 2.5 + front), (1 - side, 2.5 + FOOTPRINT[0]["offset"]), (6 + front, 2.5 + side)):
        assert opacity(page, [x, y]) > 0
    assert opacity(page, [1 + front, 2.5 + side]) == 0  # where the front would be with another heading
    dragged(page, [1 + side, 2.5 + front], [1.5 + side, 2.0 + front])
    assert page.evaluate("play.scenario.start") == pytest.approx([1.5, 2.0, np.pi / 2], abs=0.05)
    assert page.evaluate("play.selected") == "start"
    dragged(page, page.evaluate("arrowTip(play.scenario.start)"), [3, 2.0])
    assert page.evaluate("play.scenario.start[2]") == pytest.approx(0, abs=0.05)
    x, y, _ = page.evaluate("play.scenario.start")
    assert opacity(page, [x + front, y + side]) > 0


def test_a_rectangle_is_drawn_and_can_be_dragged(page):
    box = {"length": 1.0, "width": 0.4, "offset": 0.2}
    load(page, {**CAR, "robot": {"model": "car", "footprint": {"box": box}}})
    assert page.inner_text("#status") == "Certified optimum"
    corner = [1 - 0.17, 2.5 + 0.66]  # at the heading pi / 2, the front is at y = 2.5 + 0.7; the path is to the right
    assert opacity(page, corner) > 0
    assert opacity(page, [1 - 0.24, 2.5 + 0.66]) == opacity(page, [1 - 0.17, 2.5 + 0.74]) == 0
    dragged(page, corner, [corner[0] + 0.5, corner[1] - 0.5])
    assert page.evaluate("play.scenario.start") == pytest.approx([1.5, 2.0, np.pi / 2], abs=0.05)
    load(page, {**CAR, "robot": {"model": "car", "footprint": {"box": box}}, "goal": [6, 2.5, None]})
    assert page.evaluate("robotParts(play.scenario.robot, play.scenario.goal)[0].circle.radius") == pytest.approx(0.2)


def test_the_arrow_of_a_robot_is_ahead_of_its_discs(page):
    load(page, CAR)
    length = page.evaluate("arrowTip(play.scenario.goal)[0]") - 6
    assert length > max(disc["offset"] + disc["radius"] for disc in FOOTPRINT)


def test_a_goal_with_a_free_heading_shows_what_is_covered_at_any_heading(page):
    load(page, {**CAR, "goal": [6, 2.5, None]})
    covered = max(disc["radius"] - abs(disc["offset"]) for disc in FOOTPRINT)
    assert page.evaluate("robotParts(play.scenario.robot, play.scenario.goal)") == [
        {"circle": {"center": [6, 2.5], "radius": pytest.approx(max(covered, 0))}}
    ]
    dragged(page, [6, 2.5], [5.5, 2.0])
    assert page.evaluate("play.scenario.goal.slice(0, 2)") == pytest.approx([5.5, 2.0], abs=0.05)


def test_another_model_keeps_the_discs(page):
    load(page, CAR)
    page.evaluate("document.querySelector('aside details').open = true")
    assert page.locator("#radius").count() == 0 and page.locator("#wheelbase").count() == 1
    page.select_option("#model", "unicycle")
    rest(page)
    robot = Scenario.from_dict(page.evaluate("play.scenario")).robot
    assert robot.model == "unicycle" and [disc.model_dump() for disc in robot.footprint] == FOOTPRINT
    load(page, SCENARIO.to_dict())
    assert page.locator("#radius").count() == 1


def test_the_driving_ends_when_any_disc_is_in_contact():
    # The obstacle is a disc with a radius of 0.5 m at (4, 4.2).
    start = {**CAR, "robot": {"model": "unicycle", "footprint": FOOTPRINT}, "start": [4, 2, np.pi / 2]}
    driving = Driving(Scenario.from_dict(start))
    found = driving.step([[1, 0]] * 40)
    assert found["done"] and driving.finish()["collision"]
    assert found["states"][-1][1] + max(disc["offset"] + disc["radius"] for disc in FOOTPRINT) == pytest.approx(3.7)


@pytest.mark.parametrize("model", ["car", "dynamic_unicycle", "differential_drive"])
def test_every_robot_is_driven(model):
    driving = Driving(Scenario.from_dict({**SCENARIO.to_dict(), "robot": {"model": model}, "obstacles": []}))
    states = driving.step([[1, 0.5]] * 40)["states"]
    assert max(x for x, *_ in states) > SCENARIO.start[0] + 0.1 and states[-1][2] > 0.05


def test_every_family_is_offered(page):
    assert page.locator("#family option").all_inner_texts() == list(FAMILIES)
    assert page.input_value("#family") == "clutter"


@pytest.mark.parametrize("family", ["maze", "corridors"])
def test_a_larger_family_is_loaded_and_edited(page, family):
    page.select_option("#family", family)
    page.fill("#index", "3")
    page.click("#load")
    page.wait_for_timeout(100)
    rest(page)
    scenario = Scenario.from_dict(page.evaluate("play.scenario"))
    assert scenario.name == f"{family}-1-3" and page.inner_text("#status") == "Certified optimum"
    x0, y0, x1, y1 = scenario.arena
    box = page.locator("#view").bounding_box()
    for x, y in (screen(page, [x0, y0]), screen(page, [x1, y1])):
        assert box["x"] <= x <= box["x"] + box["width"] and box["y"] <= y <= box["y"] + box["height"]
    x, y, heading = scenario.start
    dragged(page, [x, y], [x + 0.05, y])
    assert page.evaluate("play.scenario.start") == pytest.approx([x + 0.05, y, heading], abs=0.05)
    assert page.inner_text("#status") == "Certified optimum"
