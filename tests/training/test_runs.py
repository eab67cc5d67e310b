import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO

from leapnav.cli import main
from leapnav.experts.data.rollouts import rollout
from leapnav.training import Dataset, load_policy, make_policy, policy_environment, shipped_policies
from leapnav.training.config import (
    BCConfig,
    CloningConfig,
    DAggerConfig,
    DAggerRunConfig,
    PPOConfig,
    SACConfig,
    WarmStartConfig,
    read_config,
)
from leapnav.training.environments.vec_env import environment_seed
from leapnav.training.policies.actors import actor_parameters, copy_actor
from leapnav.training.policies.files import read_description
from leapnav.training.runs.imitation import train_bc, train_dagger
from leapnav.training.runs.reinforcement import _resolve_warm_start, make_training_env, train_ppo, train_sac
from leapnav.training.scoring.comparison import compare_policies, default_banks
from leapnav.training.scoring.html_report import write_report
from leapnav.training.scoring.policy_specs import load_policy_spec

QUICK = CloningConfig(epochs=3, batch_size=256)
COMMON = {"family": "open", "hidden": (16, 16), "observation": "lidar", "lidar_beams": 16, "evaluation_scenarios": 4}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "open"
    rollout("open", 12, out, seed=700, progress=False)
    return out


def bc(out, demos, **changes):
    return BCConfig(out=out, demos=(demos,), cloning=QUICK, **{**COMMON, **changes})


def ppo(out, **changes):
    settings = {"n_envs": 4, "n_steps": 64, "batch_size": 64, "n_epochs": 2, "total_timesteps": 1536, "seed": 3}
    every = {"evaluate_every": 512, "checkpoint_every": 512}
    return PPOConfig(out=out, **{**COMMON, **settings, **every, **changes})


def sac(out, **changes):
    settings = {"n_envs": 4, "batch_size": 32, "total_timesteps": 400, "learning_starts": 100, "buffer_size": 1000}
    every = {"evaluate_every": 200, "checkpoint_every": 100}
    return SACConfig(out=out, **{**COMMON, **settings, **every, **changes})


def weights(folder):
    return th.nn.utils.parameters_to_vector(load_policy(folder).parameters()).detach().numpy().tobytes()


def lines(folder):
    return [json.loads(line) for line in (folder / "evaluations.jsonl").read_text().splitlines()]


def test_a_run_leaves_its_configuration_policy_and_evaluations(demos, tmp_path, monkeypatch):
    monkeypatch.setattr("leapnav.training.runs.run.FINAL_SCENARIOS", None)  # all
    config = bc(tmp_path / "run", demos)
    evaluations = train_bc(config, progress=False)
    assert [len(e) for e in evaluations] == [200]
    found = lines(config.out)
    assert [line["final"] for line in found] == [False, False, False, True]
    assert found[-1]["open"]["success"] == evaluations[0].success
    assert read_config(config.out) == ("bc", config)
    record = json.loads((config.out / "config.json").read_text())
    assert record["versions"]["torch"] == th.__version__
    assert list((config.out / "tensorboard").glob("events*"))
    assert load_policy(config.out).observation_space.shape == (25,)


def test_a_run_directory_is_used_once_and_resumed_with_the_same_settings_only(demos, tmp_path):
    config = bc(tmp_path / "run", demos)
    train_bc(config, progress=False)
    with pytest.raises(FileExistsError, match="exists; use --resume to continue this run"):
        train_bc(config, progress=False)
    with pytest.raises(ValueError, match=r"seed: the run in .* has 0, got 1"):
        train_bc(replace(config, resume=True, seed=1), progress=False)
    with pytest.raises(FileNotFoundError, match="no such run to resume"):
        train_bc(bc(tmp_path / "other", demos, resume=True), progress=False)
    before = weights(config.out)
    train_bc(replace(config, resume=True), progress=False)  # the run is finished
    assert weights(config.out) == before


def test_what_is_finished_is_not_trained_again(tmp_path):
    config = ppo(tmp_path / "run")
    train_ppo(config, progress=False)
    before, evaluated = weights(config.out), lines(config.out)
    events = sorted((config.out / "tensorboard").iterdir())
    progress = json.loads((config.out / "checkpoint" / "manifest.json").read_text())["progress"]
    assert progress["step"] == config.total_timesteps
    train_ppo(replace(config, resume=True), progress=False)
    assert weights(config.out) == before
    assert [line["step"] for line in lines(config.out)] == [line["step"] for line in evaluated]
    assert len(events) == 1


def test_a_finished_run_is_extended_with_more_steps_and_another_learning_rate(tmp_path, capsys):
    config = ppo(tmp_path / "run", total_timesteps=256)
    train_ppo(config, progress=False)
    before = weights(config.out)
    words = ["--total-timesteps", "1024", "--learning-rate", "0.0001"]
    assert main(["train", "ppo", "--out", str(config.out), "--resume", *words]) == 0
    assert [line["step"] for line in lines(config.out) if line["final"]][-1] == 1024
    assert weights(config.out) != before
    record = json.loads((config.out / "config.json").read_text())
    assert record["config"]["total_timesteps"] == 1024 and record["config"]["learning_rate"] == 1e-4
    assert record["changes"][0]["before"] == {"total_timesteps": 256, "learning_rate": config.learning_rate}
    rate = PPO.load(config.out / "checkpoint" / "model.zip", device="cpu").learning_rate
    assert rate(1.0) == 1e-4
    capsys.readouterr()
    assert main(["train", "ppo", "--out", str(config.out), "--resume", "--total-timesteps", "300"]) == 2
    assert "total_timesteps: expected at least 1024" in capsys.readouterr().err
    assert main(["train", "ppo", "--out", str(config.out), "--resume", "--seed", "7"]) == 2
    assert "apart from total_timesteps, learning_rate and dagger.rounds" in capsys.readouterr().err


def test_without_a_family_policies_are_evaluated_in_their_own():
    def families(*names):
        return [bank.family for bank in default_banks([load_policy_spec(name) for name in names])]

    assert families("crossing", "expert") == ["crossing"] and families("expert") == ["clutter"]
    assert families("rooms", "open") == ["open", "rooms"] and len(families("all")) == 5


def test_a_run_of_another_version_is_refused_by_what_it_lacks(tmp_path):
    config = ppo(tmp_path / "run", total_timesteps=256)
    train_ppo(config, progress=False)
    record = json.loads((config.out / "config.json").read_text())
    del record["config"]["lidar_fov"]  # a run from before this setting has the full circle
    (config.out / "config.json").write_text(json.dumps(record))
    train_ppo(replace(config, resume=True), progress=False)
    del record["config"]["graded_miss"]
    (config.out / "config.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match="a run of another version of leapnav, without graded_miss"):
        train_ppo(replace(config, resume=True), progress=False)


@pytest.mark.parametrize("name", shipped_policies())
def test_a_policy_that_ships_starts_a_run_with_the_defaults(name, tmp_path):
    family, environment = read_description(name)["training"]["family"], policy_environment(name)
    task = {setting: environment[setting] for setting in ("robot", "horizon")}
    config = PPOConfig.tuned(family, **task, out=tmp_path, warm_start=(Path(name),))
    demos, start = _resolve_warm_start(config)
    assert demos == []
    assert start.observation_space == make_training_env(config).observation_space


def test_a_policy_of_the_ideal_robot_starts_one_with_motors(tmp_path):
    """The actions do not depend on the velocity at first; the evaluations have the motors and the disturbance."""
    config = ppo(tmp_path / "run", total_timesteps=256, actuation="motor", disturbance=0.05, warm_start=(Path("open"),))
    config = replace(config, hidden=(128, 128), lidar_beams=32)
    _, start = _resolve_warm_start(config)
    venv = make_training_env(config)
    policy = make_policy(venv.observation_space, venv.action_space, 0, (128, 128))
    copy_actor(start, policy)
    observations = venv.reset()
    without = np.concatenate([observations[:, :9], observations[:, 12:]], axis=1)
    assert policy.predict(observations, deterministic=True)[0] == pytest.approx(
        start.predict(without, deterministic=True)[0], abs=1e-5
    )
    train_ppo(config, progress=False)
    environment = read_description(config.out)["environment"]
    assert environment["actuation"] == "motor" and environment["disturbance"]["actuation"] == 0.05
    assert load_policy(config.out).observation_space.shape == venv.observation_space.shape


def test_misses_are_graded_but_not_for_ppo_from_a_warm_start(tmp_path):
    for config, graded in (
        (PPOConfig.tuned("open", out=tmp_path), True),
        (SACConfig.tuned("open", out=tmp_path), True),
        (PPOConfig.tuned("open", out=tmp_path, warm_start=(Path("open"),)), False),
        (SACConfig.tuned("open", warm=True), True),
        (replace(PPOConfig.tuned("open", out=tmp_path), graded_miss=False), False),
    ):
        assert make_training_env(config).venv.settings.graded_miss == graded


def test_a_damaged_checkpoint_is_refused(tmp_path):
    config = ppo(tmp_path / "run")
    train_ppo(config, progress=False)
    model = config.out / "checkpoint" / "model.zip"
    content = model.read_bytes()
    model.write_bytes(content[:100] + b"x" + content[101:])
    with pytest.raises(ValueError, match=r"model\.zip: damaged; the run cannot be resumed"):
        train_ppo(replace(config, resume=True), progress=False)
    (config.out / "checkpoint" / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match="a damaged checkpoint"):
        train_ppo(replace(config, resume=True), progress=False)
    (config.out / "config.json").write_text('{"config": {"algorithm": "ppo", "out": "x", "n_envs": "many"}}')
    with pytest.raises(ValueError, match=r"config\.json: n_envs: .*, got 'many'"):
        read_config(config.out)


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import test_runs
test_runs.run(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]), sys.argv[5] == "resume")
"""


def run(name, out, demos, resume):
    if name == "ppo":
        train_ppo(warm(out, demos, resume=resume), progress=False)
    else:
        start = WarmStartConfig(critic_epochs=1, slopes=100)
        changes = {
            "learning_starts": 20,
            "checkpoint_every": 40,
            "imitation": 5.0,
            "warm_start": (demos,),
            "reward": "cost",
            "start": start,
        }
        train_sac(sac(out, cloning=QUICK, resume=resume, **changes), progress=False)


def warm(out, demos, **changes):
    start = WarmStartConfig(critic_epochs=1, slopes=100)
    extra = {
        "critic_first": 0.2,
        "last_std": 0.1,
        "reward": "cost",
        "warm_start": (demos,),
        "cloning": QUICK,
    }
    return ppo(out, start=start, **{**extra, **changes})


@pytest.mark.parametrize("name", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_a_killed_run_continues_from_its_last_checkpoint(name, demos, tmp_path):
    """SIGKILL after the first checkpoint; PPO with all parts of a warm start, SAC with demonstrations."""
    killed = tmp_path / "killed"
    arguments = [sys.executable, "-c", SCRIPT, os.path.dirname(__file__), name, killed, demos, "new"]
    process = subprocess.Popen([str(a) for a in arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    while not (killed / "checkpoint" / "manifest.json").exists() and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    output = process.communicate()[0].decode()
    assert process.returncode == -signal.SIGKILL, output
    progress = json.loads((killed / "checkpoint" / "manifest.json").read_text())["progress"]
    before = lines(killed)
    run(name, killed, demos, resume=True)
    after = lines(killed)
    assert 0 < progress["step"] < after[-1]["step"] and after[-1]["final"]
    kept = [line for line in before if line["step"] <= progress["evaluated"]]
    assert after[: len(kept)] == kept
    steps = [line["step"] for line in after]
    assert steps == sorted(steps)


def test_an_interrupted_clone_keeps_its_demonstrations(tmp_path, monkeypatch):
    from leapnav.training.runs import imitation

    config = replace(bc(tmp_path / "run", None), demos=(), scenarios=6)
    whole, calls = imitation.behaviour_clone, []

    def stopped(*arguments, on_epoch, **options):
        def epoch(loss):
            on_epoch(loss)
            if not calls:
                calls.append(1)
                raise KeyboardInterrupt

        return whole(*arguments, on_epoch=epoch, **options)

    monkeypatch.setattr(imitation, "behaviour_clone", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_bc(config, progress=False)
    made = {path: path.stat().st_mtime_ns for path in (config.out / "demonstrations").rglob("*") if path.is_file()}
    train_bc(replace(config, resume=True), progress=False)
    assert made == {path: path.stat().st_mtime_ns for path in made}
    samples = len(Dataset.of(config.out / "demonstrations"))
    assert [line["step"] for line in lines(config.out)] == [samples, 2 * samples, 3 * samples, 3 * samples]


def test_dagger_is_resumed_round_by_round_and_extended(demos, tmp_path, monkeypatch, capsys):
    def config(out, **changes):
        settings = {"n_envs": 2, "cloning": QUICK, "dagger": DAggerConfig(rounds=2, max_episodes=3, lead=0.5)}
        return DAggerRunConfig(out=out, demos=(demos,), **{**COMMON, **settings, **changes})

    train_dagger(config(tmp_path / "straight"), progress=False)
    from leapnav.training.learning import dagger

    whole, calls = dagger.DAgger.run_round, []

    def stopped(self, **arguments):
        if calls:
            raise KeyboardInterrupt
        calls.append(1)
        return whole(self, **arguments)

    monkeypatch.setattr(dagger.DAgger, "run_round", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_dagger(config(tmp_path / "stopped"), progress=False)
    monkeypatch.undo()
    train_dagger(config(tmp_path / "stopped", resume=True), progress=False)
    assert weights(tmp_path / "stopped") == weights(tmp_path / "straight")
    resume = ["train", "dagger", "--out", str(tmp_path / "stopped"), "--resume"]
    assert main([*resume, "--dagger.rounds", "3"]) == 0
    record = json.loads((tmp_path / "stopped" / "config.json").read_text())
    assert record["config"]["dagger"]["rounds"] == 3 and record["changes"][0]["before"] == {"dagger.rounds": 2}
    assert len(list((tmp_path / "stopped" / "rounds").glob("round-*.npz"))) == 3
    for option, message in (("rounds", "expected at least 3"), ("lead", "the run in")):
        assert main([*resume, f"--dagger.{option}", "1"]) == 2
        assert f"dagger.{option}: {message}" in capsys.readouterr().err


@pytest.mark.parametrize("algorithm", [pytest.param("sac", marks=pytest.mark.slow), "tqc"])
def test_sac_and_tqc_train_and_their_policies_load(algorithm, tmp_path):
    config = sac(tmp_path / algorithm, algorithm=algorithm)
    train_sac(config, progress=False)
    policy = load_policy(config.out)
    assert policy.predict(np.zeros((2, 25), np.float32), deterministic=True)[0].shape == (2, 2)


def test_a_warm_start_takes_demonstrations_or_a_policy(demos, tmp_path):
    train_bc(bc(tmp_path / "clone", demos), progress=False)
    for name, given in (("policy", (tmp_path / "clone",)), ("both", (tmp_path / "clone", demos))):
        config = ppo(tmp_path / name, warm_start=given, total_timesteps=256, reward="cost", learning_rate=1e-9)
        train_ppo(config, progress=False)
        one, other = (load_policy(folder) for folder in (tmp_path / "clone", tmp_path / name))
        inputs = np.random.default_rng(0).uniform(0, 3, (20, 25)).astype(np.float32)
        found = [policy.predict(inputs, deterministic=True)[0] for policy in (one, other)]
        np.testing.assert_allclose(*found, atol=1e-4)
    with pytest.raises(ValueError, match="warm_start: expected at most one policy"):
        train_ppo(ppo(tmp_path / "two", warm_start=(tmp_path / "clone", tmp_path / "policy")), progress=False)
    with pytest.raises(FileNotFoundError, match=r"warm_start: .*nowhere: no such directory"):
        train_ppo(ppo(tmp_path / "none", warm_start=(tmp_path / "nowhere",)), progress=False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"evaluate_every": 0}, r"evaluate_every: expected an integer >= 1, got 0"),
        ({"std": 0.0}, r"std: expected a positive number, got 0.0"),
        ({"seed": -1}, r"seed: expected an integer from 0"),
        ({"family": "moon"}, r"family: expected one of .*got 'moon'"),
        ({"hidden": (0,)}, r"hidden: expected widths of at least 1"),
        ({"critic_first": 1.0}, r"critic_first: expected a number in \[0, 1\), got 1.0"),
        (
            {"last_std": 0.1, "ent_coef": 0.01},
            "ent_coef: expected 0, because last_std > 0 fixes the noise and its entropy, got 0.01",
        ),
        ({"lidar_beams": 7}, "lidar_beams: expected an even number >= 2, got 7"),
        ({"cloning": CloningConfig(epochs=0)}, r"cloning.epochs: expected a positive number, got 0"),
        ({"cloning": CloningConfig(seed=3)}, r"cloning.seed: expected 0, got 3; set the seed of the run"),
        ({"start": WarmStartConfig(slopes=0)}, r"start.slopes: expected a positive number, got 0"),
        ({"ent_coef": -1.0}, r"ent_coef: expected a number >= 0"),
        ({"levels": "plr"}, r"levels: expected one of fresh, .*, got 'plr'"),
        ({"level_bank": "my.bank"}, r"level_bank: expected none with levels='fresh', got 'my.bank'"),
        (
            {"levels": "uniform", "family": "all"},
            "level_bank: expected a bank for levels='uniform' of 'all'",
        ),
    ],
)
def test_invalid_settings_are_reported_before_the_run_directory_is_created(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        train_ppo(ppo(tmp_path / "run", **changes), progress=False)
    assert not (tmp_path / "run").exists()


def test_ppo_may_let_the_critic_learn_first_and_end_with_little_noise(demos, tmp_path):
    clone, out = tmp_path / "clone", tmp_path / "ppo"
    train_bc(bc(clone, demos), progress=False)
    start = load_policy(clone)
    for fraction in (0.99, 0.5):
        config = ppo(out / str(fraction), warm_start=(clone,), critic_first=fraction, last_std=0.2)
        train_ppo(config, progress=False)
        policy = load_policy(config.out)
        same = [th.equal(a, b) for a, b in zip(actor_parameters(start), actor_parameters(policy), strict=True)]
        # The bias of the actions cancels in the mean over the symmetries.
        assert all(same) if fraction == 0.99 else same == [False] * (len(same) - 1) + [True]
        assert not th.equal(start.value_net.weight, policy.value_net.weight)
        assert th.allclose(policy.log_std.exp(), th.tensor(0.2))


def test_ppos_robots_have_the_settings_of_the_run(tmp_path):
    robots = make_training_env(ppo(tmp_path, control_period=0.1, penalty=7.0, lidar_beams=8))
    settings = robots.get_attr("settings")[0]
    assert (settings.control_period, settings.lidar_beams) == (0.1, 8)
    assert settings.collision_penalty == settings.miss_penalty == 7.0
    assert make_training_env(sac(tmp_path)).get_attr("settings")[0].control_period == 0.05


def test_dagger_with_another_history_than_its_first_learner_is_refused(demos, tmp_path):
    clone = tmp_path / "clone"
    train_bc(bc(clone, demos), progress=False)
    config = DAggerRunConfig(out=tmp_path / "run", demos=(demos,), policy=clone, history=(0.4,), **COMMON)
    with pytest.raises(ValueError, match=r"history=\(\) \(here \(0\.4,\)\)"):
        train_dagger(config, progress=False)
    assert not (tmp_path / "run").exists()


def test_demonstrations_have_one_reward_only(demos, tmp_path):
    with pytest.raises(ValueError, match="reward: expected 'cost', the reward of demonstrations, got 'shaped'"):
        train_ppo(ppo(tmp_path / "run", warm_start=(demos,), reward="shaped"), progress=False)


def test_no_training_run_meets_the_scenarios_of_the_banks():
    """The seeds of the banks are 0 and 1; the first stream of a NumPy seed equals the seed itself."""
    from leapnav.envs import ScenarioBank, sample_scenario

    assert sample_scenario("clutter", 1).obstacles == ScenarioBank.shipped("clutter", "test")[0].obstacles
    with pytest.raises(ValueError, match="seed: expected at least 2, got 1"):
        rollout("clutter", 1, "nowhere", seed=1)
    assert environment_seed(0) > 1_000_000
    assert len({environment_seed(seed, stream) for seed in range(50) for stream in range(50)}) == 2500


@pytest.mark.usefixtures("coarse_decisions")
def test_the_report_is_one_page_that_needs_nothing_else(demos, tmp_path):
    folders = []
    for seed in (0, 1):
        train_bc(bc(tmp_path / f"bc{seed}", demos, seed=seed), progress=False)
        folders.append(str(tmp_path / f"bc{seed}"))
    train_ppo(ppo(tmp_path / "ppo"), progress=False)
    page = tmp_path / "report.html"
    specs = [load_policy_spec(name) for name in (*folders, str(tmp_path / "ppo"), "go-to-goal")]
    found = compare_policies(specs, default_banks(specs), count=2, progress=False)
    write_report(found, page, progress=False)
    assert list(found.runs) == [folders[0], str(tmp_path / "ppo"), "go-to-goal"]
    assert [len(runs) for runs in found.runs.values()] == [2, 1, 1]
    text = page.read_text()
    assert text.count("<svg") == 3
    assert text.count("data:image/png;base64") == 6  # episodes and decisions of each row
    assert "http" not in text.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    ).replace("https://matplotlib.org", "")
    for words in ("by family", "by clearance", "by reversing", "(2 runs)"):
        assert words in text
