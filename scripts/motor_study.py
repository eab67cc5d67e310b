"""Compare policies of robots with motors and disturbances with the policy of the ideal robot that they start from.

python scripts/motor_study.py                # trains three seeds in runs/motors (skips finished runs), scores them
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from leapnav.envs import NavigateEnv
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.experts.data.banks import build_bank
from leapnav.training import (
    PPOConfig,
    evaluate,
    load_policy,
    make_policy,
    policy_environment,
    score,
    train_ppo,
)
from leapnav.training.policies.actors import copy_actor

FAMILY, TRAINED_WITH, SEEDS = "clutter", 0.2, 3
DISTURBANCES = (0.2, 0.1, 0.0)  # of the evaluations
SCENARIOS, BANK_SEED = 4000, 779


def main() -> None:
    """Train, and print the scores and the paired differences of the success rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/motors"))
    folder = parser.parse_args().runs
    runs = [folder / f"seed-{seed}" for seed in range(SEEDS)]
    for seed, run in enumerate(runs):
        if not (run / "policy.json").exists():
            options = {"actuation": "motor", "disturbance": TRAINED_WITH, "warm_start": (Path(FAMILY),)}
            train_ppo(PPOConfig.tuned(FAMILY, **options, out=run, seed=seed, evaluate_every=500_000))
    path = folder / "fresh.bank"
    if not path.exists():
        build_bank(FAMILY, SCENARIOS, path, seed=BANK_SEED)
    bank = ScenarioBank(path)
    sensors = {**policy_environment(FAMILY), "actuation": "motor"}
    env = NavigateEnv(FAMILY, split="fresh", **sensors)
    start = load_policy(FAMILY)
    ideal = make_policy(env.observation_space, env.action_space, hidden=(256, 256, 256))
    copy_actor(start, ideal)
    for disturbance in DISTURBANCES:
        environment = {**sensors, "disturbance": disturbance}
        before = evaluate(ideal, bank, environment=environment, timed=False)
        print(f"disturbance {disturbance}, the policy of the ideal robot: {score(FAMILY, before)}", flush=True)
        for run in runs:
            after = evaluate(load_policy(run), bank, environment=environment, timed=False)
            pairs = [(a.success, b.success) for a, b in zip(before, after, strict=True)]
            gained, lost = (sum(pair == wanted for pair in pairs) for wanted in ((False, True), (True, False)))
            p = binomtest(gained, max(1, gained + lost)).pvalue  # McNemar's exact test
            gain = float(np.mean([b - a for a, b in pairs]))
            print(f"{run}: {score(FAMILY, after)}\n  gain {100 * gain:.1f} %, p <= {max(p, 1e-300):.0e}", flush=True)


if __name__ == "__main__":
    main()
