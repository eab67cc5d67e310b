"""Worlds of other benchmarks, from small files in their formats."""

import json
import math

import numpy as np
import pytest

from leapnav.cli import main
from leapnav.envs import Polygon, ScenarioBank, ScenarioError, Unicycle
from leapnav.envs.worlds.barn import path_lengths, read_barn, read_cylinders
from leapnav.envs.worlds.dynobench import read_dynobench
from leapnav.envs.worlds.movingai import read_movingai_problems, read_scen
from leapnav.envs.worlds.tpcap import convex_parts, read_tpcap
from leapnav.experts import find_optimum
from leapnav.training.scoring.barn import barn_score

GEOMETRY = "<link name='link'><collision name='collision'><geometry>{}</geometry></collision></link>"
CYLINDER = GEOMETRY.format("<cylinder><radius>{radius}</radius><length>1</length></cylinder>")
MODEL = "<model name='unit_cylinder_{i}'><static>1</static><pose frame=''>{pose}</pose>" + CYLINDER + "</model>"
PLANE = f"<model name='ground_plane'>{GEOMETRY.format('<plane><size>100 100</size></plane>')}</model>"
STATE = "<state world_name='default'><model name='unit_cylinder_0'><pose frame=''>9 9 0 0 0 0</pose></model></state>"
ROOMS = """type octile
height 5
width 8
map
........
...@....
...@....
...@....
........
"""
PROBLEMS = ("0 2 7 2 9.65685425", "1 1 1 1 0", "0 4 7 4 7")  # start, goal and length
SCEN = "version 1\n" + "".join(f"0 rooms.map 8 5 {problem}\n".replace(" ", "\t") for problem in PROBLEMS)


def cylinders(seed, count=250):
    """Cylinders around a winding passage from the start to the goal of the challenge."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        x, y = rng.uniform(-4.5, 0.0), rng.uniform(5.0, 10.0)
        if abs(x + 2.25 - 0.5 * math.sin(y + seed)) > 0.75:
            found.append((round(x, 3), round(y, 3), 0.075))
    return np.array(found)


@pytest.fixture
def challenge(tmp_path):
    """A directory with the structure of the challenge's repository, and three worlds."""
    folder = tmp_path / "challenge" / "worlds" / "BARN"
    (folder / "path_files").mkdir(parents=True)
    for number in (0, 2, 10):
        discs = enumerate(cylinders(number))
        models = "".join(MODEL.format(i=i, pose=f"{x} {y} 0 0 0 0", radius=radius) for i, (x, y, radius) in discs)
        text = f"<sdf version='1.6'><world name='default'>{PLANE}{models}{STATE}</world></sdf>"
        (folder / f"world_{number}.world").write_text(text)
        if number != 10:
            np.save(folder / "path_files" / f"path_{number}.npy", np.array([[15, 0], [15, 20], [15, 40]]))
    other = tmp_path / "challenge" / "worlds" / "DynaBARN"
    other.mkdir()
    (other / "world_0.world").write_text("<sdf/>")
    return tmp_path / "challenge"


def test_worlds_of_the_barn_challenge_are_scenarios(challenge):
    scenarios = read_barn(challenge)
    assert [scenario.name for scenario in scenarios] == ["barn-0", "barn-2", "barn-10"]
    assert read_barn(challenge / "worlds" / "BARN", horizon="free")[1].horizon is None
    assert np.allclose(read_cylinders(challenge / "worlds/BARN/world_2.world"), cylinders(2))
    scenario = scenarios[0]
    assert (
        len(scenario.obstacles) == 250 and scenario.start == (-2.25, 3.0, 1.57) and scenario.goal == (-2.25, 13, None)
    )
    # From the start at y = 3 to the first cell at (-2.325, 5.075), along cells of 0.15 m to y = 11.075, to the goal.
    length = math.hypot(0.075, 2.075) + 6.0 + math.hypot(0.075, 1.925)
    assert path_lengths(challenge) == pytest.approx({"barn-0": length, "barn-2": length})
    assert [scenario.horizon for scenario in scenarios] == [round(length / 0.8, 1), round(length / 0.8, 1), 12.5]


def test_the_barn_challenge_runs_from_its_files_to_its_score(challenge, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["worlds", "import", "barn", "challenge", "--out", "worlds"]) == 0
    assert "wrote 3 scenarios to worlds; next: leapnav bank build --scenarios worlds" in capsys.readouterr().out
    assert main(["bank", "build", "--scenarios", "worlds", "--out", "barn.bank", "--workers", "1"]) == 0
    words = ["--policy", "clutter", "random", "--bank", "barn2.bank", "--workers", "1", "--json", "barn.json"]
    assert main(["worlds", "benchmark", "barn", "challenge", *words]) == 0
    assert "BARN challenge" in capsys.readouterr().out
    bank, given = ScenarioBank("barn2.bank"), ScenarioBank("barn.bank")
    assert len(bank) == 3 and sorted(bank.costs) == sorted(given.costs)
    content = json.loads((tmp_path / "barn.json").read_text())
    clutter, random = content["barn"]
    assert clutter["success"] == 1.0 and 0.3 < clutter["score"] <= 0.5 and random["score"] == 0.0
    assert 9.0 < clutter["seconds"] < 13.0


def test_the_score_of_the_challenge_is_limited_to_twice_and_eight_times_the_optimal_time():
    assert barn_score(None, 10.0) == 0.0
    assert [barn_score(time, 10.0) for time in (5.0, 10.0, 20.0, 40.0, 90.0)] == [0.5, 0.5, 0.25, 0.125, 0.125]


def test_problems_on_a_grid_map_are_scenarios(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms.map").write_text(ROOMS)
    (tmp_path / "rooms.map.scen").write_text(SCEN)
    around, below = read_movingai_problems("rooms.map", "rooms.map.scen", cell_size=2.0)
    assert (around.name, below.name) == ("rooms-2", "rooms-4")  # the problem without a way to go is left out
    assert around.start[:2] == (1.0, 5.0) and around.goal == (15.0, 5.0, None) and below.start[:2] == (1.0, 1.0)
    assert around.horizon == round(9.65685425 * 2 / 0.8, 1) and around.start[2] == 0.0
    assert find_optimum(around).success
    assert (
        main(["worlds", "import", "movingai", "rooms.map", "--scen", "rooms.map.scen", "--count", "1", "--out", "out"])
        == 0
    )
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["rooms-2.json"]
    with pytest.raises(ScenarioError, match=r"start: .* is inside"):
        read_movingai_problems("rooms.map", "rooms.map.scen", robot=Unicycle(radius=0.8))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("2 2 0 0 1 1 1.4", "scen: line 2: expected the size 4 x 4 of free.map, got 2 x 2"),
        ("8 8 0 0 7 7 9.9", "scen: line 2: expected the size 4 x 4 of free.map, got 8 x 8"),
        ("4 4 0 0 4 3 4.4", "scen: line 2: goal: expected a cell of the map 4 x 4, got 4 3"),
        ("4 4 -1 0 3 3 4.4", "scen: line 2: start: expected a cell of the map 4 x 4, got -1 0"),
    ],
)
def test_problems_of_another_map_are_refused(line, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free.map").write_text("type octile\nheight 4\nwidth 4\nmap\n" + 4 * "....\n")
    (tmp_path / "scen").write_text(f"version 1\n0 free.map {line}\n")
    with pytest.raises(ValueError, match=message):
        read_movingai_problems("free.map", "scen", robot=Unicycle(radius=0.1))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: read_barn("none"), FileNotFoundError, "none: expected files world_N.world"),
        (lambda: read_cylinders("text.world"), ValueError, "text.world: not a Gazebo world"),
        (lambda: read_cylinders("empty.world"), ValueError, "empty.world: expected a Gazebo world with cylinders"),
        (
            lambda: read_cylinders("pose.world"),
            ValueError,
            r"pose.world: model '\w+': expected numbers, got \['a', 'b'",
        ),
        (lambda: path_lengths("."), ValueError, r"path_7\.npy: expected an array of points"),
        (lambda: read_scen("none"), FileNotFoundError, "none: no such file"),
        (lambda: read_scen("text.world"), ValueError, "text.world: not a scenario file of the Moving AI Lab"),
        (lambda: read_scen("bad.scen"), ValueError, "bad.scen: line 3: expected bucket, map, width, .* got '0 x 8 5'"),
    ],
)
def test_invalid_files_are_named(call, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.world").write_text("no XML")
    (tmp_path / "empty.world").write_text(f"<sdf><world>{PLANE}</world></sdf>")
    cylinder = "<link><collision><geometry><cylinder><radius>1</radius></cylinder></geometry></collision></link>"
    (tmp_path / "pose.world").write_text(
        f"<sdf><world><model name='c'><pose>a b</pose>{cylinder}</model></world></sdf>"
    )
    (tmp_path / "world_7.world").write_text(f"<sdf><world>{PLANE}</world></sdf>")
    (tmp_path / "path_files").mkdir()
    (tmp_path / "path_files/path_7.npy").write_text("1 2 3")
    (tmp_path / "bad.scen").write_text("version 1\n0 x.map 8 5 0 2 7 2 9.0\n0 x 8 5\n")
    with pytest.raises(error, match=message):
        call()


def test_a_directory_without_problems_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected the directories envs and models of dynobench"):
        read_dynobench(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"expected files CaseN\.csv"):
        read_tpcap(tmp_path)


def write_case(folder, number, start, goal, polygons):
    sizes = [len(polygon) for polygon in polygons]
    words = [*start, *goal, len(polygons), *sizes, *np.concatenate(polygons).ravel().tolist()]
    (folder / f"Case{number}.csv").write_text(",".join(map(str, words)) + "\n")


def parked(x_min, y_min, x_max, y_max):
    return [(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]


def test_a_case_of_tpcap_is_a_car_that_parks(tmp_path):
    walls = [parked(-12, -5, -2, 0), parked(2, -5, 10, 0)]
    write_case(tmp_path, 10, (-6, 4, 0), (0, -2.5, math.pi / 2), walls)
    write_case(tmp_path, 2, (0, 0, 2 * math.pi), (5, 0, 0), [[(2, 3), (4, 3), (4, 5), (3, 3.5), (2, 5)]])
    second, first = read_tpcap(tmp_path)
    assert [second.name, first.name] == ["tpcap-2", "tpcap-10"]
    assert first.robot.model == "dynamic_car" and first.horizon is None and first.start_state[2] == 0.0
    assert first.arena == pytest.approx((-14.0, -10.5, 8.0, 12.0))
    assert first.outline.tolist() == [pytest.approx([-0.929, 3.76, 0.971, 0.0, 0])]
    assert len(second.obstacles) == 2  # since the polygon is not convex
    optimum = find_optimum(first, "low")
    assert optimum.success and optimum.driving_modes[-1] == "backward"


def test_the_table_of_tpcap(tmp_path, capsys):
    write_case(tmp_path, 1, (0, 0, 0), (9, 1, 0), [parked(3, -9, 5, -6)])
    out = tmp_path / "table.json"
    assert main(["benchmark", "tpcap", str(tmp_path), "--tol", "0.2", "--json", str(out)]) == 0
    assert "tpcap-1" in capsys.readouterr().out
    row = json.loads(out.read_text())["tpcap-1"]
    straight = 9 / 2.5 + 2.5 / 1.0  # with at most 2.5 m/s and 1 m/s^2
    assert straight < row["leapnav"] < 1.1 * straight and row["clearance"] > 0


@pytest.mark.parametrize("text", ["", "1,2,3", "0,0,0,5,0,0,1,4,1,1,2,2,3,3\n", "a,b\n"])
def test_an_invalid_case_of_tpcap_is_named(text, tmp_path):
    (tmp_path / "Case1.csv").write_text(text)
    with pytest.raises(ValueError, match=r"Case1\.csv: expected"):
        read_tpcap(tmp_path)


@pytest.mark.parametrize("seed", range(20))
def test_convex_parts_cover_a_polygon_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    star = rng.uniform(0.5, 2.0, (9, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    parts = convex_parts(star[:: rng.choice((-1, 1))])
    for part in parts:
        Polygon(vertices=tuple(map(tuple, part.tolist())))  # strictly convex
    assert sum(map(area, parts)) == pytest.approx(area(star), rel=1e-9)


def area(vertices):
    x, y = np.transpose(vertices)
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
