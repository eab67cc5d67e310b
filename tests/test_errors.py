# ruff: noqa: E501
"""What the command line says to bad input: the words, and the one line that is printed. Nothing is written."""

import json

import pytest
from helpers import scenario_fields

from leapnav.cli import main

FILES = {
    "good.json": scenario_fields(),
    "empty.json": "",
    "list.json": [1],
    "text.json": "{name: 1}",
    "horizon.json": scenario_fields(horizon=-1),
    "nan.json": scenario_fields(horizon=float("nan")),
    "unknown.json": scenario_fields(speed=3),
    "inside.json": scenario_fields(goal=[4, 4.5, 0]),
    "wall.json": scenario_fields(start=[0.1, 5, 0]),
    "star.json": scenario_fields(obstacles=[{"polygon": {"vertices": [[0, 0], [1, 1], [1, 0], [0, 1]]}}]),
    "two.json": scenario_fields(obstacles=[{"polygon": {"vertices": [[3, 3], [4, 3]]}}]),
    "both.json": scenario_fields(obstacles=[{}]),
    "arena.json": scenario_fields(arena=[5, 0, 0, 5]),
    "twice.json": '{"name": "a", "name": "b"}',
    "missing.json": {"name": "m"},
    "radius.json": scenario_fields(robot={"radius": "big"}),
    "model.json": scenario_fields(robot={"model": "tank"}),
    "data.bank": "no bank",
}
TABLE = """
solve nowhere.json
    nowhere.json: No such file or directory
solve empty
    empty: Is a directory
solve empty.json
    scenario empty.json: not valid JSON: Expecting value: line 1 column 1 (char 0)
solve list.json
    a scenario is a JSON object, got [1]
solve text.json
    scenario text.json: not valid JSON: Expecting property name enclosed in double quotes: line 1 column 2 (char 1)
solve horizon.json
    Scenario 'small': horizon: input should be greater than 0, got -1
solve nan.json
    Scenario 'small': horizon: input should be a finite number, got nan
solve unknown.json
    Scenario 'small': speed: extra inputs are not permitted, got 3
solve inside.json
    Scenario 'small': goal: (4, 4.5) is inside obstacles[0] (clearance -1.05 m)
solve wall.json
    Scenario 'small': start: (0.1, 5) is inside the arena wall (clearance -0.15 m)
solve star.json
    Scenario 'small': obstacles[0].polygon.vertices: the polygon is not strictly convex; write a non-convex obstacle as several convex ones, got ((0, 0), (1, 1), (1, 0), (0, 1))
solve two.json
    Scenario 'small': obstacles[0].polygon.vertices: a polygon needs at least 3 vertices, this one has 2, got ((3, 3), (4, 3))
solve both.json
    Scenario 'small': obstacles[0]: an obstacle is exactly one of 'circle' or 'polygon', got {}
solve arena.json
    Scenario 'small': arena: the arena needs x_min < x_max and y_min < y_max, got (5, 0, 0, 5)
solve twice.json
    scenario: name: the key appears more than once
solve missing.json
    Scenario 'm': arena: field required (and 3 more)
solve radius.json
    Scenario 'small': robot.radius: input should be a valid number, got 'big'
solve model.json
    Scenario 'small': robot.model: input should be 'unicycle', got 'tank'
solve good.json --plot path.gif
    path.gif: expected a name that ends in .png, .pdf, .svg
solve good.json --plot nowhere/path.png
    nowhere/path.png: its folder does not exist
solve good.json --json empty
    empty: is a folder
solve good.json --json nowhere/out.json
    nowhere/out.json: its folder does not exist
bank build --family moon --out x.bank
    family: expected one of open, clutter, polygons, rooms, slalom, got 'moon'
bank build --count 0 --out x.bank
    count: expected at least 1, got 0
bank build --seed -1 --out x.bank
    seed: expected at least 0, got -1
bank build --workers 0 --out x.bank
    workers: expected at least 1, got 0
bank build --out nowhere/x.bank
    nowhere: no such folder
bank build --out data.bank
    {folder}/data.bank: no scenario bank, or damaged: Unable to synchronously open file (file signature not found)
bank show nowhere.bank
    {folder}/nowhere.bank: no such bank
bank show data.bank
    {folder}/data.bank: no scenario bank, or damaged: Unable to synchronously open file (file signature not found)
bank show rooms-test --count -1
    count: expected at least 0, got -1
bank show rooms-test --plot sheet.txt
    sheet.txt: expected a name that ends in .png, .pdf, .svg
rollout --family moon --out demos
    family: expected one of open, clutter, polygons, rooms, slalom or all, got 'moon'
rollout --count 0 --out demos
    count: expected at least 1, got 0
rollout --seed 1 --out demos
    seed: expected at least 2, got 1
rollout --recoveries -1 --out demos
    recoveries: expected at least 0, got -1
rollout --noise -0.1 --out demos
    noise: expected at least 0.0, got -0.1
rollout --noise nan --out demos
    noise: expected at least 0.0, got nan
rollout --workers 0 --out demos
    workers: expected at least 1, got 0
rollout --check --out empty
    empty: expected one Minari dataset, found 0
rollout --check --out nowhere
    nowhere: expected one Minari dataset, found 0
train bc --family moon --out run
    family: expected one of open, clutter, polygons, rooms, slalom or all, got 'moon'
train bc --demos nowhere --out run
    nowhere: expected one Minari dataset, found 0
train bc --hidden 0 --out run
    hidden: expected widths of at least 1, got (0,)
train bc --seed -1 --out run
    seed: expected a number from 0 to 2^32 - 1, got -1
train bc --lidar-beams 7 --out run
    lidar_beams: expected an even number from 2 on, got 7
train bc --cloning.epochs 0 --out run
    cloning.epochs: expected a positive number, got 0
train bc --cloning.learning-rate -1 --out run
    cloning.learning_rate: expected a positive number, got -1.0
train bc --cloning.validation-share 1 --out run
    cloning.validation_share: expected a number in [0, 1), got 1.0
train bc --resume --out nowhere
    nowhere/config.json: there is no run in this folder
train dagger --dagger.rounds 0 --out run
    dagger.rounds: expected at least 1, got 0
train dagger --policy nowhere --out run
    nowhere/policy.json: No such file or directory
train ppo --total-timesteps 0 --out run
    total_timesteps: expected at least 1, got 0
train ppo --warm-start nowhere --out run
    warm_start: nowhere: no such folder of demonstrations or of a policy
train ppo --divergence 0.5 --out run
    divergence: without a clone there is nothing to diverge from, got 0.5
train ppo --gamma 2 --out run
    gamma: expected a number in [0, 1], got 2.0
train ppo --penalty -1 --out run
    penalty: expected a number >= 0, got -1.0
train sac --demonstrations 1 --out run
    demonstrations: expected a number in [0, 1), got 1.0
train sac --ent-coef loud --out run
    ent_coef: expected a number >= 0, or auto or auto_NUMBER for SAC, got 'loud'
evaluate nowhere
    nowhere/policy.json: No such file or directory
evaluate moon
    moon/policy.json: No such file or directory
evaluate expert --family moon
    family: expected one of open, clutter, polygons, rooms, slalom or all, got 'moon'
evaluate expert --count 0
    count: expected at least 1, got 0
evaluate expert expert
    policies: expert: named more than once
evaluate expert --bank nowhere.bank
    {folder}/nowhere.bank: no such bank
evaluate expert --bank data.bank
    {folder}/data.bank: no scenario bank, or damaged: Unable to synchronously open file (file signature not found)
evaluate empty
    empty/policy.json: No such file or directory
evaluate expert --plot scores.txt
    scores.txt: expected a name that ends in .png, .pdf, .svg
report nowhere
    nowhere/policy.json: No such file or directory
report empty
    empty/policy.json: No such file or directory
report nowhere --out report.txt
    report.txt: expected a name that ends in .html
watch --episodes 0 --video x.mp4
    episodes: expected at least 1, got 0
watch --family moon --video x.mp4
    family: expected one of open, clutter, polygons, rooms, slalom or all, got 'moon'
watch --policy nowhere --video x.mp4
    nowhere/policy.json: No such file or directory
watch --index 3 --split fresh --video x.mp4
    index: a newly drawn scenario has no number, got 3
watch --index 200 --video x.mp4
    index: the bank has scenarios 0 to 199, got 200 to 202
watch --video x.gif
    x.gif: expected a name that ends in .mp4
watch --disturbance -1 --video x.mp4
    disturbance: expected a number >= 0, got -1.0
play --port 65536 --no-browser
    port: expected 0 to 65535, got 65536
play --scenario nowhere.json --no-browser
    nowhere.json: No such file or directory
play --scenario horizon.json --no-browser
    Scenario 'small': horizon: input should be greater than 0, got -1
play --policies nowhere --no-browser
    nowhere/policy.json: No such file or directory
doctor --json nowhere/x.json
    nowhere/x.json: its folder does not exist
"""
LINES = TABLE.strip().splitlines()
ROWS = [(words, line.strip()) for words, line in zip(LINES[::2], LINES[1::2], strict=True)]


@pytest.mark.parametrize(("words", "line"), ROWS, ids=[words for words, _ in ROWS])
def test_the_line_that_is_printed(words, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for name, content in FILES.items():
        (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    before = sorted(tmp_path.rglob("*"))
    assert main(words.split()) == 2
    assert capsys.readouterr().err == f"leapnav: {line.replace('{folder}', str(tmp_path))}\n"
    assert sorted(tmp_path.rglob("*")) == before
