"""Several banks in one comparison, also of one family: their episodes are never confused."""

import json
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure

from leapnav.envs import NavigateEnv, ScenarioBank
from leapnav.training import RandomPolicy, compare, plot_episodes, write_report
from leapnav.training.scoring.decision_reports import costliest_decisions, plot_decisions
from leapnav.training.scoring.reports import draw_episode, print_scores, scores_to_dict
from leapnav.training.scoring.results import bank_identity, bank_of

BANKS = [ScenarioBank.shipped("open", split) for split in ("train", "test")]


@pytest.fixture(scope="module")
def comparison():
    policy = RandomPolicy(NavigateEnv().action_space)
    return compare({"random": policy, "other": policy}, BANKS, count=3, progress=False)


def test_an_episode_is_drawn_with_the_optimum_of_its_own_bank(comparison):
    for number, episode in enumerate(comparison.runs["random"][0]):
        for banks in (BANKS, BANKS[::-1]):
            axes = Figure().subplots()
            draw_episode(axes, banks, episode)
            (optimum,) = [line for line in axes.lines if line.get_linestyle() == "--"]
            expected = BANKS[number // 3].states(episode.index)[:, :2]
            np.testing.assert_array_equal(np.column_stack(optimum.get_data()), expected)


@pytest.mark.usefixtures("coarse_decisions")
def test_the_decisions_of_an_episode_are_those_in_its_own_scenario(comparison, tmp_path):
    found = costliest_decisions(comparison.runs["random"][0], BANKS, 6, progress=False)
    assert len(found) == 6
    names = {(one.episode.bank, one.episode.index) for one in found}
    assert names == {(bank_identity(bank), i) for bank in BANKS for i in range(3)}
    plot_decisions(found, BANKS, tmp_path / "decisions.png")


def test_an_episode_of_none_of_the_banks_is_an_error(comparison, tmp_path):
    with pytest.raises(ValueError, match="banks: expected that of the episode"):
        plot_episodes(BANKS[1:], comparison.runs["random"][0].episodes, tmp_path / "episodes.png")
    with pytest.raises(ValueError, match="none"):
        bank_of(comparison.runs["random"][0].episodes[0], [])


@pytest.mark.usefixtures("coarse_decisions")
def test_tables_and_pages_have_a_column_for_each_bank(comparison, tmp_path, capsys):
    assert comparison.families == ("open",)
    assert comparison.bank_names == ("open (open-train.bank)", "open (open-test.bank)")
    print_scores(comparison)
    printed = "".join(capsys.readouterr().out.split())
    assert "bybank" in printed and "open-train.bank" in printed and "open-test.bank" in printed
    record = json.loads(json.dumps(scores_to_dict(comparison)))
    assert [bank["file"] for bank in record["banks"]] == ["open-train.bank", "open-test.bank"]
    identities = [bank["identity"] for bank in record["banks"]]
    assert [e["bank"] for e in record["episodes"]["random"][0]] == [identities[0]] * 3 + [identities[1]] * 3
    assert [bank["scores"][0]["episodes"] for bank in record["banks"]] == [3, 3]
    write_report(comparison, tmp_path / "report.html", progress=False)
    page = (tmp_path / "report.html").read_text()
    assert "open (open-train.bank) (3)" in page and "open (open-test.bank) (3)" in page


def test_a_part_of_a_comparison_is_that_of_a_family_or_of_a_bank(comparison):
    assert [len(comparison.of(bank).runs["random"][0]) for bank in BANKS] == [3, 3]
    assert len(comparison.of("open").runs["random"][0]) == 6
    assert comparison.of(BANKS[1]).banks == (BANKS[1],)


def test_the_identity_of_a_bank_is_its_content(tmp_path):
    copy = ScenarioBank(shutil.copy(BANKS[1].path, tmp_path / "renamed.bank"))
    assert bank_identity(copy) == bank_identity(BANKS[1]) != bank_identity(BANKS[0])
    policy = RandomPolicy(NavigateEnv().action_space)
    for banks in ([BANKS[1], copy], [copy, copy]):  # its scenarios would count twice
        with pytest.raises(ValueError, match="banks: expected different ones"):
            compare({"random": policy}, banks, count=1, progress=False)


def test_banks_with_the_same_file_name_are_named_by_their_paths(tmp_path):
    paths = [tmp_path / name / "my.bank" for name in ("a", "b")]
    for path, bank in zip(paths, BANKS, strict=True):
        path.parent.mkdir()
        shutil.copy(bank.path, path)
    policy = RandomPolicy(NavigateEnv().action_space)
    found = compare({"random": policy}, [ScenarioBank(path) for path in paths], count=1, progress=False)
    assert found.bank_names == tuple(f"open ({path})" for path in paths)
