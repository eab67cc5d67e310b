"""The number of threads of torch during training and evaluation."""

import pytest
import torch as th

from leapnav.envs import NavigateEnv
from leapnav.training import evaluate, make_policy
from leapnav.training.threads import VARIABLE, limit_threads


@pytest.fixture
def _two_threads():
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


def threads_during_an_evaluation():
    env = NavigateEnv("open")
    policy, seen = make_policy(env.observation_space, env.action_space), set()

    class Recorded:
        def predict(self, *arguments, **options):
            seen.add(th.get_num_threads())
            return policy.predict(*arguments, **options)

    evaluate(Recorded(), "open", count=2, timed=False, progress=False)
    return seen


@pytest.mark.usefixtures("_two_threads")
@pytest.mark.parametrize(("variable", "expected"), [(None, 1), ("3", 3)])
def test_torch_has_one_thread_or_as_many_as_the_variable_says_and_two_again_afterwards(variable, expected, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    if variable is not None:
        monkeypatch.setenv(VARIABLE, variable)
    assert threads_during_an_evaluation() == {expected}
    assert th.get_num_threads() == 2


@pytest.mark.usefixtures("_two_threads")
def test_the_number_of_threads_is_restored_after_an_error():
    @limit_threads
    def fail():
        raise KeyError(th.get_num_threads())

    with pytest.raises(KeyError, match="1"):
        fail()
    assert th.get_num_threads() == 2


@pytest.mark.parametrize("value", ["0", "two", "-1", ""])
def test_an_invalid_number_of_threads_is_refused(value, monkeypatch):
    monkeypatch.setenv(VARIABLE, value)
    with pytest.raises(ValueError, match=f"{VARIABLE}: expected a positive integer, got '{value}'"):
        threads_during_an_evaluation()
