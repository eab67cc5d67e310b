"""Study of curricula: scores of levels beside the regret, and PPO from scratch with each level sampler.

python scripts/curriculum_study.py                          # everything; finished parts are skipped
python scripts/curriculum_study.py --only uniform --seeds 0 # trains these runs only
python scripts/curriculum_study.py --tables                 # trains nothing; prints the tables, draws the figure
"""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import matplotlib
import numpy as np
import torch as th
from scipy.stats import spearmanr
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.experts.data.banks import build_bank
from leapnav.training import PPOConfig, train_ppo
from leapnav.training.config import LevelsName
from leapnav.training.runs.reinforcement import make_training_env

matplotlib.use("svg")
import matplotlib.pyplot as plt

FAMILY, N_LEVELS, LEVEL_SEED = "clutter", 2000, 782
STEPS, SEEDS = 500_000, 3
STAGES = (0.0, 0.1, 0.25, 0.5, 1.0)  # fractions of a run at which the scores of all levels are computed
# Of each level, with the noise of training. The scores and what they are compared with are computed from different
# episodes, so that their errors are independent.
EPISODES = 4
N_ROBOTS = 500
SAMPLERS = get_args(LevelsName)
SCORES = ("positive_value_loss", "max_mc", "learnability", "failures")
NAMES = {"max_mc": "MaxMC", "failures": "failure rate"}


class Snapshots(BaseCallback):
    """Save the model at the stages of a run."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._next = len(list(folder.glob("stage-*.zip")))  # of a resumed run, which repeats what it saved already

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._next < len(STAGES) and self.num_timesteps >= STAGES[self._next] * STEPS:
            self._save()

    def _on_training_end(self) -> None:
        if self._next < len(STAGES):
            self._save()

    def _save(self) -> None:
        self.model.save(self._folder / f"stage-{self._next}.zip")
        self._next += 1


def configuration(levels: str, seed: int, runs: Path) -> PPOConfig:
    """Return the settings of a run: the defaults of PPO from scratch, except the levels and the number of steps."""
    bank = None if levels == "fresh" else runs / "levels.bank"
    changes: dict[str, Any] = {"levels": levels, "level_bank": bank, "total_timesteps": STEPS, "seed": seed}
    intervals = {"evaluate_every": STEPS // 5, "evaluation_scenarios": 200}
    return PPOConfig.tuned(FAMILY, out=runs / f"{levels}-{seed}", **changes, **intervals)


def train(config: PPOConfig, stages: Path | None) -> None:
    """Train with a level sampler, unless the run is finished; save the stages if a directory is given."""
    if is_finished(config.out):
        return
    callbacks = []
    if stages is not None:
        stages.mkdir(parents=True, exist_ok=True)
        callbacks.append(Snapshots(stages))
    train_ppo(replace(config, resume=(config.out / "config.json").exists()), callback=callbacks)


def is_finished(run: Path) -> bool:
    """Whether the final evaluation of a run exists."""
    lines = evaluations(run)
    return bool(lines) and lines[-1]["final"]


def evaluations(run: Path) -> list[dict[str, Any]]:
    """Return the evaluations of a run."""
    path = run / "evaluations.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@th.no_grad()
def play(model: PPO, venv: Any, indices: np.ndarray) -> dict[str, np.ndarray]:
    """Play one episode of each of N levels with the noise of training.

    Returns:
        `rewards`, `values` and `running` (T, N), the last bool; `returns`, without the shaped and the graded reward,
        `costs` and `success` (N,).

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
            ends["returns"][i] = last["reward_collision"] + last["reward_miss"] - last["cost"]
        alive &= ~dones
    return {**{name: np.array(column) for name, column in rows.items()}, **ends}


def score_levels(model: PPO, config: PPOConfig, bank: ScenarioBank) -> dict[str, np.ndarray]:
    """Return the scores, the failure rate, the regret and the regret of the successes, (N,), of the levels of a bank.

    The regret is -J* minus the mean return of the episodes; that of the successes is NaN without any.
    """
    venv = make_training_env(replace(config, n_envs=N_ROBOTS, levels="uniform", level_bank=bank.path))
    columns: dict[str, list[np.ndarray]] = {}
    for first in range(0, len(bank), N_ROBOTS):
        indices = np.arange(first, first + N_ROBOTS)
        episodes = [play(model, venv, indices) for _ in range(2 * EPISODES)]
        found = _scores(episodes[:EPISODES], config.gae_lambda) | _targets(episodes[EPISODES:], bank.costs[indices])
        for name, column in found.items():
            columns.setdefault(name, []).append(column)
    venv.close()
    return {name: np.concatenate(column) for name, column in columns.items()}


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


def correlate(runs: Path, seeds: Sequence[int]) -> None:
    """Write the scores of all levels at the stages of the runs with uniformly drawn levels."""
    bank = ScenarioBank(runs / "levels.bank")
    for seed in seeds:
        for stage in range(len(STAGES)):
            path, model = runs / f"scores-{seed}-{stage}.npz", runs / f"stages-{seed}" / f"stage-{stage}.zip"
            if not path.exists() and model.exists():
                scores = score_levels(PPO.load(model, device="cpu"), configuration("uniform", seed, runs), bank)
                np.savez(path, **scores)
                print(f"wrote {path}", flush=True)


def print_correlations(runs: Path) -> None:
    """Print the rank correlations of the scores with the regret, the mean over the seeds with the range."""
    print("| steps | score | regret | failure rate | regret of successes | top 10 % |")
    print("|---|---|---|---|---|---|")
    for stage, fraction in enumerate(STAGES):
        stored = [np.load(path) for path in sorted(runs.glob(f"scores-*-{stage}.npz"))]
        if not stored:
            continue
        for name in SCORES:
            cells = []
            for target in ("regret", "failure_rate", "success_regret"):
                found = []
                for scores in stored:
                    known = ~np.isnan(scores[target])
                    found.append(spearmanr(scores[name][known], scores[target][known]).statistic)
                cells.append(_mean_and_range(found))
            cells.append(_mean_and_range([_overlap(scores[name], scores["regret"]) for scores in stored]))
            label = NAMES.get(name, name.replace("_", " "))
            print(f"| {fraction * STEPS / 1e6:g} M | {label} | {' | '.join(cells)} |")
        rates = [1 - scores["failure_rate"].mean() for scores in stored]
        regrets = [scores["regret"].mean() for scores in stored]
        print(f"<!-- success {_mean_and_range(rates)}, mean regret {_mean_and_range(regrets)} -->")


def _overlap(score: np.ndarray, regret: np.ndarray) -> float:
    """Return the fraction of the tenth of the levels with the highest regret among that with the highest score."""
    count = len(regret) // 10
    # A random order of levels with the same score.
    order = np.lexsort((np.random.default_rng(0).random(len(score)), score))
    return len(set(order[-count:]) & set(np.argsort(regret)[-count:])) / count


def _mean_and_range(values: Sequence[float]) -> str:
    if np.isnan(values).any():
        return "-"
    return f"{np.mean(values):.2f} [{min(values):.2f}, {max(values):.2f}]"


def print_results(runs: Path) -> None:
    """Print the final success, SOC and regret of the runs with each sampler, the means and the values of the seeds."""
    print("| levels | success (%) | SOC | median regret (%) |\n|---|---|---|---|")
    for levels in SAMPLERS:
        finals = [evaluations(run)[-1][FAMILY] for run in finished(runs, levels)]
        if finals:
            columns = (("success", 100, 1), ("soc", 1, 3), ("regret", 100, 0))
            cells = []
            for name, factor, digits in columns:
                values = [math.nan if final[name] is None else factor * final[name] for final in finals]
                single = ", ".join(f"{value:.{digits}f}" for value in values)
                cells.append(f"{np.mean(values):.{digits}f} ({single})")
            print(f"| {NAMES.get(levels, levels.replace('_', ' '))} | {' | '.join(cells)} |")


def finished(runs: Path, levels: str) -> list[Path]:
    """Return the finished runs with a level sampler."""
    return [run for run in sorted(runs.glob(f"{levels}-[0-9]*")) if is_finished(run)]


def draw(runs: Path, path: Path) -> None:
    """Draw success and SOC on the test split against the number of steps, means of the seeds with their range."""
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained", sharex=True)
    for levels in SAMPLERS:
        curves = [evaluations(run) for run in finished(runs, levels)]
        if not curves:
            continue
        n = min(map(len, curves))
        steps = np.array([line["step"] for line in curves[0][:n]]) / 1e6
        for axis, name, factor in zip(axes, ("success", "soc"), (100, 1), strict=True):
            values = factor * np.array([[line[FAMILY][name] for line in curve[:n]] for curve in curves])
            (line,) = axis.plot(steps, values.mean(axis=0), label=NAMES.get(levels, levels.replace("_", " ")))
            axis.fill_between(steps, values.min(axis=0), values.max(axis=0), color=line.get_color(), alpha=0.12, lw=0)
    for axis, label in zip(axes, ("success (%)", "SOC"), strict=True):
        axis.set(xlabel="environment steps (millions)", ylabel=label, ylim=(0, None))
    axes[1].legend(fontsize=8)
    figure.savefig(path)
    print(f"wrote {path}")


def main() -> None:
    """Train, compute the scores, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/curricula"))
    parser.add_argument("--only", nargs="+", default=SAMPLERS, choices=SAMPLERS, help="level samplers to train with")
    parser.add_argument("--seeds", nargs="+", type=int, default=range(SEEDS))
    parser.add_argument("--tables", action="store_true", help="print the tables of what is finished")
    parser.add_argument("--figure", type=Path, default=Path("docs/images/curricula.svg"))
    arguments = parser.parse_args()
    runs = arguments.runs
    runs.mkdir(parents=True, exist_ok=True)
    if not arguments.tables:
        if not (runs / "levels.bank").exists():
            build_bank(FAMILY, N_LEVELS, runs / "levels.bank", seed=LEVEL_SEED)
        for seed in arguments.seeds:
            for levels in arguments.only:
                stages = runs / f"stages-{seed}" if levels == "uniform" else None
                train(configuration(levels, seed, runs), stages)
        correlate(runs, arguments.seeds)
    print_results(runs)
    print_correlations(runs)
    draw(runs, arguments.figure)


if __name__ == "__main__":
    main()
