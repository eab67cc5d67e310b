"""Planners as baselines: dynamic window, model predictive path integral, lattice, and the freespace assumption.

They drive the unicycle; scenario and state are read from the environment, as by `ExpertPolicy`. All but the last know
the map, and the first two also the motions of obstacles. Their constants were chosen on the training banks, see
`studies/planners`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from scipy.ndimage import map_coordinates

from leapnav.envs.field.clearance import footprint_clearances
from leapnav.envs.field.proximity import footprint_proximities
from leapnav.envs.geodesics import MAP_ENTRIES, geodesic_map, map_header_of
from leapnav.envs.scenarios.faults import ScenarioError
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.settings import FULL_CIRCLE
from leapnav.envs.simulation.sensing import scan
from leapnav.envs.unwrapping import action_scale, situations, unwrap
from leapnav.envs.utils.validation import check_choice
from leapnav.experts.acting.feedback import Feedback
from leapnav.experts.optimum import find_optimum
from leapnav.experts.search.candidates import CandidateSearch
from leapnav.experts.search.lattice import Lattice


class Driver(Protocol):
    """A planner in one episode."""

    def control(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Return speed (m/s) and turn rate (rad/s) for the next control period from a pose (3,) at a time (s)."""
        ...


class PlannerPolicy:
    """A planner for each robot of an environment.

    Args:
        env: the environment that the actions are for: `NavigateEnv` or `NavigateVectorEnv`, wrapped or not, or a
            Stable-Baselines3 `VecEnv` of them.
        planner: "dwa" (`DynamicWindow`), "mppi" (`PathIntegral`), "lattice" (`LatticeTracking`) or "freespace"
            (`FreespaceAssumption`).
        seed: random seed of "mppi".

    Raises:
        TypeError: the environment is not one of leapnav's.
        ValueError: `planner` is unknown, the robot is not the unicycle, or the environment has an action wrapper other
            than `RescaleAction` and `ClipAction`.

    """

    def __init__(self, env: Any, planner: str, seed: int = 0) -> None:
        check_choice("planner", planner, PLANNERS)
        self._planner, self._rng = PLANNERS[planner], np.random.default_rng(seed)
        self._envs, self._is_batch = unwrap(env), hasattr(env, "num_envs")
        self._factor, self._offset = action_scale(env)
        robot = self._envs[0].settings.robot
        if robot != "unicycle":
            raise ValueError(f"{planner}: expected the robot 'unicycle', whose controls it computes, got {robot!r}")
        self._episodes: dict[int, _Episode] = {}

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions (m,), or (N, m) for a vector environment, for its current step, and `state` unchanged."""
        actions = []
        for i, situation in enumerate(situations(self._envs)):
            scenario, time, episode = situation.scenario, situation.time, self._episodes.get(i)
            if episode is None or episode.scenario is not scenario or time < episode.time:
                episode = _Episode(scenario, self._planner(scenario, situation.period, self._rng), time)
                self._episodes[i] = episode
            episode.time = time
            controls = episode.driver.control(situation.state, time) if time < scenario.episode_limit else np.zeros(2)
            actions.append(np.clip(scenario.robot.actions(controls), -1.0, 1.0))
        found = (self._factor * np.array(actions) + self._offset).astype(np.float32)
        return (found if self._is_batch else found[0]), state


@dataclass
class _Episode:
    scenario: Scenario
    driver: Driver
    time: float


class Geodesics:
    """The distances (m) to the goal of a scenario, around obstacles, see `leapnav.envs.geodesics`."""

    def __init__(self, scenario: Scenario) -> None:
        packed = geodesic_map(scenario.field, *scenario.goal[:2])
        header = map_header_of(packed)
        self._corner, self._spacing = np.array([[header.x_min], [header.y_min]]), header.spacing
        self._distances = packed[MAP_ENTRIES:].reshape(header.nx, header.ny).astype(float)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (N,) of points (N, >= 2), by linear interpolation."""
        return map_coordinates(
            self._distances, (points[:, :2].T - self._corner) / self._spacing, order=1, mode="nearest"
        )

    def descents(self, points: np.ndarray) -> np.ndarray:
        """Return the directions (N,) (rad) in which the distance decreases most."""
        across = np.array([[self._spacing, 0.0], [0.0, self._spacing]])
        dx, dy = (self(points[:, :2] + step) - self(points[:, :2] - step) for step in across)
        return np.arctan2(-dy, -dx)


def arcs(poses: np.ndarray, controls: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the poses (N, K, 3) of the unicycle after times (K,) (s) with constant controls (N, 2) from poses (N, 3).

    Poses are x, y (m) and heading (rad), controls are speed (m/s) and turn rate (rad/s).
    """
    speed, turned = controls[:, :1], 0.5 * controls[:, 1:] * times
    chord, heading = speed * times * np.sinc(turned / math.pi), poses[:, 2:] + turned
    x, y = poses[:, :1] + chord * np.cos(heading), poses[:, 1:2] + chord * np.sin(heading)
    return np.stack([x, y, heading + turned], axis=-1)


def with_times(poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the poses (N, K, 3) with their times (K,), by which moving obstacles are displaced, as rows (N K, 4)."""
    columns = np.broadcast_to(times, poses.shape[:2])[..., None]
    return np.concatenate([poses, columns], axis=-1).reshape(-1, 4)


def wrapped(angle: Any) -> np.ndarray:
    """Return angles (rad) from -pi to pi."""
    return np.remainder(np.asarray(angle) + math.pi, 2 * math.pi) - math.pi


class DynamicWindow:
    """Dynamic window approach on the geodesic distance.

    D. Fox, W. Burgard, S. Thrun, "The dynamic window approach to collision avoidance" (1997); the navigation function
    instead of the bearing of the goal is that of O. Brock and O. Khatib, "High-speed navigation using the global
    dynamic window approach" (1999). The window is that of all controls, since the unicycle has no limits of the
    acceleration. At the goal the robot turns to its heading.

    Args:
        scenario: the scenario.
        period: control period (s).
        rng: unused.

    """

    SAMPLES: ClassVar = (13, 15)  # speeds and turn rates
    LOOKAHEAD, POINTS = 0.4, 4  # duration of an arc (s) and number of its points
    SAFE_CLEARANCE, CLEARANCE_WEIGHT, HEADING_WEIGHT = 0.15, 0.1, 0.15  # m, m, m/rad
    ARRIVED, TURNING_TIME = 0.08, 2.5  # m, s left for turning at the goal

    def __init__(self, scenario: Scenario, period: float, rng: np.random.Generator) -> None:
        self._scenario, self._period, self._distances = scenario, period, Geodesics(scenario)
        (low, high), (left, right) = scenario.robot.control_bounds().tolist()
        speeds, rates = np.linspace(low, high, self.SAMPLES[0]), np.linspace(left, right, self.SAMPLES[1])
        self._controls = np.stack(np.meshgrid(speeds, rates, indexing="ij"), axis=-1).reshape(-1, 2)
        self._times = np.linspace(0.0, self.LOOKAHEAD, self.POINTS + 1)[1:]

    def control(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Return the control of the best arc without contact; if all touch something, of the one least deep in it."""
        scenario = self._scenario
        goal_x, goal_y, heading = scenario.goal
        if math.hypot(goal_x - pose[0], goal_y - pose[1]) < self.ARRIVED:
            error = 0.0 if heading is None else float(wrapped(heading - pose[2]))
            return np.array([0.0, error / (2.0 * self._period)])
        here = float(self._distances(pose[None])[0])
        left = max(scenario.episode_limit - time - self.TURNING_TIME, self.LOOKAHEAD)
        speed = scenario.cruise_speed if scenario.horizon is None else here / left
        # Finer speeds around the desired one
        controls = np.concatenate([self._controls, self._controls * [min(1.0, speed / self._controls[-1, 0]), 1.0]])
        paths = arcs(np.broadcast_to(pose, (len(controls), 3)), controls, self._times)
        states = with_times(paths, time + self._times)
        clearances = (
            footprint_clearances(states, scenario.outline, scenario.field).reshape(len(controls), -1).min(axis=1)
        )
        ends = paths[:, -1]
        ahead = self._distances(ends)
        progress = np.abs(ahead - max(here - speed * self.LOOKAHEAD, 0.0))
        turn = np.abs(wrapped(self._distances.descents(ends) - ends[:, 2]))
        turn = np.where(controls[:, 0] < 0, math.pi - turn, turn)  # backwards
        near = np.maximum(self.SAFE_CLEARANCE - clearances, 0.0) / self.SAFE_CLEARANCE
        score = progress + self.HEADING_WEIGHT * turn * np.minimum(ahead, 1.0) + self.CLEARANCE_WEIGHT * near
        return controls[int(np.where(clearances > 0.0, score, score + 1e3 - 1e3 * clearances).argmin())]


class PathIntegral:
    """Model predictive path integral control.

    G. Williams et al., "Information theoretic MPC for model-based reinforcement learning" (ICRA 2017), algorithm 2:
    the mean of sampled control sequences, weighted by their costs, is the sequence around which the next are sampled.
    The cost is that of the scenario, with a penalty for contact; the cost-to-go at the end of a sequence is that of the
    geodesic distance at constant speed, and near the goal that of the remaining turn.

    Args:
        scenario: the scenario.
        period: control period (s).
        rng: generator of the samples.

    """

    SAMPLES, STEPS, STEP = 256, 20, 0.1  # number of sequences and of controls in each, duration of a control (s)
    NOISE: ClassVar = (0.25, 0.6)  # standard deviations (m/s, rad/s)
    TEMPERATURE = 0.1  # in units of the cost
    CONTACT = 100.0  # cost of a point in contact
    FREE_FACTOR = 2.0  # of the cost-to-go with a free horizon; with 1, the robot may stop short of the goal
    NEAR, END_WEIGHT = 1.0, 0.01  # m; smallest time left (s) in the cost-to-go

    def __init__(self, scenario: Scenario, period: float, rng: np.random.Generator) -> None:
        self._scenario, self._period, self._rng, self._distances = scenario, period, rng, Geodesics(scenario)
        self._mean, self._time = np.zeros((self.STEPS, 2)), 0.0
        self._bounds = scenario.robot.control_bounds()
        self._weights = np.array(scenario.robot.control_weight(scenario.cost))

    def control(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Return the first control of the mean sequence."""
        shifted = int((time - self._time) / self.STEP + 1e-9)
        if shifted:
            self._mean = np.concatenate([self._mean[shifted:], np.repeat(self._mean[-1:], shifted, axis=0)])
            self._time += shifted * self.STEP
        noise = self._rng.standard_normal((self.SAMPLES, self.STEPS, 2)) * self.NOISE
        noise[0] = 0.0
        controls = np.clip(self._mean + noise, self._bounds[:, 0], self._bounds[:, 1])
        costs = self._costs(pose, time, controls)
        weights = np.exp(-(costs - costs.min()) / self.TEMPERATURE)
        self._mean = np.tensordot(weights / weights.sum(), controls, axes=1)
        return self._mean[0]

    def _costs(self, pose: np.ndarray, time: float, controls: np.ndarray) -> np.ndarray:
        """Return the costs of control sequences (K, STEPS, 2)."""
        scenario, count = self._scenario, len(controls)
        ends = np.minimum(self._time + self.STEP * np.arange(1, self.STEPS + 1), scenario.episode_limit)
        durations = np.diff(ends, prepend=time)
        durations = np.maximum(durations, 0.0)
        turned = controls[:, :, 1] * durations
        headings = pose[2] + np.cumsum(turned, axis=1)
        middle = headings - 0.5 * turned
        chord = controls[:, :, 0] * durations * np.sinc(0.5 * turned / math.pi)
        x, y = pose[0] + np.cumsum(chord * np.cos(middle), axis=1), pose[1] + np.cumsum(chord * np.sin(middle), axis=1)
        states = with_times(np.stack([x, y, headings], axis=-1), ends)
        phi = footprint_proximities(states, scenario.outline, scenario.field).reshape(count, -1)
        contact = footprint_clearances(states, scenario.outline, scenario.field).reshape(count, -1) <= 0.0
        effort = 0.5 * (controls**2 @ self._weights)
        running = (effort + scenario.cost.time_weight + np.minimum(phi, self.CONTACT)) @ durations
        return (
            running
            + self.CONTACT * contact.sum(axis=1)
            + self._cost_to_go(states[self.STEPS - 1 :: self.STEPS], ends[-1])
        )

    def _cost_to_go(self, poses: np.ndarray, time: float) -> np.ndarray:
        """Return estimates of the cost from poses (N, 3) at a time (s) to the goal."""
        scenario, distance = self._scenario, self._distances(poses)
        heading = scenario.goal[2]
        turn = np.zeros(len(poses)) if heading is None else wrapped(heading - poses[:, 2])
        turn = turn * np.exp(-distance / self.NEAR)
        speed_weight, turn_weight = self._weights
        if scenario.horizon is None:
            # At constant speed, the cheapest path of length d costs d sqrt(2 c r).
            length = np.sqrt(speed_weight * distance**2 + turn_weight * turn**2)
            return self.FREE_FACTOR * math.sqrt(2.0 * scenario.cost.time_weight) * length
        left = max(scenario.horizon - time, self.END_WEIGHT)
        return (speed_weight * distance**2 + turn_weight * turn**2) / (2.0 * left)


class LatticeTracking:
    """The shortest path on the lattice of the expert's search, followed by a tracking controller.

    The lattice has positions and 16 headings, and its metric is the cost, as in planners of the kind of hybrid A* (D.
    Dolgov et al., "Path planning for autonomous vehicles in unknown semi-structured environments", 2010). The path is
    not optimised. The controller is that of Y. Kanayama, Y. Kimura, F. Miyazaki, T. Noguchi, "A stable tracking control
    method for an autonomous mobile robot" (ICRA 1990), equation 8, with the absolute value of the speed in the gain of
    the heading error. Moving obstacles are ignored.

    Args:
        scenario: the scenario.
        period: control period (s).
        rng: unused.

    """

    GAINS: ClassVar = (8.0, 80.0, 16.0)  # K_x (1/s), K_y (1/m^2), K_theta (1/m)
    TURN_GAIN, TURNING_TIME = 8.0, 0.7  # of the heading error at rest (1/s), time at the end of the path (s)

    def __init__(self, scenario: Scenario, period: float, rng: np.random.Generator) -> None:
        self._period = period
        path = next(CandidateSearch(Lattice(scenario, strict=True)).candidates(), None)
        if path is None:
            self._path = None
            return
        # The last node is next to the goal: the path is shifted so that it ends there, and the robot turns at the end.
        times = path.times[:-1] / path.times[-2] * max(path.times[-2] - self.TURNING_TIME, 0.5 * path.times[-2])
        poses = path.poses[:-1].copy()
        poses[:, :2] += np.outer(times / times[-1], path.poses[-1, :2] - path.poses[-2, :2])
        self._path = (
            np.append(times, times[-1] + self._period),
            np.concatenate([poses, [[*poses[-1, :2], path.poses[-1, 2]]]]),
        )

    def control(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Return the control towards the path's pose at the end of the control period; zero if there is no path."""
        if self._path is None:
            return np.zeros(2)
        times, poses = self._path
        now, following = (
            np.array([np.interp(t, times, column) for column in poses.T]) for t in (time, time + self._period)
        )
        step = following - now
        speed = (step[0] * math.cos(now[2]) + step[1] * math.sin(now[2])) / self._period
        rate = step[2] / self._period
        dx, dy = now[:2] - pose[:2]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        ahead, left, turn = cos * dx + sin * dy, cos * dy - sin * dx, float(wrapped(now[2] - pose[2]))
        k_x, k_y, k_theta = self.GAINS
        gain = k_theta * abs(speed) + self.TURN_GAIN
        return np.array([speed * math.cos(turn) + k_x * ahead, rate + speed * k_y * left + gain * math.sin(turn)])


class FreespaceAssumption:
    """The expert with the obstacles that lidar has met so far; elsewhere it assumes free space.

    S. Koenig and Y. Smirnov, "Sensor-based planning with the freespace assumption" (ICRA 1997), with the optimum
    instead of the shortest path. An obstacle is known as a whole, with its motion, from the moment at which a beam
    meets it; the optimum from the current state is then searched again. While there is none, the robot stands still.

    Args:
        scenario: the scenario.
        period: control period (s).
        rng: unused.

    """

    BEAMS, RANGE = 128, 10.0  # of the lidar, as of the included policies with lidar alone; the range in m

    def __init__(self, scenario: Scenario, period: float, rng: np.random.Generator) -> None:
        self._scenario, self._period = scenario, period
        angles = FULL_CIRCLE / self.BEAMS * np.arange(self.BEAMS)
        self._beams, self._scratch = np.stack([np.cos(angles), np.sin(angles)]), np.empty((3, 2 * self.BEAMS))
        self._empty = self._with_obstacles(())
        self._unseen = {i: self._with_obstacles((i,)) for i in range(len(scenario.obstacles))}
        self._plan: tuple[float, Feedback] | None = None  # the time (s) at which it begins, and the feedback

    def control(self, pose: np.ndarray, time: float) -> np.ndarray:
        """Return the control in the middle of the period; zero while no optimum is known."""
        seen = self._seen(pose, time)
        for i in seen:
            del self._unseen[i]
        if seen or time == 0.0:
            self._plan = self._planned(pose, time)
        if self._plan is None:
            return np.zeros(2)
        start, feedback = self._plan
        feedback.update(pose, time - start)
        return feedback.control(time - start + 0.5 * min(self._period, self._scenario.episode_limit - time))

    def _with_obstacles(self, numbers: Iterable[int]) -> Scenario:
        """Return the scenario with some of its obstacles."""
        return self._scenario.model_copy(update={"obstacles": tuple(self._scenario.obstacles[i] for i in numbers)})

    def _seen(self, pose: np.ndarray, time: float) -> list[int]:
        """Return the numbers of the obstacles that a beam meets for the first time."""
        if not self._unseen:
            return []
        ranges, without = self._ranges(self._scenario, pose, time), self._ranges(self._empty, pose, time)
        alone = {i: self._ranges(scenario, pose, time) for i, scenario in self._unseen.items()}
        return [i for i, found in alone.items() if ((found <= ranges) & (found < without)).any()]

    def _ranges(self, scenario: Scenario, pose: np.ndarray, time: float) -> np.ndarray:
        x, y, heading = pose[:3]
        scan(x, y, heading, time, scenario.field, (self.RANGE, FULL_CIRCLE), self._beams, self._scratch)
        return self._scratch[2, : self.BEAMS].copy()

    def _planned(self, pose: np.ndarray, time: float) -> tuple[float, Feedback] | None:
        """Return a plan from a pose among the obstacles seen so far."""
        seen = self._with_obstacles(i for i in range(len(self._scenario.obstacles)) if i not in self._unseen)
        try:
            rest = seen.from_state(pose, time)
        except ScenarioError:  # in contact
            return None
        optimum = find_optimum(rest, "medium")
        if not optimum.success:
            return None
        try:
            return time, Feedback(rest, optimum)
        except ValueError:  # no feedback along the optimum
            return None


PLANNERS: dict[str, type[Any]] = {
    "dwa": DynamicWindow,
    "mppi": PathIntegral,
    "lattice": LatticeTracking,
    "freespace": FreespaceAssumption,
}
