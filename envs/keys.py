"""Actions of keys, with which a person drives."""

from __future__ import annotations

import itertools

import numpy as np

from leapnav.envs.robots.base import RobotModel

KEY_ACTION = 0.5  # fraction of the range of the controls on each side of its middle


def driving_controls(model: type[RobotModel]) -> np.ndarray:
    """Return the controls (2, m), relative to their limits, that drive a robot ahead and turn it to the left."""
    return np.asarray(model.key_controls or np.eye(2, model.sizes()[1]), dtype=np.float32)


def keys_to_action(model: type[RobotModel]) -> dict[str | tuple[str | int, ...], np.ndarray]:
    """Return the actions of keys for a robot model, see `NavigateEnv.get_keys_to_action`."""
    import pygame

    forwards, left = driving_controls(model)
    # Gymnasium takes the empty text for "no key"; an empty tuple is an error.
    actions: dict[str | tuple[str | int, ...], np.ndarray] = {"": np.zeros_like(left)}
    for keys in (("w", "s", "a", "d"), (pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT)):
        for ahead, turn in itertools.product((0, 1, -1), repeat=2):
            pressed = [keys[0 if ahead > 0 else 1]] * (ahead != 0) + [keys[2 if turn > 0 else 3]] * (turn != 0)
            if pressed:
                action = KEY_ACTION * (ahead * forwards + turn * left)
                actions[tuple(pressed)] = np.clip(action, -1.0, 1.0).astype(np.float32)
    return actions
