"""Symmetries of the navigation task, as transformations of observations and actions, and policies that have them.

The cost does not depend on the sign of the controls. Hence a mirrored optimum is optimal in the mirrored scenario, if
the robot's model has this symmetry (`RobotModel.mirror`). An optimum with all headings rotated by 180 degrees is
optimal in the scenario with the start and goal headings rotated by 180 degrees, if the model has that symmetry
(`RobotModel.reversal`): the robot follows the same path with the opposite driving mode.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import NamedTuple

import torch as th

from leapnav.envs.robots import RobotModel, Symmetry
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation.observations import ObservationLayout
from leapnav.training.policies.mixture import Mixture

# Signs of the first entries of the observation (see the docstring of the environment) under each symmetry.
_MIRROR_SIGNS = th.tensor([1.0, -1, 1, -1, 1, 1, -1, 1, -1])
_TIME_REVERSE_SIGNS = th.tensor([-1.0, -1, 1, 1, 1, -1, -1, 1, 1])
# Those of the observed motion of a robot with motors: speed ahead, speed to the left, turn rate.
_MIRROR_MOTION, _TIME_REVERSE_MOTION = (1, -1, -1), (-1, -1, 1)


class Transformation(NamedTuple):
    """A transformation of observations and actions that is its own inverse.

    Attributes:
        observation (d,): for each entry of the transformed observation the number of the entry, from 1, that it is
            equal to; negative numbers: to its negative.
        action (m, m): matrix of the action.

    """

    observation: tuple[int, ...]
    action: tuple[tuple[float, ...], ...]

    def __call__(self, observations: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the transformed observations (B, d) and actions (B, m)."""
        entries = th.tensor(self.observation, device=observations.device)
        changed = observations.index_select(1, entries.abs() - 1) * entries.sign()
        return changed, actions @ th.tensor(self.action).to(actions).T


def symmetries(settings: EnvironmentSettings, robots: Iterable[RobotModel]) -> tuple[Transformation, ...]:
    """Return the transformations that are symmetries of the task for all robots and that the observation allows.

    There is none with `observation="map"`, whose rows have no order, nor for observations in a Dict. Time reversal
    needs a lidar with an even number of beams around the full circle, or none.

    Args:
        settings: settings of the environment of the observations.
        robots: the robots.

    """
    robots, found = list(robots), []
    if settings.observation == "map" or settings.dict_observation or settings.goal_conditioned:
        return ()
    if _have(robots, settings.model.mirror):
        found.append(mirror(settings))
    is_circle = not settings.has_lidar or (settings.has_full_circle and settings.lidar_beams % 2 == 0)
    outlines = (robot.outline()[:, :2].sum(axis=1) for robot in robots)
    if is_circle and _have(robots, settings.model.reversal) and all((middles == 0.0).all() for middles in outlines):
        found.append(time_reversal(settings))
    return tuple(found)


def _have(robots: Sequence[RobotModel], symmetry: Symmetry | None) -> bool:
    """Return whether the model and the limits of all robots have a symmetry."""
    return symmetry is not None and all(robot.has_symmetric_limits(symmetry) for robot in robots)


@cache
def mirror(settings: EnvironmentSettings) -> Transformation:
    """Return the exchange of left and right.

    Args:
        settings: settings of the environment of the observations.

    Raises:
        ValueError: the model has no mirror symmetry.

    """
    symmetry = _require(settings, "mirror", settings.model.mirror)

    def reflected(values: th.Tensor) -> th.Tensor:
        if not settings.has_full_circle:
            return values.flip(1)
        return th.cat([values[:, :1], values[:, 1:].flip(1)], dim=1)

    motion = _MIRROR_MOTION if settings.motors else symmetry.motion
    return _transformation(settings, _MIRROR_SIGNS, motion, symmetry.controls, reflected)


@cache
def time_reversal(settings: EnvironmentSettings) -> Transformation:
    """Return the exchange of forwards and backwards: the robot and the goal heading are rotated by 180 degrees.

    Args:
        settings: settings of the environment of the observations.

    Raises:
        ValueError: the number of lidar beams is odd, their field of view is not the full circle, or the model has no
            such symmetry.

    """
    symmetry = _require(settings, "reversal", settings.model.reversal)
    if settings.has_lidar and not settings.has_full_circle:
        raise ValueError(f"time reversal needs a lidar_fov of 2 pi rad, got {settings.lidar_fov:g}")
    if settings.has_lidar and settings.lidar_beams % 2:
        raise ValueError(f"time reversal needs an even number of lidar beams, got {settings.lidar_beams}")

    def rotated(values: th.Tensor) -> th.Tensor:
        return values.roll(values.shape[1] // 2, dims=1)

    motion = _TIME_REVERSE_MOTION if settings.motors else symmetry.motion
    return _transformation(settings, _TIME_REVERSE_SIGNS, motion, symmetry.controls, rotated)


def _require(settings: EnvironmentSettings, name: str, symmetry: Symmetry | None) -> Symmetry:
    if symmetry is None:
        raise ValueError(f"{name}: the robot {settings.robot!r} does not have this symmetry")
    return symmetry


def _transformation(
    settings: EnvironmentSettings,
    signs: th.Tensor,
    motion: Sequence[float],
    controls: tuple[tuple[float, ...], ...],
    moved: Callable[[th.Tensor], th.Tensor],
) -> Transformation:
    """Return the transformation with other signs of goal and motion and moved values of the beams."""

    def velocities(values: th.Tensor) -> th.Tensor:
        ahead, left = (moved(half) for half in values.chunk(2, dim=1))  # the velocity of what each beam meets
        return th.cat([float(signs[0]) * ahead, float(signs[1]) * left], dim=1)

    changes: dict[str, Callable[[th.Tensor], th.Tensor]] = {
        "goal": lambda values: values * signs[: values.shape[1]],
        "motion": lambda values: values * th.tensor(motion),
        "action": lambda values: values @ th.tensor(controls, dtype=values.dtype).T,
        "lidar": moved,
        "detours": moved,
        "distance": lambda values: values,
        "velocities": velocities,
    }
    layout = ObservationLayout(settings)
    # The transformation of the numbers of the entries; the frames of a history are transformed like the current one.
    frames = th.arange(1.0, 1.0 + layout.size).reshape(-1, layout.frame)
    changed = th.cat([changes[name](frames[:, part]) for name, part in layout.parts.items()], dim=1)
    return Transformation(tuple(changed.flatten().int().tolist()), controls)


class Symmetrised:
    """The action of a network for the images of an observation under all combinations of transformations.

    The action is the mean of those for the images, or, of a network with a mixture, the mode of the mixture of the
    components for all images. It is equivariant, unless two modes are equal: an observation that is transformed leads
    to the transformed action. The errors of the network for the images partly cancel.

    Args:
        transformations: at least one; they commute, such as those of `symmetries`.

    """

    def __init__(self, transformations: Sequence[Transformation]) -> None:
        n_entries, n_controls = len(transformations[0].observation), len(transformations[0].action)
        numbers, actions = th.arange(1.0, 1.0 + n_entries)[None], th.eye(n_controls)
        images = [(numbers, actions)]
        for transformation in transformations:
            images += [transformation(*image) for image in images]
        numbers = th.cat([image for image, _ in images])
        self._entries, self._signs = numbers.abs().long() - 1, numbers.sign()
        # The rows of a matrix are the images of the components of an action. The combinations are their own inverses.
        self._matrices = th.stack([matrix for _, matrix in images])

    def __call__(self, network: Callable[[th.Tensor], Mixture], observations: th.Tensor) -> th.Tensor:
        """Return the actions (B, m) of a network for observations (B, d)."""
        device, n_images = observations.device, len(self._entries)
        images = observations[:, self._entries.to(device)] * self._signs.to(device)
        actions, log_weights = (part.unflatten(0, (-1, n_images)) for part in network(images.flatten(0, 1)))
        matrices = self._matrices.to(device)
        if log_weights.shape[2] == 1:
            return th.einsum("bki,kij->bj", actions[:, :, 0], matrices) / n_images
        actions = th.einsum("bkci,kij->bkcj", actions, matrices)
        return Mixture(actions.flatten(1, 2), log_weights.flatten(1)).mode()
