"""Occupancy grids of ROS, from small files as map savers write them."""

import warnings

import numpy as np
import pytest
from PIL import Image

from leapnav.cli import main
from leapnav.envs import Scenario
from leapnav.envs.field.clearance import clearance
from leapnav.envs.scenarios.files import read_scenarios
from leapnav.envs.worlds.ros_map import read_ros_map, sample_on_map
from leapnav.experts import find_optimum


def write_ros_map(folder, gray, **fields):
    """Write an occupancy grid as the map saver of ROS does."""
    height, width = gray.shape
    (folder / "map.pgm").write_bytes(
        b"P5\n# made for a test\n%d %d\n255\n" % (width, height) + gray.astype("u1").tobytes()
    )
    known = {"image": "map.pgm", "resolution": 0.25, "origin": [-2.0, -1.0, 0.0], "negate": 0, **fields}
    lines = [f"{name}: {value}" for name, value in known.items() if value is not None]
    (folder / "map.yaml").write_text("\n".join(lines) + "\n")
    return folder / "map.yaml"


def rooms_in_gray():
    """A map of 40 x 30 cells: two rooms with a door, black walls, and an unknown corner."""
    gray = np.full((30, 40), 254)
    gray[[0, -1]] = gray[:, [0, -1]] = 0
    gray[:, 20] = 0
    gray[12:18, 20] = 254
    gray[1:6, 1:6] = 205
    return gray


def test_a_map_of_ros_has_scenarios_between_its_walls(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_ros_map(tmp_path, rooms_in_gray())
    grid = read_ros_map(path)
    assert grid.arena == (-2.0, -1.0, 8.0, 6.5) and grid.blocked[3, 3] and not grid.blocked[14, 20]
    assert not read_ros_map(path, unknown="free").blocked[3, 3]
    inverted = write_ros_map(tmp_path, 255 - rooms_in_gray(), negate=1, occupied_thresh=0.65, free_thresh=0.196)
    assert (read_ros_map(inverted).blocked == grid.blocked).all()
    assert len(grid.obstacles()) < 12
    assert main(["worlds", "import", "ros-map", "map.yaml", "--count", "3", "--out", "lab"]) == 0
    scenarios = read_scenarios("lab")
    assert [scenario.name for scenario in scenarios] == ["map-0", "map-1", "map-2"]
    for scenario in scenarios:
        optimum = find_optimum(scenario)
        assert optimum.success and scenario.arena == grid.arena
        column, line = ((optimum.states[:, :2] - (-2.0, -1.0)) / 0.25).astype(int).T
        assert not grid.blocked[29 - line, column].any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"resolution": None}, "map.yaml: resolution: missing"),
        ({"resolution": -1}, "map.yaml: resolution: expected a number > 0, got -1"),
        ({"origin": "here"}, "map.yaml: origin: expected a list, got 'here'"),
        ({"mode": "raw"}, "map.yaml: mode: expected 'trinary' or 'scale', got 'raw'"),
        ({"image": "map.yaml"}, "map.yaml: not an image"),
        ({"image": "none.pgm"}, "none.pgm: no such file; it is the image of"),
        ({"free_thresh": "low"}, "map.yaml: free_thresh: expected a number, got 'low'"),
        ({"image": "[1"}, "map.yaml: not valid YAML"),
        ({"origin": "[.nan, 0, 0]"}, "map.yaml: origin: expected finite coordinates"),
        ({"origin": "[0, 0, .inf]"}, "map.yaml: origin: expected a finite yaw, got inf"),
        ({"negate": "maybe"}, "map.yaml: negate: expected True or False, got 'maybe'"),
        ({"negate": "2"}, "map.yaml: negate: expected True or False, got 2"),
        ({"occupied_thresh": 65}, "map.yaml: occupied_thresh: expected a number <= 1, got 65"),
    ],
)
def test_an_invalid_map_of_ros_is_named(fields, message, tmp_path):
    path = write_ros_map(tmp_path, rooms_in_gray(), **fields)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_ros_map(path)


def save_png(folder, array):
    Image.fromarray(array).save(folder / "map.png")
    return "map.png"


@pytest.mark.parametrize("suffix", ["pgm", "png"])
def test_a_map_of_16_bits_is_not_clipped(suffix, tmp_path):
    gray = np.array([[0, 1000], [40000, 65535]], dtype=np.uint16)
    path = write_ros_map(tmp_path, np.zeros((2, 2)), image=f"map.{suffix}", free_thresh=0.196)
    if suffix == "png":
        save_png(tmp_path, gray)
    else:
        (tmp_path / "map.pgm").write_bytes(b"P5\n2 2\n65535\n" + gray.astype(">u2").tobytes())
    assert read_ros_map(path).blocked.tolist() == [[True, True], [True, False]]
    assert read_ros_map(path, unknown="free").blocked.tolist() == [[True, True], [False, False]]


def test_the_gray_value_of_a_coloured_map_is_the_mean_of_its_channels(tmp_path):
    # The luminance of green is 0.59 and that of blue 0.11; the mean of both is 1/3, so the occupancy is 2/3.
    colors = np.array([[(0, 255, 0), (0, 0, 255), (255, 255, 255)]], dtype=np.uint8)
    path = write_ros_map(tmp_path, np.zeros((1, 3)), image=save_png(tmp_path, colors))
    assert read_ros_map(path, unknown="free").blocked.tolist() == [[True, True, False]]


def test_transparent_cells_are_unknown_in_the_mode_scale_and_averaged_in_the_mode_trinary(tmp_path):
    # White, transparent white, black, transparent black, and white that is half transparent.
    gray, opacity = [255, 255, 0, 0, 255], [255, 0, 255, 0, 128]
    image = save_png(tmp_path, np.array([[(g, g, g, a) for g, a in zip(gray, opacity, strict=True)]], dtype=np.uint8))
    scale = write_ros_map(tmp_path, np.zeros((1, 5)), image=image, mode="scale", free_thresh=0.196)
    assert read_ros_map(scale).blocked.tolist() == [[False, True, True, True, True]]
    assert read_ros_map(scale, unknown="free").blocked.tolist() == [[False, False, True, False, False]]
    # The means are 1, 3/4, 1/4, 0 and 7/8: free, unknown, occupied, occupied and free.
    trinary = write_ros_map(tmp_path, np.zeros((1, 5)), image=image, free_thresh=0.196)
    assert read_ros_map(trinary).blocked.tolist() == [[False, True, True, True, False]]
    assert read_ros_map(trinary, unknown="free").blocked.tolist() == [[False, False, True, True, False]]


def test_unknown_cells_below_the_free_threshold_are_reported(tmp_path, capsys):
    path = write_ros_map(tmp_path, rooms_in_gray(), free_thresh=0.25)
    with pytest.warns(UserWarning, match=r"free_thresh: 25 cells with the gray value 205.* are read as free"):
        assert not read_ros_map(path).blocked[3, 3]
    assert main(["worlds", "import", "ros-map", str(path), "--count", "1", "--out", str(tmp_path / "out")]) == 0
    error = capsys.readouterr().err
    assert error.startswith(f"leapnav: warning: {path}: free_thresh: 25 cells") and error.count("\n") == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_ros_map(path, unknown="free")
        assert read_ros_map(write_ros_map(tmp_path, rooms_in_gray(), free_thresh=0.196)).blocked[3, 3]


def test_a_cell_above_both_thresholds_is_occupied(tmp_path):
    path = write_ros_map(tmp_path, np.array([[100, 250]]), occupied_thresh=0.3, free_thresh=0.9)
    assert read_ros_map(path).blocked.tolist() == [[True, False]]


@pytest.mark.parametrize(
    "fields",
    [
        {"resolution": "25e-2"},  # a text in YAML 1.1, which PyYAML implements
        {"resolution": "'0.25'", "negate": "'0'"},
        {"negate": "false"},
        {"origin": "[-2, -1e0, 6.283185307179586]"},
        {"origin": "[-2.0, -1.0, -6.283185]"},
    ],
)
def test_numbers_are_read_as_ros_reads_them(fields, tmp_path):
    expected = read_ros_map(write_ros_map(tmp_path, rooms_in_gray()))
    grid = read_ros_map(write_ros_map(tmp_path, rooms_in_gray(), **fields))
    assert grid.arena == expected.arena and (grid.blocked == expected.blocked).all()


@pytest.mark.parametrize("yaw", [".nan", "nan", "-nan"])
def test_a_yaw_that_is_not_a_number_is_read_as_zero_with_a_warning(yaw, tmp_path):
    path = write_ros_map(tmp_path, rooms_in_gray(), origin=f"[-2.0, -1.0, {yaw}]")
    with pytest.warns(UserWarning, match="origin: the yaw is not a number and is read as 0"):
        assert read_ros_map(path).arena == (-2.0, -1.0, 8.0, 6.5)


@pytest.mark.parametrize("yaw", [0.5, -2.0, 3.0, np.pi / 2, -0.001])
def test_a_rotated_map_is_the_map_in_another_frame(yaw, tmp_path):
    """Its walls are where the rotation puts them, and nothing outside of it can be reached."""
    plain = read_ros_map(write_ros_map(tmp_path, rooms_in_gray()))
    turned = read_ros_map(write_ros_map(tmp_path, rooms_in_gray(), origin=[-2.0, -1.0, yaw]))
    plain_field, field = field_of(plain, (0.0, 2.0, 0.0)), field_of(turned, (*placed(2.0, 3.0, yaw), 0.0))
    rng = np.random.default_rng(0)
    for x, y in rng.uniform((0, 0), (10, 7.5), (200, 2)):
        expected, found = clearance(x - 2, y - 1, plain_field)[0], clearance(*placed(x, y, yaw), field)[0]
        assert found == pytest.approx(expected, abs=1e-9) if expected > 0.0 else found <= 1e-9
    x_min, y_min, x_max, y_max = turned.arena
    for x, y in rng.uniform((x_min, y_min), (x_max, y_max), (300, 2)):
        dx, dy = x + 2, y + 1
        inside = np.array([np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx])
        if (inside < 0).any() or (inside > (10, 7.5)).any():
            assert clearance(x, y, field)[0] <= 1e-9


def field_of(grid, start):
    """The obstacle field of a map."""
    walls = [{"polygon": {"vertices": one.polygon.vertices}} for one in grid.obstacles()]
    fields = {"arena": grid.arena, "start": start, "goal": start, "horizon": 1.0, "obstacles": walls}
    return Scenario.from_dict(fields).field


def placed(x, y, yaw):
    """The position in the world of a point of the map."""
    return -2.0 + np.cos(yaw) * x - np.sin(yaw) * y, -1.0 + np.sin(yaw) * x + np.cos(yaw) * y


def test_scenarios_on_a_rotated_map_have_optima(tmp_path):
    grid = read_ros_map(write_ros_map(tmp_path, rooms_in_gray(), origin=[-2.0, -1.0, 0.7]))
    for scenario in sample_on_map(grid, 2, seed=5):
        assert find_optimum(scenario, "medium").success
