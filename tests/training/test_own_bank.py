"""A bank of scenarios with a robot of their own, from the rollout to the report, without the robot being named."""

import json
import warnings
from pathlib import Path

import gymnasium as gym
import pytest
from stable_baselines3 import PPO

from leapnav.cli import main
from leapnav.envs import NavigateEnv, ScenarioBank
from leapnav.envs.robots import Unicycle
from leapnav.envs.scenarios.families import sample_scenario, task_of
from leapnav.envs.scenarios.scenario import check_robot
from leapnav.experts import build_bank, find_optimum, rollout
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.training import (
    BCConfig,
    CloningConfig,
    DAggerRunConfig,
    Dataset,
    behaviour_clone,
    compare,
    evaluate,
    load_policy,
    make_policy,
    make_vec_env,
    network,
    save_policy,
    train_bc,
    train_dagger,
    warm_start,
)
from leapnav.training.policies.files import read_description, trained_robot
from leapnav.training.runs.checks import warn_of_family
from leapnav.training.runs.run import Run

WIDE = Unicycle(radius=0.3)
SMALL = ["--hidden", "16", "16", "--lidar-beams", "8", "--evaluation-scenarios", "2", "--observation", "lidar"]


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    path = tmp_path_factory.mktemp("bank") / "wide.bank"
    build_bank("open", 4, path, robot=WIDE, horizon="free", seed=5, progress=False)
    return str(path)


def test_the_task_of_a_bank_is_that_of_its_scenarios(bank):
    assert task_of(bank) == task_of(bank, "unicycle", "free", "cost") == (WIDE, "free", "cost")
    assert task_of("open") == (Unicycle(), "fixed", "cost") and task_of("open", "car")[0].model == "car"
    assert task_of(bank, Unicycle())[0] == Unicycle()  # given with its parameters
    assert sample_scenario(bank, 3).robot == WIDE
    with pytest.raises(ValueError, match=r"robot: expected that of the scenarios of .*radius=0.3.*got .*radius=0.25"):
        sample_scenario(bank, 3, Unicycle())
    with pytest.raises(ValueError, match=r"horizon: expected that of the scenarios of .*'free', got 'fixed'"):
        sample_scenario(bank, 3, horizon="fixed")
    env = NavigateEnv(bank)
    env.reset(seed=0)
    assert env.scenario.robot == WIDE and env.settings.horizon == "free"
    assert gym.make("leapnav/Navigate-v0", family=bank).unwrapped.settings.horizon == "free"


def test_the_settings_of_a_run_follow_the_bank(bank, tmp_path):
    narrow = BCConfig(out=tmp_path, family=bank, robot=Unicycle())
    assert check_robot(narrow.task["robot"]) == Unicycle()  # which the bank then refuses
    config = DAggerRunConfig(out=tmp_path, family=bank)
    assert config.task == {"robot": "unicycle", "horizon": "free", "obstacles": "cost"}
    assert config.environment["horizon"] == "free" and config.environment["previous_action"]
    assert BCConfig(out=tmp_path).task == {"robot": "unicycle", "horizon": "fixed", "obstacles": "cost"}


@pytest.mark.usefixtures("coarse_decisions")
def test_rollout_training_evaluation_and_report_need_no_robot(bank, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "--family", bank, "--count", "4", "--out", "demos", "--workers", "1"]) == 0
    assert {demonstration.scenario.robot for demonstration in load_demonstrations("demos")} == {WIDE}
    train = ["train", "bc", "--family", bank, "--demos", "demos", "--out", "clone", "--cloning.epochs", "1"]
    assert main([*train, *SMALL]) == 0
    few = ["--dagger.rounds", "1", "--dagger.max-episodes", "2", "--dagger.max-failures", "1", "--dagger.lead", "0.5"]
    train = ["train", "dagger", "--family", bank, "--demos", "demos", "--out", "dagger", "--cloning.epochs", "1"]
    assert main([*train, *few, *SMALL]) == 0
    lines = [json.loads(line) for line in Path("dagger/evaluations.jsonl").read_text().splitlines()]
    assert [line["split"] for line in lines] == ["train", "test"]
    capsys.readouterr()
    assert main(["evaluate", "clone", "--html", "page.html", "--count", "2", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "2 scenarios" in printed and "open: clone trained in these scenarios" in printed
    assert "open: clone trained in these scenarios." in Path("page.html").read_text()
    assert main(["evaluate", "clone", "--family", "open", "--count", "2", "--workers", "1"]) == 0
    assert "open: clone trained with another robot: radius 0.3, here 0.25" in capsys.readouterr().out
    assert main(["watch", "--policy", "clone", "--video", "clone.mp4", "--episodes", "1", "--index", "1"]) == 0
    assert ScenarioBank(bank)[1].name in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"horizon: clone was trained with 'free', .* has 'fixed'"):
        compare({"clone": "clone"}, ScenarioBank.shipped("open", "test"), progress=False)
    (compared,) = compare({"clone": "clone"}, bank, progress=False).runs["clone"]
    assert [e.cost for e in evaluate("clone", bank, progress=False)] == [e.cost for e in compared]
    assert main(["rollout", "--policy", "clone", "--family", bank, "--count", "1", "--out", "driven"]) == 0


def test_a_robot_is_given_as_json_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    build = ["bank", "build", "--family", "open", "--count", "1", "--workers", "1", "--out", "own.bank", "--robot"]
    assert main([*build, WIDE.model_dump_json(exclude_none=True)]) == 0
    assert ScenarioBank("own.bank").robot == WIDE
    assert main([*build, '{"model":']) == 2
    assert "robot: not valid JSON" in capsys.readouterr().err


@pytest.mark.usefixtures("coarse_decisions")
def test_a_robot_with_other_parameters_is_trained_and_evaluated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("leapnav.training.runs.run.BANK_COUNT", 2)
    config = BCConfig(out=tmp_path, family="open", robot={"model": "unicycle", "radius": 0.3})
    text = WIDE.model_dump_json(exclude_none=True)
    assert config.robot == BCConfig(out=tmp_path, robot=WIDE).robot == config.task["robot"] == text
    assert BCConfig(out=tmp_path, robot=Unicycle()).task["robot"] == "unicycle"
    assert BCConfig(out=tmp_path, robot='{"radius": 0.3, "model": "unicycle"}').robot == text
    once = ["--cloning.epochs", "1"]
    assert (
        main(["train", "bc", "--family", "open", "--robot", text, "--scenarios", "3", "--out", "clone", *SMALL, *once])
        == 0
    )
    assert {one.scenario.robot for one in load_demonstrations("clone/demonstrations")} == {WIDE}
    assert ScenarioBank("clone/test.bank").robot == ScenarioBank("clone/train.bank").robot == WIDE
    few = ["--total-timesteps", "64", "--n-envs", "2", "--n-steps", "32"]
    train = ["train", "ppo", "--family", "open", "--robot", text, "--warm-start", "clone", "--out", "ppo", *few]
    assert main([*train, *SMALL, *once]) == 0
    config = DAggerRunConfig(out=tmp_path / "dagger", family="open", robot=WIDE, demos=(tmp_path / "clone",))
    assert NavigateEnv(**config.fresh_environment).source.robot == WIDE
    capsys.readouterr()
    assert main(["evaluate", "clone", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert f"Scenarios: {tmp_path / 'clone' / 'test.bank'}" in printed and "another robot" not in printed
    assert main(["evaluate", "clone", "--workers", "1", "--count", "1", "--robot", "unicycle"]) == 0
    printed = capsys.readouterr().out
    assert "Scenarios: open-test.bank" in printed and "another robot: radius 0.3, here 0.25" in printed
    with pytest.warns(UserWarning, match="clone: trained with another robot: radius 0.3, here 0.25"):
        evaluate("clone", "open", count=1, progress=False)
    assert main(["bank", "show", "clone/test.bank"]) == 0
    assert text in capsys.readouterr().out
    assert main(["evaluate", "clone", "--workers", "1", "--robot", text]) == 0
    assert main(["evaluate", "clone", "--robot", text.replace("0.3", "0.4")]) == 2
    assert "build a bank of its scenarios" in capsys.readouterr().err
    with pytest.warns(UserWarning, match="policy: clone was trained in open; the run is in slalom"):
        warn_of_family("policy", Path("clone"), DAggerRunConfig(out=tmp_path, family="slalom"))
    PPO("MlpPolicy", gym.make("leapnav/Navigate-v0"), n_steps=4, batch_size=4).save("model.zip")
    warn_of_family("policy", Path("model.zip"), DAggerRunConfig(out=tmp_path, family="slalom"))  # says no family
    assert main(["evaluate", "expert", "--robot", text]) == 2
    assert "build a bank of its scenarios" in capsys.readouterr().err


def of_any_radius(rng):
    """Sample a whole scenario with a robot of its own."""
    robot = Unicycle(radius=float(rng.uniform(0.2, 0.3)))
    return sample_scenario("open", int(rng.integers(1000)), robot)


def test_no_robot_is_named_as_that_of_the_training_if_each_scenario_has_another(tmp_path):
    for family, robot in (("open", Unicycle()), (f"{__name__}:of_any_radius", None)):
        run = Run("bc", BCConfig(out=tmp_path / (robot or "any").__class__.__name__, family=family, hidden=(4,)))
        env = NavigateEnv(**run.config.fresh_environment)
        run.save_policy(make_policy(env.observation_space, env.action_space, hidden=(4,)))
        assert trained_robot(read_description(run.folder)) == robot
        with pytest.raises(FileExistsError, match="the directory of a training run"):
            save_policy(load_policy(run.folder), run.folder)


def test_banks_and_files_are_accepted_where_a_scenario_or_a_family_is(bank, tmp_path):
    stored, file = ScenarioBank(bank), tmp_path / "scenario.json"
    stored[0].to_json(file)
    cost = find_optimum(stored[0]).cost
    assert find_optimum(file).cost == find_optimum(str(file)).cost == find_optimum(stored[0].to_dict()).cost == cost
    summary = rollout(stored, 2, tmp_path / "demos", progress=False)
    assert summary.demonstrations == 2
    env = NavigateEnv(bank, lidar_beams=8)
    assert Dataset.of(tmp_path / "demos").observed(env).observations.shape[1] == env.observation_space.shape[0]
    # A rollout that has finished nothing does not block another one.
    with pytest.raises(ValueError, match="horizon: expected that of the scenarios"):
        rollout(stored, 2, tmp_path / "others", horizon="fixed", progress=False)
    rollout(stored, 2, tmp_path / "others", progress=False)


def test_demonstrations_of_another_robot_or_horizon_are_refused(bank, tmp_path):
    rollout(ScenarioBank(bank), 2, tmp_path / "wide", progress=False)
    rollout("open", 2, tmp_path / "open", progress=False)
    small = {"hidden": (4,), "lidar_beams": 4, "evaluation_scenarios": 1}

    def clone(family, demos, **others):
        train_bc(BCConfig(out=tmp_path / "run", family=family, demos=(tmp_path / demos,), **small, **others))

    with pytest.raises(ValueError, match=r"demos: expected a robot with radius 0\.25, got 0\.3"):
        clone("open", "wide")
    with pytest.raises(ValueError, match="demos: expected a robot with model 'car', got 'unicycle'"):
        clone("open", "open", robot="car")
    with pytest.raises(ValueError, match="demos: expected a free horizon, got a fixed one"):
        clone("open", "open", horizon="free")
    with pytest.raises(ValueError, match=r"demos: expected a robot with radius 0\.3, got 0\.25"):
        clone("open", "open", robot={"model": "unicycle", "radius": 0.3})
    with pytest.raises(ValueError, match=r"robot\.radius: .* got -1"):
        clone("open", "open", robot={"model": "unicycle", "radius": -1})
    assert not (tmp_path / "run").exists()
    with pytest.warns(UserWarning, match="dataset: demonstrations of open, here clutter"):
        clone("clutter", "open", cloning=CloningConfig(epochs=1))
    with pytest.raises(ValueError, match="a run of BC, not of DAGGER; resume it by `leapnav train bc`"):
        train_dagger(DAggerRunConfig(out=tmp_path / "run", resume=True))


def test_samples_and_policies_of_another_robot_or_family_are_named_in_python(tmp_path):
    rollout("open", 2, tmp_path / "wide", robot=WIDE, progress=False)
    model = PPO("MlpPolicy", make_vec_env(n_envs=1, family="clutter"), policy_kwargs=network((4,)))
    quick = CloningConfig(epochs=1)
    with pytest.warns(UserWarning, match="dataset: demonstrations of another robot: radius 0.3, here 0.25"):
        behaviour_clone(model, tmp_path / "wide", quick, progress=False)
    with pytest.warns(UserWarning, match=r"dataset|validation_share") as caught:
        warm_start(model, tmp_path / "wide", cloning=quick, progress=False)
    texts = [str(one.message) for one in caught]
    assert [text.partition(":")[0] for text in texts] == ["dataset", "dataset", "validation_share"]
    assert texts[1] == "dataset: demonstrations of open, here clutter"
    assert "0.05 of 2 obstacle courses is less than one" in texts[2]
    assert {one.filename for one in caught[:2]} == {__file__}
    wide = make_vec_env(n_envs=1, family="open", split="fresh", robot=WIDE)
    description = {"robot": WIDE.model_dump(mode="json")}
    save_policy(PPO("MlpPolicy", wide, policy_kwargs=network((4,))), tmp_path / "policy", training=description)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_policy(tmp_path / "policy", wide)
    with pytest.warns(UserWarning, match="trained with another robot: radius 0.3, here 0.25"):
        load_policy(tmp_path / "policy", make_vec_env(n_envs=1, family="open"))
