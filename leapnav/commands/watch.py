"""`leapnav watch`: episodes of a policy, in a window or as a video."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from leapnav.commands.options import Family, Horizon, Obstacles, PolicyName, Robot
from leapnav.outputs import check_outputs, write_json

if TYPE_CHECKING:
    import gymnasium as gym


@dataclass(frozen=True)
class Watch:
    """Watch a policy drive beside the optimum (the orange line), in a window or as a video."""

    policy: PolicyName = "expert"
    """Policy: a baseline, an included policy, the directory of a policy or of a run, or a model of Stable-Baselines3
    (.zip)."""
    family: Family | None = None
    """Family of the scenarios, or a bank (.bank); by default that of the training of the policy, or clutter."""
    robot: Robot = "unicycle"
    """Model of the robot, for the expert and the baselines; a learned policy has its own."""
    horizon: Horizon = "fixed"
    """Fixed or free horizon, for the expert and the baselines; a learned policy has its own."""
    obstacles: Obstacles | None = None
    """Obstacles with a proximity cost, or hard obstacles, which cost nothing; by default those of the training of the
    policy, or with a proximity cost."""
    split: Literal["train", "test", "fresh"] | None = None
    """Split of the included banks, or "fresh" for newly sampled scenarios; by default "test", and "fresh" for a family
    without included banks."""
    index: int | None = None
    """Index in the bank of the first episode's scenario; later episodes play the following ones. By default random."""
    episodes: int = 3
    """Number of episodes."""
    seed: int = 0
    """Seed of the choice of scenarios, of the disturbances and of the random policy."""
    actuation: Literal["velocity", "motor"] = "velocity"
    """Actuation of the robot."""
    disturbance: float = 0.0
    """Standard deviation of the noise on motion and sensing; see the documentation of the environment."""
    video: Path | None = None
    """Video file (.mp4) to write instead of opening a window."""
    json: Path | None = None
    """JSON file of the results of the episodes; "-" for standard output."""

    def run(self) -> int:
        """Play the episodes."""
        from leapnav.envs.utils.validation import check_at_least

        check_at_least("episodes", self.episodes, 1)
        if self.index is not None and self._scenarios().get("split") == "fresh":
            raise ValueError(f"index: fresh scenarios have no index, got {self.index}; use --split train or test")
        check_outputs(self.json, video=self.video)
        self._sensors()  # reports an unknown policy before a window opens
        if self.video is not None:
            return self._record(self.video)
        import pygame

        # SDL falls back to drivers without a display; then nothing would appear.
        pygame.display.init()
        if pygame.display.get_driver() in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
            raise OSError("no display for a window; --video FILE.mp4 writes a video instead")
        env = self._make("human")
        try:
            self._play(env)
        finally:
            env.close()
        return 0

    def _record(self, video: Path) -> int:
        import tempfile

        from gymnasium.error import DependencyNotInstalled
        from gymnasium.wrappers import RecordVideo

        with tempfile.TemporaryDirectory(dir=video.absolute().parent, prefix=".leapnav-watch-") as directory:
            try:
                env = RecordVideo(
                    self._make("rgb_array"),
                    str(Path(directory) / "videos"),
                    step_trigger=lambda step: step == 0,
                    video_length=2**62,  # all episodes in one video, until the environment is closed
                    name_prefix="watch",
                    disable_logger=True,
                )
            except DependencyNotInstalled:
                raise OSError('a video needs moviepy: pip install "leapnav[video]"') from None
            try:
                self._play(env)
            finally:
                env.close()
            written = next(Path(directory).glob("videos/*.mp4"))
            written.replace(video)
        print(f"wrote {video}")
        return 0

    def _sensors(self) -> dict[str, Any]:
        """Return the arguments of the environment that determine the policy's observations."""
        from leapnav.training.policies.files import policy_environment
        from leapnav.training.scoring.policy_specs import BASELINES

        own = {"robot": self.robot, "horizon": self.horizon}
        return own if self.policy in BASELINES else policy_environment(self.policy)

    def _scenarios(self) -> dict[str, Any]:
        """Return the arguments of the environment that select the scenarios."""
        from leapnav.envs.scenarios.bank import ScenarioBank
        from leapnav.envs.scenarios.families import BANK_ENDING
        from leapnav.training.policies.files import read_description
        from leapnav.training.policies.zips import is_zip
        from leapnav.training.scoring.policy_specs import BASELINES

        is_learned = self.policy not in BASELINES and not is_zip(self.policy)
        training = read_description(self.policy)["training"] if is_learned else {}
        family = self.family or training.get("family") or "clutter"
        if family.endswith(BANK_ENDING):
            return {"bank": family}
        obstacles = self.obstacles or training.get("obstacles") or "cost"
        kinds = {name: value for name, value in self._sensors().items() if name in ("robot", "horizon")}
        included = ScenarioBank.shipped_families(**kinds, obstacles=obstacles)
        split = self.split or ("test" if family in included else "fresh")
        return {"family": family, "split": split, "obstacles": obstacles}

    def _make(self, render_mode: str) -> gym.Env[Any, Any]:
        import gymnasium as gym

        arguments = {**self._sensors(), "actuation": self.actuation, "disturbance": self.disturbance}
        return gym.make(
            "leapnav/Navigate-v0", **self._scenarios(), render_mode=render_mode, show_optimum=True, **arguments
        )

    def _play(self, env: gym.Env[Any, Any]) -> None:
        """Play and report the episodes, until the window is closed."""
        from leapnav.envs.episodes import act_with, play_episode
        from leapnav.envs.navigation import NavigateEnv
        from leapnav.envs.unwrapping import unwrap
        from leapnav.experts.optimum import find_reached_optimum
        from leapnav.training.scoring.policy_specs import make_policy_from_spec

        (inner,) = unwrap(env)
        assert isinstance(inner, NavigateEnv)
        last = None if self.index is None else self.index + self.episodes - 1
        if last is not None and inner.bank is not None and not 0 <= last - self.episodes + 1 <= last < len(inner.bank):
            raise ValueError(f"index: the bank has scenarios 0 to {len(inner.bank) - 1}, got {self.index} to {last}")
        policy, results = make_policy_from_spec(self.policy, env, seed=self.seed), []
        for episode in range(self.episodes):
            options = None if self.index is None or inner.bank is None else {"index": self.index + episode}
            seed = self.seed if episode == 0 else None
            _, info, steps = play_episode(env, act_with(policy), seed=seed, options=options)
            scenario = inner.scenario.name
            reference = info["reference_cost"] if inner.index is not None else None
            for step in steps:
                info = step.info
                if inner.window_closed:
                    break
            if inner.window_closed:
                break
            result = "success" if info["is_success"] else "collision" if info["collision"] else "missed the goal"
            measured: dict[str, Any] = {name: float(info[name]) for name in ("time", "cost")}
            text = f"{scenario}: {result} after {info['time']:.1f} s, cost {info['cost']:.3f}"
            if info["is_success"]:
                optimum = find_reached_optimum(inner.scenario, inner.state, measured["cost"])
                measured["optimal_cost"] = optimum.cost if optimum.success else None
                if optimum.success:
                    text += f", optimum for the state reached {optimum.cost:.3f}"
            print(text)
            results.append({"scenario": scenario, "result": result, **measured, "reference_cost": reference})
        write_json(results, self.json)
