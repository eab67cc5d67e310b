"""`leapnav watch`: look at a policy, in a window or as a video."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from leapnav.outputs import check_outputs, write_json

if TYPE_CHECKING:
    import gymnasium as gym

    from leapnav.training.evaluation import Policy


@dataclass(frozen=True)
class Watch:
    """Watch a policy drive beside the optimum (the orange line), in a window or as a video."""

    policy: str = "expert"
    """Folder of a policy or of a run, the name of one that ships, "expert", "random" or "go-to-goal"."""
    family: str = "clutter"
    """Family of the scenarios: open, clutter, polygons, rooms or slalom."""
    split: Literal["train", "test", "fresh"] = "test"
    """Scenarios of a bank that ships with leapnav, or newly drawn ones."""
    index: int | None = None
    """Number of the scenario in the bank; the following episodes play the following ones. By default random ones."""
    episodes: int = 3
    """How many episodes."""
    seed: int = 0
    """Of the choice of scenarios, the disturbances and the random policy."""
    actuation: Literal["velocity", "motor"] = "velocity"
    """How the robot moves."""
    disturbance: float = 0.0
    """Noise on motion and sensing, see the environment's documentation."""
    video: Path | None = None
    """Write a video (.mp4) instead of opening a window."""
    json: Path | None = None
    """Write how the episodes ended."""

    def run(self) -> int:
        """Plays the episodes."""
        if self.episodes < 1:
            raise ValueError(f"episodes: expected at least 1, got {self.episodes}")
        if self.index is not None and self.split == "fresh":
            raise ValueError(f"index: a newly drawn scenario has no number, got {self.index}")
        check_outputs(self.json, video=self.video)
        if self.video is not None:
            return self._film(self.video)
        import pygame

        # SDL has drivers that draw nowhere; nobody asked for one.
        pygame.display.init()
        if pygame.display.get_driver() in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
            raise OSError("no display for a window; --video FILE.mp4 writes a video instead")
        env = self._make("human")
        try:
            self._play(env)
        finally:
            env.close()
        return 0

    def _film(self, video: Path) -> int:
        import tempfile

        from gymnasium.error import DependencyNotInstalled
        from gymnasium.wrappers import RecordVideo

        with tempfile.TemporaryDirectory(dir=video.absolute().parent, prefix=".leapnav-watch-") as folder:
            try:
                env = RecordVideo(
                    self._make("rgb_array"),
                    str(Path(folder) / "videos"),
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
            written = next(Path(folder).glob("videos/*.mp4"))
            written.replace(video)
        print(f"wrote {video}")
        return 0

    def _make(self, render_mode: str) -> gym.Env[Any, Any]:
        import gymnasium as gym

        from leapnav.training.entrants import BASELINES
        from leapnav.training.policies import policy_environment

        sensors = {} if self.policy in BASELINES else policy_environment(self.policy)
        arguments = {**sensors, "actuation": self.actuation, "disturbance": self.disturbance}
        return gym.make(
            "leapnav/Navigate-v0", family=self.family, split=self.split, render_mode=render_mode, **arguments
        )

    def _play(self, env: gym.Env[Any, Any]) -> None:
        import numpy as np

        from leapnav.envs.navigation import NavigateEnv

        inner = env.unwrapped
        assert isinstance(inner, NavigateEnv)
        last = None if self.index is None else self.index + self.episodes - 1
        if last is not None and inner.bank is not None and not 0 <= last - self.episodes + 1 <= last < len(inner.bank):
            raise ValueError(f"index: the bank has scenarios 0 to {len(inner.bank) - 1}, got {self.index} to {last}")
        policy, results = self._load(env), []
        for episode in range(self.episodes):
            options = None if self.index is None or inner.bank is None else {"index": self.index + episode}
            observation, info = env.reset(seed=self.seed if episode == 0 else None, options=options)
            scenario, reference = info["scenario"].name, info.get("reference_cost")
            state, start, done = None, True, False
            while not done:
                action, state = policy.predict(observation, state, np.array([start]), deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                start, done = False, terminated or truncated
                if inner.window_closed:
                    break
            if inner.window_closed:
                break
            result = "success" if info["is_success"] else "collision" if info["collision"] else "missed the goal"
            optimum = "" if reference is None else f", optimum {reference:.3f}"
            print(f"{scenario}: {result} after {info['time']:.1f} s, cost {info['cost']:.3f}{optimum}")
            measured = {name: float(info[name]) for name in ("time", "cost")}
            results.append({"scenario": scenario, "result": result, **measured, "reference_cost": reference})
        write_json(results, self.json)

    def _load(self, env: gym.Env[Any, Any]) -> Policy:
        from leapnav.training.entrants import make_entrant

        return make_entrant(self.policy, env, seed=self.seed)
