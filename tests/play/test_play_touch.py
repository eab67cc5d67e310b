"""Touch, the layout on a phone, and driving, on the page of `leapnav play` in Chromium, if that is installed."""

import numpy as np
import pytest
from play_helpers import SCENARIO, fields, load, opened, rest, screen, served, until

SHORT = fields(goal=[2.0, 2.5, 0], horizon=1, obstacles=[])  # straight ahead at half of the maximum speed


@pytest.fixture(scope="module")
def page():
    with (
        served() as port,
        opened(port, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True) as page,
    ):
        yield page


def swipe(page, start, end, steps=8):
    """Moves one finger between two points of the window (pixels)."""
    session = page.context.new_cdp_session(page)

    def touch(kind, points):
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", [{"x": start[0], "y": start[1]}])
    for x, y in np.linspace(start, end, steps + 1)[1:]:
        touch("touchMove", [{"x": x, "y": y}])
    touch("touchEnd", [])
    session.detach()


def assert_no_overflow(page):
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for name in ("clearance (m)", "Clearance"):  # one line each
        box = page.get_by_text(name, exact=True).first
        if box.is_visible():
            assert box.evaluate(
                "(e) => e.getBoundingClientRect().height < 2.2 * parseFloat(getComputedStyle(e).fontSize)"
            )


def test_a_phone_shows_one_column_without_horizontal_scrolling(page):
    load(page, fields(obstacles=[{"circle": {"center": [4, 2.6], "radius": 0.5}}]))
    assert_no_overflow(page)
    tops = [page.locator(name).bounding_box()["y"] for name in ("#stage", "#tools", "#summary", "#charts", "aside")]
    assert tops == sorted(tops)
    box = page.locator("#stage").bounding_box()
    assert box["width"] == box["height"] == 390
    small = page.evaluate(
        """[...document.querySelectorAll("button, select, input:not([type=checkbox]), #alternatives tr")]
        .filter((e) => e.getClientRects().length && e.getBoundingClientRect().height < 40).map((e) => e.outerHTML)"""
    )
    assert small == []
    page.evaluate("openLesson('methods')")
    until(page, "play.lesson.content !== null")
    assert_no_overflow(page)
    assert page.locator("#lesson-box").bounding_box()["y"] < page.locator("#charts").bounding_box()["y"]
    page.tap("#lesson-next")
    assert page.evaluate("play.lesson.step") == 1
    page.tap("#lesson-close")


def test_a_finger_drags_a_handle_and_scrolls_the_page_elsewhere(page):
    load(page, SCENARIO.to_dict())
    page.evaluate("scrollTo(0, 0)")
    swipe(page, screen(page, [4, 4.2]), screen(page, [4, 3.0]))
    rest(page)
    assert page.evaluate("play.scenario.obstacles[0].circle.center") == pytest.approx([4, 3], abs=0.05)
    assert page.evaluate("[scrollY, play.selected]") == [0, 0]
    before = page.evaluate("play.scenario")
    page.tap("[data-action=grow]")
    page.tap("[data-action=left]")
    disc = page.evaluate("play.scenario.obstacles[0].circle")
    assert disc["radius"] == pytest.approx(0.55) and disc["center"][0] == pytest.approx(3.95, abs=0.05)
    page.tap("[data-action=next]")
    assert page.evaluate("play.selected") == "start"
    page.tap("[data-action=undo]")
    page.tap("[data-action=undo]")
    rest(page)
    assert page.evaluate("play.scenario") == before
    page.evaluate("scrollTo(0, 0)")
    x, y = screen(page, [2, 1])
    swipe(page, (x, y), (x, y - 100), steps=20)
    until(page, "scrollY > 20")
    assert page.evaluate("play.scenario") == before
    page.evaluate("scrollTo(0, 0)")


def test_a_person_drives_by_touch_and_sees_the_regret(page):
    load(page, SHORT)
    page.tap("#drive")
    assert page.is_visible("#pad") and page.evaluate("play.driving.hasBegun") is False
    session = page.context.new_cdp_session(page)
    scrolled = page.evaluate("scrollY")
    # Half of the maximum speed, straight ahead. The first touch may miss the pad while the layout still changes.
    while True:
        box = page.locator("#pad").bounding_box()
        point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 4}
        session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
        page.wait_for_timeout(200)
        if page.evaluate("play.driving === null || play.driving.hasBegun"):
            break
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(page, "play.episode !== null")
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    episode = page.evaluate("play.episode")
    assert episode["success"] and episode["policy"] == "you" and len(episode["states"]) == 21
    assert page.evaluate("scrollY") == scrolled
    text = page.inner_text("#episode")
    assert text == f"You: reached the goal, J = {episode['cost']:.4f}, regret {100 * episode['regret']:.2f}\u00a0%"
    assert 0 <= episode["regret"] < 0.05


def test_a_person_drives_by_keyboard(page):
    load(page, fields(goal=[2.7, 2.5, 0], horizon=1, obstacles=[]))
    page.focus("#view")
    page.keyboard.press("d")
    page.keyboard.down("ArrowUp")
    until(page, "play.driving && play.driving.states.length > 3")
    simulated = page.evaluate("play.driving.states.slice(0, 4)")
    assert "Time left" in page.inner_text("#drive-time")
    until(page, "play.episode !== null")
    page.keyboard.up("ArrowUp")
    episode = page.evaluate("play.episode")
    np.testing.assert_allclose(simulated, episode["states"][:4], atol=1e-6)  # the environment's motion
    assert not episode["stopped"] and episode["states"][-1][0] == pytest.approx(1 + 2 * (1 - 0.05 * 2), abs=0.02)
    assert page.inner_text("#episode").startswith("You: ")


def test_an_arc_is_driven_and_escape_stops(page):
    load(page, SCENARIO.to_dict())
    page.focus("#view")
    page.keyboard.press("d")
    page.keyboard.down("w")
    page.keyboard.down("a")
    until(page, "play.driving.states.length > 8")
    page.keyboard.press("Escape")
    for key in "wa":
        page.keyboard.up(key)
    until(page, "play.episode !== null")
    episode = page.evaluate("play.episode")
    assert episode["stopped"] and not episode["success"] and episode["regret"] is None
    assert page.inner_text("#episode").startswith("You: stopped after 0.")
    x, _, heading = episode["states"][-1]
    assert x > 1.0 and heading > 0.1  # ahead, and to the left
    np.testing.assert_allclose(page.evaluate("play.episode.period"), 0.05)


def test_a_collision_ends_the_driving(page):
    load(page, fields(obstacles=[{"circle": {"center": [2.2, 2.5], "radius": 0.5}}]))
    page.focus("#view")
    page.keyboard.press("d")
    page.keyboard.down("ArrowUp")
    until(page, "play.episode !== null")
    page.keyboard.up("ArrowUp")
    assert page.evaluate("play.episode.collision") and page.inner_text("#episode").startswith("You: collided after ")


def test_a_negative_regret_is_explained(page):
    text = page.evaluate("describeEpisode({ policy: 'x', success: true, cost: 1, regret: -0.01, states: [[0, 0, 0]] })")
    assert text.startswith("x: reached the goal, J = 1.0000, regret -1.00") and "the search did not find" in text
    text = page.evaluate("describeEpisode({ policy: 'x', success: true, cost: 1, regret: -1e-9, states: [[0, 0, 0]] })")
    assert text == "x: reached the goal, J = 1.0000, regret 0.00\u00a0%"
