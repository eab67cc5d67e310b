"""The server of `leapnav play`, by requests."""

import socket
from functools import partial
from typing import ClassVar

import numpy as np
import pytest
from play_helpers import SCENARIO, ask_server, fields, served

from leapnav.cli import main
from leapnav.commands.play import Play
from leapnav.envs import Capsule, Circle, Scenario, Shape
from leapnav.envs.scenarios.families import FAMILIES
from leapnav.envs.shapes import register
from leapnav.envs.utils import colors
from leapnav.envs.utils.records import Point
from leapnav.experts import find_optimum, find_reached_optimum
from leapnav.play.server import MAX_REQUEST_SIZE, SCRIPTS


@pytest.fixture(scope="module")
def port():
    with served() as port:
        yield port


@pytest.fixture
def ask(port):
    return partial(ask_server, port)


def test_the_page_begins_with_its_scenario(ask):
    status, initial = ask("/initial")
    assert status == 200 and initial["scenario"] == SCENARIO.to_dict() and initial["policies"] == ["open"]
    assert initial["families"] == list(FAMILIES)
    for path in ("/", "/page.css", *(f"/{name}" for name in SCRIPTS)):
        status, content = ask(path)
        assert status == 200 and len(content) > 1000


def test_the_colours_of_the_page_are_those_of_the_package(ask):
    _, initial = ask("/initial")
    assert initial["colors"]["optimum"] == colors.OPTIMUM
    assert tuple(initial["colors"]["alternatives"]) == colors.ALTERNATIVES
    for name in SCRIPTS:
        assert b'"#' not in ask(f"/{name}")[1].replace(b'"#${', b"")  # no other list of colours


def test_scenarios_of_the_banks(ask):
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


class Dumbbell(Shape):
    """A capsule that connects two discs."""

    kind: ClassVar = "dumbbell"

    ends: tuple[Point, Point]

    def parts(self):
        a, b = self.ends
        return Circle(center=a, radius=0.5), Circle(center=b, radius=0.5), Capsule(start=a, end=b, radius=0.2)


def test_the_parts_of_a_shape_that_the_page_does_not_know_are_sent(ask):
    register(Dumbbell)
    status, found = ask("/parts", {"obstacle": {"dumbbell": {"ends": [[1, 1], [2, 1]]}}})
    assert status == 200
    assert found["parts"] == [
        {"circle": {"center": [1, 1], "radius": 0.5}},
        {"circle": {"center": [2, 1], "radius": 0.5}},
        {"capsule": {"start": [1, 1], "end": [2, 1], "radius": 0.2}},
    ]
    assert ask("/parts", {"obstacle": {"moon": {}}})[0] == 400


def test_alternatives_have_their_controls_and_costates(ask):
    scenario = Scenario.from_dict(fields(obstacles=[{"circle": {"center": [4, 2.6], "radius": 0.5}}]))
    _, found = ask("/search", {"scenario": scenario.to_dict()})
    optimum = find_optimum(scenario)
    assert len(found["alternatives"]) == len(optimum.alternatives) > 0
    for shown, other in zip(found["alternatives"], optimum.alternatives, strict=True):
        states, controls, costates = other.evaluate(np.array(shown["times"]))
        np.testing.assert_allclose(shown["states"], states[:, :3], atol=1e-6)
        np.testing.assert_allclose(shown["controls"], controls, atol=1e-6)
        np.testing.assert_allclose(shown["costates"], costates, atol=1e-6)
        assert len(shown["clearances"]) == len(shown["hamiltonian"]) == len(shown["times"])
    _, found = ask("/follow", {"scenario": scenario.to_dict(), "previous": None})
    assert all("controls" not in other for other in found["alternatives"])  # a short message while the user drags


def test_a_horizon_that_is_too_short_comes_with_one_that_suffices(ask):
    _, found = ask("/search", {"scenario": fields(horizon=2)})
    assert found["status"] == "HORIZON_TOO_SHORT" and 3 <= found["needed_horizon"] < 4  # 6 m at 2 m/s
    _, found = ask("/search", {"scenario": fields(horizon=found["needed_horizon"])})
    assert found["success"] and "needed_horizon" not in found


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
    assert found["regret"] == pytest.approx(regret_of(fields(obstacles=[]), found))
    status, found = ask("/drive", {"scenario": fields(), "policy": "../../somewhere"})
    assert (status, found["error"]) == (400, "policy: expected one of open, got '../../somewhere'")


def regret_of(scenario, episode):
    reached = find_reached_optimum(Scenario.from_dict(scenario), episode["states"][-1], episode["cost"])
    return (episode["cost"] - reached.cost) / reached.cost


def driven(ask, scenario, commands):
    """The episode after the commands of a person."""
    status, started = ask("/driving/start", {"scenario": scenario})
    assert status == 200 and started["states"] == [scenario["start"]] and started["period"] == 0.05
    size, states, done = started["max_commands"], list(started["states"]), False
    for k in range(0, len(commands), size):
        status, found = ask("/driving/step", {"id": started["id"], "commands": commands[k : k + size]})
        assert status == 200
        states, done = states + found["states"], found["done"]
    status, episode = ask("/driving/finish", {"id": started["id"]})
    assert status == 200 and episode["states"] == states and done != episode["stopped"]
    return episode


def test_a_person_s_episode_is_compared_with_the_optimum(ask):
    scenario = fields(horizon=7.02, obstacles=[])  # 6 m at 2 m/s; the last period is shorter
    speed = 6 / 7.02 / SCENARIO.robot.max_speed
    found = driven(ask, scenario, [[speed, 0]] * 141)
    assert found["success"] and not found["stopped"] and found["policy"] == "you" and found["missed"] is None
    assert found["states"][-1] == pytest.approx([7, 2.5, 0], abs=1e-3)
    assert found["regret"] == pytest.approx(regret_of(scenario, found)) and 0 <= found["regret"] < 0.01
    found = driven(ask, scenario, [[speed, 0.2 if k < 70 else -0.2] for k in range(141)])
    assert not found["success"] and found["regret"] is None and found["missed"].startswith("the goal by ")
    found = driven(ask, scenario, [[speed, 0.1 if k > 130 else 0] for k in range(141)])
    assert not found["success"] and found["missed"] == "the heading of the goal"
    found = driven(ask, scenario, [[-1, 0]] * 100)
    assert found["collision"] and found["regret"] is None and found["time"] < 1
    found = driven(ask, scenario, [[speed, 0]] * 10)
    assert found["stopped"] and not found["success"] and found["time"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        (None, "commands: expected 1 to 100 pairs of numbers, got NoneType"),
        ([], "commands: expected 1 to 100 pairs of numbers, got 0"),
        ([[0, 0]] * 101, "commands: expected 1 to 100 pairs of numbers, got 101"),
        ([[0, 0], [1.5, 0]], "commands[1]: expected two numbers from -1 to 1, got [1.5, 0]"),
        ([[0, float("nan")]], "commands[0]: expected two numbers from -1 to 1, got [0, nan]"),
        ([[0, "1"]], "commands[0]: expected two numbers from -1 to 1, got [0, '1']"),
        ([[0, 0, 0]], "commands[0]: expected two numbers from -1 to 1, got [0, 0, 0]"),
        ([0], "commands[0]: expected two numbers from -1 to 1, got 0"),
    ],
)
def test_commands_are_validated(commands, message, ask):
    _, started = ask("/driving/start", {"scenario": fields()})
    assert ask("/driving/step", {"id": started["id"], "commands": commands}) == (400, {"error": message})
    status, found = ask("/driving/step", {"id": "another", "commands": [[0, 0]]})
    assert status == 400 and found["error"].startswith("id: there is no such episode")


def test_lessons_are_served(ask):
    for name in ("methods", "conjugate"):
        status, lesson = ask("/lesson", {"lesson": name})
        assert status == 200, lesson
        assert all(step["title"] and step["text"] for step in lesson["steps"])
    assert ask("/lesson", {"lesson": "x"}) == (400, {"error": "lesson: expected one of methods, conjugate, got 'x'"})


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
        ({"scenario": {"name": "x"}}, "Scenario 'x': arena: "),
        ({"scenario": fields(goal=[4, 4.2, 0])}, "Scenario 'one disc': goal: (4, 4.2) is inside obstacles[0]"),
        ({"scenario": fields(horizon=0)}, "Scenario 'one disc': horizon: "),
        ({"scenario": fields(), "previous": 3}, "previous: expected a string, got 3"),
        ([], "expected a JSON object"),
    ],
)
def test_questions_are_validated_like_a_file(question, message, ask):
    status, found = ask("/follow", question)
    assert status == 400 and found["error"].startswith(message)


def test_a_file_with_headings_in_degrees_is_refused(ask):
    status, found = ask("/check", {"scenario": fields(goal=[7, 2.5, 90])})
    assert status == 400 and found["error"].endswith("in radians, at most 2 pi, got 90; did you mean 1.571?")


def test_invalid_requests_are_refused(ask):
    assert ask("/search", body="{")[0] == 400
    assert ask("/search", body="[" * 100_000)[0] == 400
    assert ask("/search", body=b"\xff\xfe")[0] == 400
    assert ask("/search", {"scenario": fields()}, headers={"Content-Type": "text/plain"})[0] == 415
    assert ask("/search", body=" " * (MAX_REQUEST_SIZE + 1))[0] == 413
    assert ask("/search")[0] == 405
    families = ", ".join(FAMILIES)
    for query, error in {
        "family=moon": f"family: expected one of {families}, got 'moon'",
        "family=antigravity:fly": f"family: expected one of {families}, got 'antigravity:fly'",
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
    _, found = ask("/driving/start", {"scenario": fields(horizon=1000)})
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
        (["--scenario", "missing.json"], "missing.json: "),
        (["--policies", "nowhere"], "nowhere"),
        (["--host", "no.such.host.invalid"], "host: expected an address of this machine, got 'no.such.host.invalid'"),
    ],
)
def test_bad_arguments_are_one_line(words, message, capsys):
    assert main(["play", "--no-browser", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_responses_are_not_delayed_by_nagle_s_algorithm():
    with Play(port=0)._listen() as listener:
        assert listener.proto == socket.IPPROTO_TCP  # only then does asyncio set TCP_NODELAY
        with socket.create_connection(listener.getsockname()):
            listener.accept()[0].close()


def test_a_port_in_use_is_reported(port, capsys):
    assert main(["play", "--no-browser", "--port", str(port)]) == 2
    assert capsys.readouterr().err == f"leapnav: port: {port} is in use; --port 0 selects a free one\n"
