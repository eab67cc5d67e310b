import numpy as np
import pytest
from helpers import QUICK, fresh
from tqdm import tqdm

from leapnav.envs import NavigateEnv, Scenario
from leapnav.experts import ExpertPolicy
from leapnav.training import DAgger, DAggerConfig, Dataset, behaviour_clone, make_vec_env
from leapnav.training.vec_env import ScaledReward


def test_dagger_labels_what_the_learner_sees(dataset, env, tmp_path):
    """The labels are the expert's at the learner's states, with value and costate; rounds are kept on disk."""
    policy = fresh(env)
    behaviour_clone(policy, dataset, QUICK, progress=False)
    venv = make_vec_env(n_envs=4, family="open", split="fresh")
    config = DAggerConfig(rounds=2, failures=5, successes=2, expert_share=0.5)
    dagger = DAgger(
        policy,
        ExpertPolicy(venv, reconsider=0.1),
        venv,
        config,
        cloning=QUICK,
        dataset=dataset,
        folder=tmp_path / "rounds",
    )
    rounds = dagger.run(progress=False)
    assert [done.number for done in rounds] == [1, 2]
    assert all(done.episodes >= 5 for done in rounds)
    assert len(dagger.dataset) == len(dataset) + sum(done.samples for done in rounds)
    kept = Dataset.load(tmp_path / "rounds" / "round-001.npz")
    assert len(kept) == rounds[0].samples
    for i in (0, len(kept) // 2, len(kept) - 1):
        scenario = Scenario.from_json(kept.scenarios[kept.episodes[i]])
        rest = scenario.model_copy(
            update={"start": tuple(kept.states[i].tolist()), "horizon": scenario.horizon - float(kept.times[i])}
        )
        one = NavigateEnv(scenario=rest)
        observation, _ = one.reset()
        assert observation == pytest.approx(kept.observations[i], abs=1e-4)
        expert = ExpertPolicy(one)
        assert expert.predict(observation)[0] == pytest.approx(kept.actions[i], abs=2e-2)
        assert -expert.value() == pytest.approx(kept.returns[i], rel=1e-4)
        assert expert.costate() == pytest.approx(kept.costates[i], abs=1e-2 * max(1, np.abs(kept.costates[i]).max()))
        assert scenario.horizon - kept.times[i] >= config.forgiven


def test_dagger_is_the_same_with_the_same_seed_and_any_number_of_workers(env, monkeypatch):
    monkeypatch.setattr("leapnav.training.dagger.PORTION", 2)
    found = []
    for workers in (1, 1, 2):
        policy = fresh(env)
        venv = make_vec_env(n_envs=2, family="open", split="fresh")
        config = DAggerConfig(rounds=1, failures=4, successes=0, seed=4)
        dagger = DAgger(policy, ExpertPolicy(venv), venv, config, cloning=QUICK, workers=workers)
        dagger.run(progress=False)
        found.append((policy.parameters_to_vector().tobytes(), dagger.dataset.observations.tobytes()))
    assert found[0] == found[1] == found[2]
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        DAgger(fresh(env), ExpertPolicy(venv), venv, workers=0)


@pytest.mark.parametrize("settings", [{"rounds": 0}, {"expert_share": 1.5}, {"learning_rate": -1.0}])
def test_bad_settings_of_dagger_are_named(settings, env):
    venv = make_vec_env(n_envs=1, family="open", split="fresh")
    with pytest.raises(ValueError, match=f"{next(iter(settings))}: "):
        DAgger(fresh(env), ExpertPolicy(venv), venv, DAggerConfig(**settings))
    with pytest.raises(ValueError, match="expert: expected one for venv"):
        DAgger(fresh(env), ExpertPolicy(make_vec_env(n_envs=1, family="open")), venv)
    with pytest.raises(TypeError, match="venv: expected one from"):
        DAgger(fresh(env), ExpertPolicy(venv), ScaledReward(venv, 2.0))


def test_dagger_labels_what_the_learner_failed_in_first(dataset, env):
    """Where it always fails, all that is labelled are failures; the successes are a sample."""
    venv = make_vec_env(n_envs=4, family="open", split="fresh", seed=0)
    dagger = DAgger(fresh(env), ExpertPolicy(venv), venv, DAggerConfig(rounds=1, failures=6, successes=3))
    failed, succeeded, _ = dagger._drive("", False)
    assert len(failed) >= 6
    assert len(succeeded) == 0
    labelled = dagger._label(failed[:2], 0, np.random.default_rng(0), tqdm(disable=True))
    assert {Scenario.from_json(text) for text in labelled.scenarios} == set(failed[:2])
