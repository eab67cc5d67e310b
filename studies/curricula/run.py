"""Curricula: scores of levels beside their regret, and PPO from scratch with each level sampler, in several runs.

python studies/curricula/run.py               # trains and scores all, and draws the figure
python studies/curricula/run.py fresh max_mc  # trains and scores with these samplers only

`configurations/ppo.json` contains the complete settings, in the format of `config.json` of a training run; the levels
differ. `results/` contains the episodes on the test split, the evaluations during the runs, and the scores of all
levels at the stages of the runs with uniformly drawn levels. A finished run is not repeated, an interrupted one
resumes. `--tiny` trains with a tiny budget, to try the script; it needs `--out`.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import matplotlib as mpl
import numpy as np
import torch as th
from matplotlib.figure import Figure
from scipy.stats import spearmanr
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from leapnav.envs import ScenarioBank
from leapnav.experts import build_bank
from leapnav.training import PPOConfig
from leapnav.training.config import LevelsName, read_config
from leapnav.training.runs.reinforcement import make_training_env

sys.path.append(str(Path(__file__).parents[1]))
from common import load, play, read_arguments, score_tables, train, workers

HERE = Path(__file__).parent
SETTINGS, FIGURE = HERE / "configurations/ppo.json", HERE.parents[1] / "docs/images/curricula.svg"
FAMILY, N_LEVELS, LEVEL_SEED, SEEDS = "clutter", 2000, 782, 3
STAGES = (0.1, 0.25, 0.5, 1.0)  # fractions of a run at which the scores of all levels are computed
# Of each level, with the noise of training. The scores and what they are compared with are computed from different
# episodes, so that their errors are independent.
EPISODES = 4
N_ROBOTS = 500
NAMES = get_args(LevelsName)
SCORES = ("positive_value_loss", "max_mc", "learnability", "failures")
TARGETS = ("regret", "failure_rate", "success_regret")  # of the episodes with which the scores are compared
LABELS = {"max_mc": "MaxMC", "failures": "failure rate"}
TABLES = dict.fromkeys(("curricula-scores", "curricula-stages", "curricula-runs"), "docs/curricula.md")


class Snapshots(BaseCallback):
    """Save the model at the stages of a run."""

    def __init__(self, folder: Path, steps: int) -> None:
        super().__init__()
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._steps = folder, steps
        self._next = len(list(folder.glob("stage-*.zip")))  # of a resumed run, which repeats what it saved already

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._next < len(STAGES) and self.num_timesteps >= STAGES[self._next] * self._steps:
            self._save()

    def _on_training_end(self) -> None:
        while self._next < len(STAGES):
            self._save()

    def _save(self) -> None:
        self.model.save(self._folder / f"stage-{self._next}.zip")
        self._next += 1


def label(name: str) -> str:
    """Return the name of a score or a sampler in the tables."""
    return LABELS.get(name, name.replace("_", " "))


@th.no_grad()
def play_levels(model: PPO, venv: Any, indices: np.ndarray, penalty: float) -> dict[str, np.ndarray]:
    """Play one episode of each of N levels with the noise of training.

    Returns:
        `rewards`, `values` and `running` (T, N), the last bool; `returns`, with the full penalty of a miss, `costs` and
        `success` (N,).

    """
    venv.set_options([{"index": int(i)} for i in indices])
    observations, alive = venv.reset(), np.ones(len(indices), dtype=bool)
    rows: dict[str, list[np.ndarray]] = {"rewards": [], "values": [], "running": []}
    ends = {name: np.zeros(len(indices)) for name in ("returns", "costs", "success")}
    while alive.any():
        actions, values, _ = model.policy(th.as_tensor(observations))
        observations, rewards, dones, infos = venv.step(actions.clamp(-1, 1).numpy())
        for column, entry in zip(rows.values(), (rewards, values[:, 0].numpy(), alive), strict=True):
            column.append(entry.copy())
        for i in np.flatnonzero(dones & alive).tolist():
            last = infos[i]
            ends["costs"][i], ends["success"][i] = last["cost"], last["is_success"]
            missed = last["reward_miss"] < 0.0  # after a collision, too
            ends["returns"][i] = last["reward_collision"] - penalty * missed - last["cost"]
        alive &= ~dones
    return {**{name: np.array(column) for name, column in rows.items()}, **ends}


def score_levels(model: PPO, config: PPOConfig, bank: ScenarioBank, n_episodes: int) -> dict[str, np.ndarray]:
    """Return the scores, the failure rate, the regret and the regret of the successes, (N,), of the levels of a bank.

    The scores are those of `n_episodes` episodes of each level, the others of as many further ones.
    The regret is -J* minus the mean return of the episodes; that of the successes is NaN without any.
    """
    count = min(N_ROBOTS, len(bank))
    venv = make_training_env(replace(config, n_envs=count, levels="uniform", level_bank=bank.path))
    columns: dict[str, list[np.ndarray]] = {}
    th.manual_seed(config.seed)
    for first in range(0, len(bank), count):
        indices = np.arange(first, first + count)
        episodes = [play_levels(model, venv, indices, config.penalty) for _ in range(2 * n_episodes)]
        found = _scores(episodes[:n_episodes], config.gae_lambda) | _targets(episodes[n_episodes:], bank.costs[indices])
        for name, column in found.items():
            columns.setdefault(name, []).append(column)
    venv.close()
    return {name: np.concatenate(column).astype(np.float32) for name, column in columns.items()}


def _scores(episodes: Sequence[dict[str, np.ndarray]], gae_lambda: float) -> dict[str, np.ndarray]:
    """Return the scores of N levels from several episodes of each, see `PrioritizedSampler`; the discount is 1."""
    totals = [np.sum(episode["rewards"] * episode["running"], axis=0) for episode in episodes]
    best = np.max(totals, axis=0)
    gains, losses, steps = 0.0, 0.0, 0.0
    for episode in episodes:
        rewards, values, running = (episode[name] for name in ("rewards", "values", "running"))
        following = np.vstack([values[1:] * running[1:], np.zeros(len(best))])
        earned = np.cumsum(rewards, axis=0) - rewards
        advantage = np.zeros(len(best))
        for t in reversed(range(len(rewards))):
            advantage = running[t] * (rewards[t] + following[t] - values[t] + gae_lambda * advantage)
            gains += np.maximum(advantage, 0.0)
        losses += np.sum(running * (best - earned - values), axis=0)
        steps += running.sum(axis=0)
    rate = np.mean([episode["success"] for episode in episodes], axis=0)
    return {
        "positive_value_loss": gains / steps,
        "max_mc": losses / steps,
        "learnability": rate * (1 - rate),
        "failures": 1 - rate,
    }


def _targets(episodes: Sequence[dict[str, np.ndarray]], optimal: np.ndarray) -> dict[str, np.ndarray]:
    """Return what the scores of N levels are compared with, see `score_levels`."""
    success, costs = (np.array([episode[name] for episode in episodes]) for name in ("success", "costs"))
    with np.errstate(invalid="ignore"):
        successful = np.sum(costs * success, axis=0) / success.sum(axis=0) - optimal
    return {
        "failure_rate": 1 - success.mean(axis=0),
        "regret": -optimal - np.mean([episode["returns"] for episode in episodes], axis=0),
        "success_regret": successful,
    }


def correlations(results: Path) -> tuple[str, str]:
    """Return the tables of the rank correlations, and of the success and the regret at the stages.

    Values are means over the runs, with the range.
    """
    steps = read_config(SETTINGS)[1].total_timesteps
    rows = "| steps | score | regret | failure rate | regret of successes | top 10 % |\n" + "|---" * 6 + "|\n"
    stages = "| steps | success with the noise of training (%) | mean regret |\n|---|---|---|\n"
    for stage, fraction in enumerate(STAGES):
        stored = [np.load(path) for path in sorted(results.glob(f"scores-*-{stage}.npz"))]
        if not stored:
            continue
        for name in SCORES:
            pairs = [[_correlation(scores[name], scores[target]) for scores in stored] for target in TARGETS]
            pairs.append([_overlap(scores[name], scores["regret"]) for scores in stored])
            rows += f"| {fraction * steps / 1e6:g} M | {label(name)} | {' | '.join(map(_mean_and_range, pairs))} |\n"
        success = [100 * (1 - scores["failure_rate"].mean()) for scores in stored]
        regret = [scores["regret"].mean() for scores in stored]
        cells = f"{_mean_and_range(success, 1)} | {_mean_and_range(regret, 1)}"
        stages += f"| {fraction * steps / 1e6:g} M | {cells} |\n"
    return rows, stages


def _correlation(values: np.ndarray, target: np.ndarray) -> float:
    """Return Spearman's rank correlation where the target is known; NaN if either is constant there."""
    known = ~np.isnan(target)
    if known.sum() < 2 or np.ptp(values[known]) == 0 or np.ptp(target[known]) == 0:
        return float("nan")
    return float(spearmanr(values[known], target[known]).statistic)


def _overlap(values: np.ndarray, regret: np.ndarray) -> float:
    """Return the fraction of the tenth of the levels with the highest regret among that with the highest score."""
    count = len(regret) // 10
    # A random order of levels with the same score.
    order = np.lexsort((np.random.default_rng(0).random(len(values)), values))
    return len(set(order[-count:]) & set(np.argsort(regret)[-count:])) / max(1, count)


def _mean_and_range(values: Sequence[float], digits: int = 2) -> str:
    if np.isnan(values).any():
        return "-"
    return f"{np.mean(values):.{digits}f} [{min(values):.{digits}f}, {max(values):.{digits}f}]"


def tables(results: Path) -> dict[str, str]:
    """Return the tables of the results, in Markdown."""
    scores, stages = correlations(results)
    _, runs = score_tables(results, "levels", {name: label(name) for name in NAMES})
    return {"curricula-scores": scores, "curricula-stages": stages, "curricula-runs": runs}


def draw(results: Path, path: Path) -> None:
    """Draw success and SOC on the training split against the number of steps, means of the runs with their range."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
    for name in NAMES:
        file = results / f"{name}-curves.json"
        if not file.exists():
            continue
        curves = json.loads(file.read_text(encoding="utf-8"))
        for axis, measure, factor in zip(axes, ("success", "soc"), (100, 1), strict=True):
            values = factor * np.array([[line[measure] for line in curve] for curve in curves])
            (line,) = axis.plot([line["step"] / 1e6 for line in curves[0]], values.mean(axis=0), label=label(name))
            axis.fill_between(
                line.get_xdata(), values.min(axis=0), values.max(axis=0), color=line.get_color(), alpha=0.12, lw=0
            )
    for axis, text in zip(axes, ("success (%)", "SOC"), strict=True):
        axis.set(xlabel="environment steps (millions)", ylabel=text, ylim=(0, None))
    axes[1].legend(fontsize=8)
    with mpl.rc_context({"svg.hashsalt": "leapnav"}):  # the same bytes in each run
        figure.savefig(path, metadata={"Date": None})


def curve(run: Path) -> list[dict[str, Any]]:
    """Return step, success and SOC of the evaluations during a run."""
    lines = map(json.loads, (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines())
    return [
        {"step": line["step"], **{name: line[FAMILY][name] for name in ("success", "soc")}}
        for line in lines
        if not line["final"]
    ]


def main() -> None:
    """Train, score the levels and the policies, and draw the figure."""
    arguments = read_arguments(__doc__, NAMES, HERE)
    tiny, results, runs = arguments.tiny, arguments.results, arguments.runs / "curricula"
    runs.mkdir(parents=True, exist_ok=True)
    count, seeds = (10 if tiny else N_LEVELS), range(2 if tiny else SEEDS)
    path = runs / f"levels-{count}.bank"
    bank = build_bank(FAMILY, count, path, seed=LEVEL_SEED, workers=workers(), progress=not tiny)
    for name in arguments.names:
        found = []
        for seed in seeds:
            run, stages, options = runs / f"{name}-{seed}", runs / f"stages-{seed}", {}
            if name == "uniform":
                steps = 128 if tiny else read_config(SETTINGS)[1].total_timesteps
                options = {"callback": [Snapshots(stages, steps)]}
            levels = {"levels": name, "level_bank": None if name == "fresh" else path}
            found.append(train(SETTINGS, run, tiny=tiny, options=options, seed=seed, **levels))
            for stage in range(len(STAGES)) if name == "uniform" else ():
                scores = results / f"scores-{seed}-{stage}.npz"
                if not scores.exists():
                    model, config = PPO.load(stages / f"stage-{stage}.zip", device="cpu"), read_config(run)[1]
                    np.savez_compressed(scores, **score_levels(model, config, bank, 1 if tiny else EPISODES))
        (results / f"{name}-curves.json").write_text(json.dumps([curve(run) for run in found]), encoding="utf-8")
        test = ScenarioBank.shipped(FAMILY, "test")
        play(map(load, found), [test], results, name, count=2 if tiny else None, progress=not tiny)
    draw(results, FIGURE if arguments.out is None else results / "curricula.svg")
    print("\n".join(tables(results).values()))


if __name__ == "__main__":
    main()
