"""Moving obstacles on the page of `leapnav play`: the slider of the time, editing, policies and driving."""

import json

import numpy as np
import pytest
from play_helpers import dragged, opened, rest, screen, served, until

from leapnav.envs import Scenario, sample_scenario
from leapnav.envs.scenarios.layouts.moving import MOVING_LAYOUTS
from leapnav.experts import find_optimum
from leapnav.play.solving import PlaySolver

PATH = {"times": [0.0, 4.0, 8.0], "points": [[2.0, 4.2], [4.0, 3.4], [6.5, 3.4]]}
SCENARIO = Scenario(
    name="two discs",
    arena=(0, 0, 8, 5),
    start=(1, 2.5, 0),
    goal=(7, 2.5, 0),
    horizon=8,
    obstacles=(
        {"circle": {"center": (4, 0.5), "radius": 0.5}, "velocity": (0.0, 0.4)},
        {"circle": {"center": (2.0, 4.2), "radius": 0.3}, "path": PATH},
    ),
)


@pytest.fixture(scope="module")
def page():
    with served(SCENARIO) as port, opened(port) as page:
        yield page


def set_time(page, time):
    page.locator("#time-slider").evaluate(
        "(slider, time) => { slider.value = time; slider.dispatchEvent(new Event('input')); }", time
    )


def test_the_optimum_is_certified_and_the_slider_shows_the_time(page):
    cost = page.evaluate("play.solution.path.cost")
    assert cost == pytest.approx(find_optimum(SCENARIO).cost, rel=1e-9)
    assert len(page.evaluate("play.solution.path.costates[0]")) == 3
    assert page.locator("#time-box").is_visible()
    assert float(page.get_attribute("#time-slider", "max")) == 8
    before = page.screenshot()
    set_time(page, 3.0)
    assert page.inner_text("#time-shown") == "3.0\u00a0s" and page.evaluate("play.clock") == 3.0
    assert page.screenshot() != before


def test_an_obstacle_is_dragged_where_it_is_at_the_time_and_keeps_its_motion(page):
    set_time(page, 4.0)
    dragged(page, [4.0, 0.5 + 0.4 * 4.0], [4.6, 0.5 + 0.4 * 4.0])
    first = page.evaluate("play.scenario.obstacles[0]")
    assert first["circle"]["center"] == pytest.approx([4.6, 0.5], abs=0.05) and first["velocity"] == [0.0, 0.4]
    dragged(page, [4.0, 3.4], [4.0, 4.0])
    second = page.evaluate("play.scenario.obstacles[1]")
    assert second["path"]["points"][0] == second["circle"]["center"]
    assert second["path"]["points"][2] == pytest.approx([6.5, 4.0], abs=0.05)
    assert page.inner_text("#status") == "Certified optimum"
    page.mouse.click(*screen(page, [4.0, 4.0]))
    assert "(4.00, 4.00)" in page.inner_text("#selection")
    for _ in range(2):
        page.click("[data-action=undo]")
    rest(page)
    assert page.evaluate("play.scenario.obstacles[1].path.points") == PATH["points"]


def test_a_policy_and_a_person_drive_among_moving_obstacles(page):
    page.select_option("#policy", "open")
    until(page, "play.episode")
    assert "open" in page.inner_text("#episode")
    page.click("#drive")
    page.keyboard.down("ArrowUp")
    until(page, "play.driving && play.driving.states.length > 4")
    page.keyboard.up("ArrowUp")
    page.keyboard.press("Escape")
    until(page, "play.episode")
    assert "You:" in page.inner_text("#episode")


def test_leapfrog_starts_among_moving_obstacles(page):
    page.click("#sweeps")
    rest(page)
    sweeps = page.evaluate("play.sweeps")
    assert len(sweeps) > 1 and len(sweeps[0]["states"][0]) == 4
    assert np.diff([sweep["cost"] for sweep in sweeps]).max() < 1e-6


@pytest.mark.parametrize("family", MOVING_LAYOUTS)
def test_scenarios_of_the_families_are_solved_and_described(family):
    scenario = sample_scenario(family, 2)
    result = PlaySolver([]).search(scenario)
    assert result["success"] and json.dumps(result)
    assert len(result["path"]["states"][0]) == len(result["path"]["costates"][0]) == 3
    assert min(result["path"]["clearances"]) == pytest.approx(result["path"]["clearance"], abs=0.02)
