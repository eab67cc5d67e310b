import numpy as np
import pytest

from leapnav.envs import Scenario, ScenarioError, Unicycle
from leapnav.envs.scenarios.maps import read_movingai, rectangles
from leapnav.experts import find_optimum

ROOMS = """type octile
height 7
width 9
map
@@@@@@@@@
@...T...@
@...T...@
@.......@
@...W.S.@
@...O.G.@
@@@@@@@@@
"""
POSES = {"start": (1.5, 5.5, 0.0), "goal": (7.5, 5.5, None), "horizon": 12.0}


@pytest.fixture
def rooms(tmp_path):
    path = tmp_path / "rooms.map"
    path.write_text(ROOMS)
    return path


def covered(shape, found):
    cells = np.zeros(shape, dtype=bool)
    for top, left, bottom, right in found:
        assert not cells[top:bottom, left:right].all()  # each covers something that none before did
        cells[top:bottom, left:right] = True
    return cells


def test_a_map_s_walls_are_few_rectangles(rooms):
    blocked = read_movingai(rooms)
    assert blocked.sum() == 2 * 9 + 2 * 5 + 4
    found = rectangles(blocked)
    assert len(found) == 6
    assert (covered(blocked.shape, found) == blocked).all()


@pytest.mark.parametrize("density", [0.02, 0.2, 0.6, 1.0])
def test_rectangles_cover_what_can_be_touched_and_nothing_that_is_free(density):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        blocked = rng.random((int(rng.integers(1, 30)), int(rng.integers(1, 30)))) < density
        cells = covered(blocked.shape, rectangles(blocked))
        assert not (cells & ~blocked).any()
        for line, column in np.argwhere(blocked & ~cells):
            around = blocked[max(0, line - 1) : line + 2, max(0, column - 1) : column + 2]
            assert around.all()


def test_a_scenario_on_a_map_is_solved_through_its_door(rooms):
    scenario = Scenario.from_movingai(rooms, **POSES)
    assert scenario.name == "rooms"
    assert scenario.arena == (0.0, 0.0, 9.0, 7.0)
    optimum = find_optimum(scenario)
    assert optimum.success
    crossing = optimum.states[np.abs(optimum.states[:, 0] - 4.5).argmin()]
    assert 3.0 < crossing[1] < 4.0  # the door is in the fourth line from the top
    poses = {"start": (0.75, 2.75, 0.0), "goal": (3.75, 2.75, 0.0), "horizon": 9.0}
    half = Scenario.from_movingai(rooms, cell_size=0.5, name="small", robot=Unicycle(radius=0.1), **poses)
    assert (half.name, half.arena) == ("small", (0.0, 0.0, 4.5, 3.5))
    assert half.obstacles[0].shape.vertices == ((0.0, 3.0), (4.5, 3.0), (4.5, 3.5), (0.0, 3.5))


def test_a_pose_in_a_blocked_cell_is_refused(rooms):
    with pytest.raises(ScenarioError, match=r"goal: \(4\.5, 5\.5\) is inside obstacles"):
        Scenario.from_movingai(rooms, **{**POSES, "goal": (4.5, 5.5, 0.0)})
    with pytest.raises(ScenarioError, match=r"start: \(1\.1, 5\.5\) is inside obstacles"):  # its rim is
        Scenario.from_movingai(rooms, **{**POSES, "start": (1.1, 5.5, 0.0)})
    with pytest.raises(ScenarioError, match=r"start: \(-1, 5\.5\) is inside the arena wall"):
        Scenario.from_movingai(rooms, **{**POSES, "start": (-1.0, 5.5, 0.0)})
    with pytest.raises(ScenarioError, match=r"start\[0\]: expected a finite number, got nan"):
        Scenario.from_movingai(rooms, **{**POSES, "start": (float("nan"), 5.5, 0.0)})
    # Deep in a wall there is no obstacle: nothing can get there, and nothing may begin there.
    rooms.write_text("type octile\nheight 5\nwidth 5\nmap\n@.@.@\n@@@.@\n.@@@@\n@.@@@\n@.@@@\n")
    with pytest.raises(ScenarioError, match=r"'rooms': start: \(3\.5, 1\.5\) is in a blocked cell of .*rooms\.map"):
        Scenario.from_movingai(rooms, start=(3.5, 1.5, 0.0), goal=(3.5, 3.5, 0.0), horizon=9.0)
    with pytest.raises(ValueError, match="cell_size: expected a positive number, got 0"):
        Scenario.from_movingai(rooms, cell_size=0, **POSES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("type octile\n", "", "expected lines type, height, width and map"),
        ("height 7", "height seven", "height: expected a number of cells, got 'seven'"),
        ("height 7", "height 8", "expected 8 lines of cells, got 7"),
        ("@.......@", "@......@", r"line 8: expected 9 cells of \.GS@OTW, got '@\.\.\.\.\.\.@'"),
        ("@.......@", "@...x...@", "line 8: expected 9 cells"),
        ("@.......@", "@...é...@", "not ASCII text"),
    ],
)
def test_what_is_no_map_is_refused(old, new, message, rooms):
    rooms.write_text(ROOMS.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=rf"rooms\.map: .*{message}"):
        Scenario.from_movingai(rooms, **POSES)


def test_discs_become_a_scenario():
    discs = np.array([[2.0, 0.0, 0.5], [3.0, 2.0, 0.25]])
    scenario = Scenario.from_discs(discs, start=(0, 0, 0), goal=(5, 1, None), horizon=8, name="barn")
    assert scenario.arena == (-1.0, -1.5, 6.0, 3.25)
    assert [obstacle.shape.radius for obstacle in scenario.obstacles] == [0.5, 0.25]
    assert find_optimum(scenario).success
    bare = Scenario.from_discs([], start=(0, 0, 0), goal=(5, 1, 0), horizon=8, arena=(-2, -2, 7, 3))
    assert (bare.obstacles, bare.arena) == ((), (-2.0, -2.0, 7.0, 3.0))


@pytest.mark.parametrize(
    ("discs", "message"),
    [
        ([[1, 2]], r"discs: expected rows of x, y and radius, got an array of shape \(1, 2\)"),
        (
            [[9, 9, 1], [1, 2, 0]],
            r"discs\[1\]: expected finite numbers and a positive radius, got \(1\.0, 2\.0, 0\.0\)",
        ),
        ([[1, float("nan"), 1]], r"discs\[0\]: expected finite numbers"),
        ([["a", 1, 1]], "discs: expected numbers in rows"),
    ],
)
def test_what_is_no_disc_is_refused(discs, message):
    with pytest.raises(ValueError, match=message):
        Scenario.from_discs(discs, start=(0, 0, 0), goal=(5, 1, 0), horizon=8)
