"""Rollouts that are interrupted, resumed, damaged, repeated."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from helpers import cluster_that_loses_a_worker

from leapnav.cli import main
from leapnav.envs import NavigateEnv, ScenarioBank
from leapnav.envs.utils.files import digest
from leapnav.experts import ExpertPolicy, pools
from leapnav.experts.data import rollouts
from leapnav.experts.data.datasets import CHECKSUM, dataset_id, open_dataset
from leapnav.experts.data.demonstrations import load_demonstrations
from leapnav.experts.data.rollouts import DONE, RECORD, SHARD_SIZE, WORK, check_dataset, rollout
from leapnav.experts.data.store import ResumableStore

SETTINGS = {"family": "open", "seed": 3}


def opened(folder, **changes):
    return ResumableStore(folder / WORK, "rollout", {**SETTINGS, **changes})


def contents(folder):
    """Every array and attribute of a dataset."""
    (file,) = folder.glob("**/main_data.hdf5")
    found = {}

    def take(name, item):
        values = item[()].tobytes() if isinstance(item, h5py.Dataset) else None
        found[name] = values, sorted(map(str, item.attrs.items()))

    with h5py.File(file) as data:
        data.visititems(take)
    (metadata,) = folder.glob("**/metadata.json")
    return found, metadata.read_text()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("rollouts") / "whole"
    summary = rollout("open", 40, out, seed=3, recoveries=1, workers=2, progress=False)
    assert summary.demonstrations > 70
    assert {path.name for path in out.iterdir()} == {"leapnav", RECORD}
    return out


@pytest.mark.slow
def test_a_killed_and_resumed_rollout_gives_the_same_dataset(whole, tmp_path):
    out = tmp_path / "out"
    arguments = ["rollout", "--family", "open", "--count", "40", "--seed", "3", "--recoveries", "1", "--workers", "1"]
    command = [sys.executable, "-m", "leapnav", *arguments, "--out", str(out)]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    while len(list(out.glob(f"{WORK}/shard-*.npz"))) < 2 and process.poll() is None:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert list(out.glob(f"{WORK}/shard-*.npz"))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert contents(out) == contents(whole)


def test_stopped_while_the_dataset_is_written_it_writes_it_again(whole, tmp_path, monkeypatch):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(rollouts, "write_dataset", stop)
        with pytest.raises(KeyboardInterrupt):
            rollout("open", 40, tmp_path / "out", seed=3, recoveries=1, progress=False)
    (tmp_path / "out" / WORK / "root" / "leapnav").mkdir(parents=True)  # half of a dataset
    with monkeypatch.context() as patched:
        patched.setattr(rollouts, "_shard", stop)  # nothing is solved again
        rollout("open", 40, tmp_path / "out", seed=3, recoveries=1, progress=False)
    assert contents(tmp_path / "out") == contents(whole)


def test_a_rollout_interrupted_after_its_last_step_is_completed(whole, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr(rollouts, "RolloutSummary", lambda *totals: 1 / 0)  # made when the dataset is in its place
        with pytest.raises(ZeroDivisionError):
            rollout("open", 40, out, seed=3, recoveries=1, progress=False)
    assert {path.name for path in out.iterdir()} == {WORK, "leapnav"}
    rollout("open", 40, out, seed=3, recoveries=1, progress=False)
    assert contents(out) == contents(whole)
    (out / DONE).mkdir()  # left by a run that was interrupted during its cleanup
    before = (out / RECORD).stat().st_mtime_ns
    again = rollout("open", 40, out, seed=3, recoveries=1, progress=False)
    assert again.demonstrations == 80
    assert (out / RECORD).stat().st_mtime_ns == before
    assert {path.name for path in out.iterdir()} == {"leapnav", RECORD}


def test_a_full_disk_keeps_what_is_finished(whole, tmp_path, monkeypatch):
    write, written = ResumableStore.write, []

    def fill(self, number, arrays):
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(self.path(number)))
        written.append(number)
        write(self, number, arrays)

    with monkeypatch.context() as patched:
        patched.setattr(ResumableStore, "write", fill)
        with pytest.raises(OSError, match="No space left"):
            rollout("open", 40, tmp_path / "out", seed=3, recoveries=1, progress=False)
    assert len(list((tmp_path / "out" / WORK).glob("shard-*.npz"))) == 2
    assert not list((tmp_path / "out" / WORK).glob(".*.partial"))
    rollout("open", 40, tmp_path / "out", seed=3, recoveries=1, progress=False)
    assert contents(tmp_path / "out") == contents(whole)


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    with opened(tmp_path) as store:
        monkeypatch.setattr(np, "savez", fail)
        with pytest.raises(OSError, match="No space left") as caught:
            store.write(7, {})
    assert caught.value.filename == str(store.path(7))
    assert 7 not in store


def fail(*arguments, **options):
    raise OSError(errno.ENOSPC, "No space left on device")


def unfinished(folder, monkeypatch, **changes):
    """A rollout that was stopped when all was solved."""
    with monkeypatch.context() as patched:
        patched.setattr(rollouts, "_write", lambda *arguments: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            rollout(**{"count": 2 * SHARD_SIZE, "out": folder, "progress": False, **SETTINGS, **changes})
    return sorted(folder.glob(f"{WORK}/shard-*.npz"))


def test_a_damaged_shard_is_refused_by_name(tmp_path, monkeypatch):
    first, second = unfinished(tmp_path / "out", monkeypatch)
    with pytest.raises(FileNotFoundError, match="out: an unfinished rollout; repeat its command"):
        open_dataset(tmp_path / "out")
    content = bytearray(second.read_bytes())
    content[len(content) // 2] ^= 0xFF
    second.write_bytes(content)
    with pytest.raises(ValueError, match=r"shard-000001\.npz: damaged: .*; remove it"):
        rollout("open", 2 * SHARD_SIZE, tmp_path / "out", seed=3, progress=False)
    second.write_bytes(first.read_bytes())
    with pytest.raises(ValueError, match=r"shard-000001\.npz: a shard of another rollout"):
        rollout("open", 2 * SHARD_SIZE, tmp_path / "out", seed=3, progress=False)
    second.unlink()
    assert rollout("open", 2 * SHARD_SIZE, tmp_path / "out", seed=3, progress=False).demonstrations == 2 * SHARD_SIZE


def test_other_arguments_do_not_continue_it(tmp_path, monkeypatch):
    unfinished(tmp_path / "out", monkeypatch)
    for changes in ({"seed": 4}, {"noise": 0.1}, {"family": "slalom"}, {"recoveries": 2}):
        message = (
            rf"(?s)rollout\.json: holds an unfinished rollout of other settings: {next(iter(changes))} is .*--force"
        )
        with pytest.raises(ValueError, match=message):
            rollout(**{"count": 4, "out": tmp_path / "out", "progress": False, **SETTINGS, **changes})
    # A longer one goes on.
    assert (
        rollout("open", 2 * SHARD_SIZE + 3, tmp_path / "out", seed=3, progress=False).demonstrations
        == 2 * SHARD_SIZE + 3
    )


def test_nothing_is_overwritten_without_force(tmp_path):
    out = tmp_path / "out"
    rollout("open", 2, out, progress=False)
    for changes, message in (({"count": 3}, "count is 2, got 3"), ({"noise": 0.1}, r"noise is 0\.0, got 0\.1")):
        with pytest.raises(FileExistsError, match=f"holds a rollout whose {message}; choose another directory"):
            rollout(**{"family": "open", "count": 2, "out": out, "progress": False, **changes})
    (out / RECORD).rename(tmp_path / "record")
    with pytest.raises(FileExistsError, match="not empty"):
        rollout("open", 2, out, progress=False)
    (out / RECORD).write_text("[]")
    with pytest.raises(ValueError, match=r"rollout\.json: damaged"):
        rollout("open", 2, out, progress=False)
    assert rollout("open", 3, out, force=True, progress=False).demonstrations == 3
    (out / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="not empty"):
        rollout("open", 3, out, force=True, progress=False)
    assert (out / "notes.txt").exists()


def test_two_processes_do_not_share_a_rollout(tmp_path):
    with opened(tmp_path), pytest.raises(ValueError, match="another process is at work"), opened(tmp_path):
        pass
    with opened(tmp_path):
        pass


def test_a_store_of_other_settings_can_be_opened_with_its_own_afterwards(tmp_path):
    with opened(tmp_path) as store:
        store.write(0, {"values": np.arange(3)})
    with pytest.raises(ValueError, match="seed is 3, got 4"), opened(tmp_path, seed=4):
        pass
    with opened(tmp_path) as store:
        assert store.read(0)["values"].tolist() == [0, 1, 2]


def test_what_a_killed_process_left_of_a_file_is_removed(tmp_path):
    with opened(tmp_path) as store:
        leftover = store.directory / ".shard-000000.npz.1.partial"
        leftover.write_bytes(b"half of a shard")
    with opened(tmp_path) as store:
        assert not leftover.exists()
        assert 0 not in store


@pytest.mark.slow  # test_given_scenarios.py has the same for banks
def test_a_dask_cluster_that_loses_a_worker_makes_the_same_dataset(whole, tmp_path):
    out = tmp_path / "out"
    with cluster_that_loses_a_worker(out, f"{WORK}/shard-*.npz") as address:
        summary = rollout("open", 40, out, seed=3, recoveries=1, dask=address, progress=False)
    assert summary.demonstrations > 70
    assert contents(out) == contents(whole)


def test_without_dask_or_a_scheduler_a_cluster_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pools, "DASK_TIMEOUT", 0.2)
    with pytest.raises(OSError, match=r"127\.0\.0\.1:1"):
        rollout("open", 1, tmp_path / "one", dask="tcp://127.0.0.1:1", progress=False)
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    with pytest.raises(ModuleNotFoundError, match=r"leapnav\[cluster\]"):
        rollout("open", 1, tmp_path / "two", dask="tcp://127.0.0.1:1", progress=False)


def test_a_dataset_is_replayed(whole, tmp_path, capsys):
    replay = check_dataset(whole, progress=False)
    assert replay.episodes > 70
    assert (replay.observation, replay.reward, replay.state) == (0.0, 0.0, 0.0)
    assert main(["dataset", "check", str(whole)]) == 0
    assert f"{replay.episodes} episodes replayed" in capsys.readouterr().out
    changed = tmp_path / "changed"
    shutil.copytree(whole, changed)
    (file,) = changed.glob("**/main_data.hdf5")
    with h5py.File(file, "r+") as data:
        data["episode_7/rewards"][3] += 0.5
    assert main(["dataset", "check", str(changed)]) == 2
    assert "main_data.hdf5: damaged, or changed since it was written" in capsys.readouterr().err
    metadata = json.loads((file.parent / "metadata.json").read_text())
    metadata[CHECKSUM] = digest(file)
    (file.parent / "metadata.json").write_text(json.dumps(metadata))
    assert main(["dataset", "check", str(changed)]) == 1
    assert "rewards 5.0e-01" in (line := capsys.readouterr().out)
    assert "(episode 7)" in line
    assert main(["dataset", "check", str(tmp_path / "nowhere")]) == 2


def test_the_dataset_has_reference_scores_seeds_and_costs(whole, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(whole))
    dataset = minari.load_dataset(dataset_id("open"))
    demonstrations = load_demonstrations(whole)
    bank = ScenarioBank.shipped("open", "test")
    assert dataset.storage.metadata["ref_max_score"] == pytest.approx(-bank.costs.mean())
    assert dataset.storage.metadata["ref_min_score"] < -40
    returns = np.array([d.rewards.sum() for d in demonstrations])
    scores = minari.get_normalized_score(dataset, returns)
    assert scores.mean() == pytest.approx(1.0, abs=0.05)  # the scenarios of the dataset are others
    assert dataset.recover_environment(eval_env=True).unwrapped.bank is bank
    assert demonstrations[0].seed == 3
    episode = dataset[5]
    assert (episode.infos["reference_cost"] == episode.infos["cost_to_go"][0]).all()


def test_with_noise_the_expert_s_own_actions_are_recorded(tmp_path):
    rollout("clutter", 3, tmp_path, noise=0.2, progress=False)
    episodes = open_dataset(tmp_path).iterate_episodes()
    for demonstration, episode in zip(load_demonstrations(tmp_path), episodes, strict=True):
        assert np.array_equal(episode.actions, demonstration.executed)  # what learners of transitions need
        assert np.array_equal(episode.infos["expert_action"][:-1], demonstration.actions)
        off = demonstration.executed - demonstration.actions
        assert 0.1 < off.std() < 0.25
        env = NavigateEnv(scenario=demonstration.scenario)
        expert = ExpertPolicy(env)
        observation, _ = env.reset()
        for k, executed in enumerate(demonstration.executed):
            assert np.array_equal(observation, demonstration.observations[k])
            if k % 20 == 0:
                assert expert.predict(observation)[0].clip(-1, 1) == pytest.approx(demonstration.actions[k], abs=1e-4)
                assert expert.value() == pytest.approx(demonstration.cost_to_go[k], rel=1e-6)
                assert expert.costate() == pytest.approx(demonstration.costates[k], abs=1e-4)
            observation, reward, *_ = env.step(executed)
            assert reward == pytest.approx(demonstration.rewards[k], rel=1e-12)
        assert env.at_goal
