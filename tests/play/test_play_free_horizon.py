"""The page of `leapnav play` with a free horizon."""

import pytest
from play_helpers import fields, load, opened, rest, served, until

from leapnav.envs import Scenario
from leapnav.experts import find_optimum
from leapnav.play.episodes import Driving

PLAIN = fields(obstacles=[])
FREE = fields(obstacles=[], horizon=None, cost={**PLAIN["cost"], "proximity_weight": 0, "time_weight": 0.5})


@pytest.fixture(scope="module")
def page():
    with served() as port, opened(port) as page:
        yield page


def test_the_horizon_is_made_free_and_fixed_again(page):
    load(page, PLAIN)
    page.check("#free-horizon")
    rest(page)
    scenario = page.evaluate("play.scenario")
    assert scenario["horizon"] is None and scenario["cost"]["time_weight"] == 0.5
    optimum = find_optimum(Scenario.from_dict(scenario))
    assert page.inner_text("#cost") == f"{optimum.cost:.6f}"
    assert page.inner_text("#duration") == f"{optimum.horizon:.3f}\u00a0s"
    assert page.is_disabled("#horizon") and page.input_value("#horizon") == f"{optimum.horizon:.2f}"
    page.uncheck("#free-horizon")
    rest(page)
    scenario = page.evaluate("play.scenario")
    assert scenario["horizon"] == pytest.approx(optimum.horizon, abs=0.01) and "time_weight" not in scenario["cost"]
    assert page.inner_text("#status") == "Certified optimum"


def test_a_larger_time_weight_shortens_the_optimum(page):
    load(page, FREE)
    before = page.evaluate("durationOf(play.solution.path)")
    page.click("text=Robot and cost")
    page.fill("#time-weight", "2")
    page.keyboard.press("Tab")
    rest(page)
    assert page.evaluate("durationOf(play.solution.path)") == pytest.approx(before / 2, rel=1e-5)


def test_a_person_arrives_at_the_goal_at_any_time(page):
    load(page, FREE)
    page.focus("#view")
    page.keyboard.press("d")
    page.keyboard.down("ArrowUp")
    until(page, "play.driving && play.driving.states.length > 3")
    assert page.inner_text("#drive-time").startswith("Time: ")
    until(page, "play.episode !== null")
    page.keyboard.up("ArrowUp")
    episode = page.evaluate("play.episode")
    assert episode["success"] and 3.0 < episode["time"] < 4.0  # 6 m at 2 m/s
    assert 0 < episode["regret"] < 1


def test_episodes_of_scenarios_with_a_time_limit():
    scenario = Scenario.from_dict({**FREE, "time_limit": 1.0})
    driving = Driving(scenario)
    assert driving.step([[0, 0]] * 40)["done"]
    found = driving.finish()
    assert not found["success"] and not found["stopped"] and found["time"] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="time_limit: expected at most 300 s for an episode, got 1000"):
        Driving(Scenario.from_dict({**FREE, "time_limit": 1000.0}))
