"""Batched simulation of independent robots, shared by the single and the vector environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from leapnav.envs.geodesics import geodesic_map, solve_eikonal
from leapnav.envs.kernels import prepare
from leapnav.envs.kernels.internals import FunctionPointer
from leapnav.envs.robots.base import ARCS, GENERAL
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import GOAL, LIMITS, Scenario
from leapnav.envs.scenarios.sources import get_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.shapes.clearance import clearances, footprint_clearance, footprint_clearances
from leapnav.envs.shapes.proximity import proximity_value
from leapnav.envs.simulation import stepping
from leapnav.envs.simulation.bodies import ContactWorld, FreeBodies, resolve_overlap
from leapnav.envs.simulation.observations import ObservationLayout, observe_robots
from leapnav.envs.simulation.paths import ADVANCE_FUNCTION, STATE_COST_FUNCTION, RobotMotion, no_state_cost
from leapnav.envs.simulation.sensing import check_map
from leapnav.envs.simulation.state import (
    CLEARANCE,
    COLUMNS,
    EFFORT,
    LAST_STEP,
    N_GUIDE_POINTS,
    POSE_CLEARANCE,
    PROXIMITY,
    REMAINING,
    SPEED,
    SPIN,
    STEPS,
    TURN_RATE,
    VX,
    SharedFields,
    SimulationState,
    guide_points,
)
from leapnav.envs.utils.validation import in_words

MAX_MOTOR_STEP = 0.01  # s, substep of a control period with motors
MAX_CONTACT_STEP = 0.0025  # s, substep of a control period in contact
NOISE_ROWS = 32  # control periods whose noise is sampled together


class BatchSimulator:
    """Simulate the episodes of independent robots, each in its own arena.

    Args:
        count: number of robots.
        settings: settings of the environment.

    Attributes:
        settings: settings of the environment.
        layout: observation space, and the parts of an observation.
        poses (count, 3): x, y (m) and heading (rad, unwrapped).
        motion (count, n - 3): further states of the robots.
        state (count, COLUMNS): see `leapnav.envs.simulation.state`.
        tasks (count, K): see `leapnav.envs.scenarios.scenario`.
        fields: the packed obstacle fields.

    """

    def __init__(self, count: int, settings: EnvironmentSettings) -> None:
        prepare(*_kernels(settings))
        self.settings = settings
        self.layout = ObservationLayout(settings)
        self.state = np.zeros((count, COLUMNS))
        n, m = settings.model.sizes()
        self._n_motion, self._n_controls = n - 3, m
        self._robots = np.zeros((count, n - 3 + m + 3 + 2))
        self.tasks = np.zeros((count, LIMITS + 2 * m + 2 * (n - 3)))
        self._drive, self._drives_paths = settings.model.drive, settings.model.drive == GENERAL
        self._pointers: tuple[FunctionPointer, FunctionPointer] | None = None
        self.fields = SharedFields(count)
        self._packed = settings.packed()
        self._record: tuple[np.ndarray, ...] | None = None
        self._free_horizon = settings.free_horizon
        self._disturbed, self._motors = settings.disturbed, settings.motors
        self._maps, self._geodesic = settings.observation == "map", settings.observation == "geodesic"
        self._geodesic_maps = np.zeros((count, 0), np.float32)
        self._substeps = math.ceil(settings.control_period / MAX_MOTOR_STEP - 1e-9)
        self._guides = np.zeros((count, N_GUIDE_POINTS, 3))
        motor = settings.motor
        self._free = FreeBodies(count, motor.mass, motor.moment, forces=settings.motors)
        self._contacts: dict[int, ContactWorld] = {}
        width = 2 * m + 3 + settings.lidar_beams if settings.disturbed else 0
        self._noise = np.zeros((count, NOISE_ROWS if settings.disturbed else 1, width))
        self._noise_rows = np.zeros(count, dtype=np.int64)
        self._generators: list[np.random.Generator | None] = [None] * count
        self._all_active, self._all_robots = np.ones(count, dtype=bool), np.arange(count)

    @property
    def poses(self) -> np.ndarray:  # noqa: D102 (documented as an attribute of the class)
        return self._free.rows[:, :3]

    @property
    def motion(self) -> np.ndarray:  # noqa: D102 (documented as an attribute of the class)
        return self._robots[:, : self._n_motion]

    @property
    def _first_disc(self) -> int:
        """Column of the first disc in the array of the robots."""
        return self._n_motion + self._n_controls + 3

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        """The episodes as the record that the kernels take."""
        if self._record is None:
            self._record = tuple(
                SimulationState(
                    bodies=self._free.rows,
                    robots=self._robots,
                    state=self.state,
                    tasks=self.tasks,
                    fields=self.fields.places,
                    guides=self._guides,
                    noise=self._noise,
                    noise_rows=self._noise_rows,
                    maps=self._geodesic_maps,
                    settings=self._packed,
                )
            )
        return self._record

    def reset(
        self,
        robots: Sequence[int] | np.ndarray,
        choices: Sequence[Scenario | int],
        bank: ScenarioBank | None = None,
        generators: Sequence[np.random.Generator] = (),
    ) -> None:
        """Start episodes.

        Args:
            robots: indices of the robots.
            choices: for each robot a scenario, or the index of a scenario in the bank.
            bank: the bank that the indices refer to.
            generators: random generators of the noise, one for each of these robots; empty without noise.

        Raises:
            ValueError: a scenario does not fit the observation. No episode is started then.

        """
        indices = np.asarray(robots, dtype=np.int64)
        scenarios = [get_scenario(choice, bank) for choice in choices]
        for scenario in scenarios:
            self._check_scenario(scenario)
        references = [self._reference(choice, bank) for choice in choices]
        self._make_room(max(len(one.task) for one in scenarios), max(_required_discs(one.discs) for one in scenarios))
        m, first = self._n_controls, self._first_disc
        for i, scenario, reference in zip(indices.tolist(), scenarios, references, strict=True):
            self.fields[i], task, discs = scenario.field, scenario.task, scenario.discs
            self.tasks[i, : len(task)] = task
            row = self._robots[i]
            row[first:] = 0.0
            row[first : first + discs.size] = discs.ravel()
            if self._free_horizon:
                row[first - 1] = task[-1]
            if self.settings.reward == "shaped":
                if self._drive == ARCS:
                    row[first - 3 : first - 1] = task[LIMITS + m : LIMITS + 2 * m]
                else:
                    row[first - 3 : first - 1] = scenario.robot.metric(scenario.cost)
                self._guides[i] = guide_points(task[GOAL : GOAL + 2], reference)
            self._contacts.pop(i, None)
        if self._geodesic:
            self._store_maps(indices, [scenario.field for scenario in scenarios])
        stepping.start_episodes(indices, self._arrays)
        if self._disturbed:
            for i, generator in zip(indices.tolist(), generators, strict=True):
                self._generators[i] = generator
                self._draw_noise(i)

    def _reference(self, choice: Scenario | int, bank: ScenarioBank | None) -> np.ndarray | None:
        """Return the path (N, n) of the optimum that guides the shaped reward; None without such a reward or path."""
        if self.settings.reward != "shaped" or isinstance(choice, Scenario) or bank is None:
            return None
        return bank.states(choice)

    def _check_scenario(self, scenario: Scenario) -> None:
        """Check that a scenario is one for this environment.

        Raises:
            ValueError: the scenario has another robot or another kind of horizon, or an obstacle has more vertices than
                the map.

        """
        if scenario.robot.model != self.settings.robot:
            raise ValueError(
                f"robot: this environment is for {self.settings.robot!r}, but scenario {scenario.name!r} has the robot "
                f"{scenario.robot.model!r}; make the environment with robot={scenario.robot.model!r}"
            )
        if scenario.horizon_kind != self.settings.horizon:
            raise ValueError(
                f"horizon: this environment is for a {self.settings.horizon} horizon, but that of scenario "
                f"{scenario.name!r} is {scenario.horizon_kind}; make the environment with "
                f"horizon={scenario.horizon_kind!r}"
            )
        if self._maps:
            check_map(scenario.field, self.settings.map_vertices)

    def _make_room(self, n_columns: int, n_discs: int) -> None:
        """Enlarge the arrays of tasks and footprints."""
        if n_columns > self.tasks.shape[1]:
            self.tasks = np.pad(self.tasks, ((0, 0), (0, n_columns - self.tasks.shape[1])))
            self._record = None
        missing = self._first_disc + 2 * n_discs - self._robots.shape[1]
        if missing > 0:
            self._robots, self._record = np.pad(self._robots, ((0, 0), (0, missing))), None
            self._drives_paths = True

    def check(self, choice: Scenario | int | None, bank: ScenarioBank | None) -> None:
        """Check that a scenario fits the observation.

        Args:
            choice: a scenario, or the index of a scenario in the bank; None checks all scenarios of the bank.
            bank: the bank, or None.

        Raises:
            ValueError: see `_check_scenario`.

        """
        if choice is not None:
            self._check_scenario(get_scenario(choice, bank))
        elif bank is not None:
            for scenario in bank if self._maps else bank[:1]:
                self._check_scenario(scenario)

    def _store_maps(self, robots: np.ndarray, fields: Sequence[np.ndarray]) -> None:
        """Store the geodesic maps of robots whose tasks are stored, with given obstacle fields."""
        maps = [geodesic_map(f, *self.tasks[i, GOAL : GOAL + 2].tolist()) for i, f in zip(robots, fields, strict=True)]
        missing = max(map(len, maps)) - self._geodesic_maps.shape[1]
        if missing > 0:
            self._geodesic_maps, self._record = np.pad(self._geodesic_maps, ((0, 0), (0, missing))), None
        for i, packed in zip(robots.tolist(), maps, strict=True):
            self._geodesic_maps[i, : len(packed)] = packed

    def _draw_noise(self, i: int) -> None:
        generator = self._generators[i]
        assert generator is not None  # set by `reset`
        self._noise[i] = generator.standard_normal(self._noise.shape[1:])

    def step(self, actions: np.ndarray, active: np.ndarray | None = None) -> None:
        """Simulate one control period.

        Args:
            actions (count, m): float64.
            active (count,): bool, the robots to simulate; None for all. The state of the others is unchanged.

        Raises:
            ValueError: an action is not finite; the state is unchanged then.

        """
        active = self._all_active if active is None else active
        state, arrays = self.state, self._arrays
        if self._disturbed:
            self._noise_rows[:] = state[:, STEPS] % NOISE_ROWS
        start = stepping.command if self._motors or self._drive == GENERAL else stepping.drive_arcs
        invalid = start(actions, active, arrays)
        if invalid >= 0:
            robot = "" if len(state) == 1 else f" for robot {invalid}"
            expected = in_words(actions.shape[1])
            raise ValueError(f"action: expected {expected} finite numbers, got {actions[invalid].tolist()}{robot}")
        if self._motors:
            bodies, substeps = self._free.rows, self._substeps
            for substep in range(substeps):
                stepping.drive_motors(bodies, state, self.tasks, self.fields.places, self._packed, substep, substeps)
                self._free.advance()
            stepping.read_velocities(bodies, state, substeps)
        else:
            if self._drives_paths:
                stepping.drive_paths(arrays, self._robot_motion)
            self._free.advance()
        if not self.settings.terminate_on_collision:
            for i in np.flatnonzero(state[:, REMAINING] > 0).tolist():
                self._drive_in_contact(i)
        stepping.end_periods(active, arrays)
        if self._disturbed:
            # The observation at the end of a period uses the noise row of the next period.
            for i in np.flatnonzero(active & (state[:, STEPS] % NOISE_ROWS == 0)).tolist():
                self._draw_noise(i)

    @property
    def _robot_motion(self) -> RobotMotion:
        """The kernels of the robot's model."""
        if self._pointers is None:
            model = self.settings.model
            self._pointers = (
                FunctionPointer(model.advance, ADVANCE_FUNCTION),
                FunctionPointer(model.state_cost or no_state_cost, STATE_COST_FUNCTION),
            )
        return RobotMotion(*self._pointers)

    def _drive_in_contact(self, i: int) -> None:
        """Simulate the rest of a period after a contact."""
        row, body = self.state[i], self._free.rows[i]
        duration = float(row[REMAINING])
        field, discs = self.fields[i], self._robots[i, self._first_disc :].reshape(-1, 2)
        discs = discs[discs[:, 1] > 0.0]
        discs.flags.writeable = False
        motor = self.settings.motor
        if i not in self._contacts:
            self._contacts[i] = ContactWorld(field, discs, motor.mass, motor.moment, motor.friction)
        substeps = math.ceil(duration / MAX_CONTACT_STEP)
        step = duration / substeps
        command = self._command(i, step)
        velocity = row[VX : SPIN + 1].copy() if self._motors else np.array(command(0.0, 0.0, float(body[2]), 0.0))
        motion = self.motion[i].copy()
        lowest, speeds, turn_rates, proximity = self._contacts[i].drive(body, velocity, command, duration, substeps)
        if self._motors:
            row[VX : SPIN + 1] = velocity
        model = self.settings.model
        if model.velocity_states is not None:  # what the contact has left of the velocity
            ahead = velocity[0] * math.cos(body[2]) + velocity[1] * math.sin(body[2])
            for name, value in zip(model.velocity_states, (ahead, velocity[2]), strict=True):
                self.motion[i, model.state_names.index(name) - 3] = value
        if self._drive == ARCS:
            row[EFFORT] += stepping.effort(self.tasks, i, speeds, turn_rates)
        else:
            # The controls are held, and further states change by them also in contact; the state cost is that at both
            # ends of the period.
            row[EFFORT] += stepping.control_effort(self.tasks, self._controls(i), i) * duration
            if model.state_cost is not None:
                parameters = self._parameters(i)
                ends = [np.concatenate([body[:3], values]) for values in (motion, self.motion[i])]
                row[EFFORT] += sum(model.state_cost(q, parameters) for q in ends) / 2 * duration
        row[PROXIMITY] += proximity
        row[POSE_CLEARANCE] = footprint_clearance(body[0], body[1], body[2], discs, field)[0]
        row[CLEARANCE] = min(row[CLEARANCE], lowest)

    def _controls(self, i: int) -> np.ndarray:
        """Return the controls (m,) of a robot in its period."""
        if self._drive == ARCS:
            return np.array([self.state[i, SPEED], self.state[i, TURN_RATE]])
        return self._robots[i, self._n_motion : self._n_motion + self._n_controls].copy()

    def _parameters(self, i: int) -> np.ndarray:
        """Return the parameters of a robot's model."""
        return self.tasks[i, LIMITS + 2 * self._n_controls + 2 * self._n_motion :]

    def _command(self, i: int, step: float) -> Callable[[float, float, float, float], tuple[float, float, float]]:
        """Return the function from the velocity of a robot in contact to that of its next step without contact."""
        row, motor, model = self.state[i], self.settings.motor, self.settings.model
        if self._motors:
            speed, turn_rate = float(row[SPEED]), float(row[TURN_RATE])

            def track(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
                fx, fy, torque = stepping.wheel_forces(vx, vy, heading, spin, speed, turn_rate, step, self._packed)
                return vx + fx / motor.mass * step, vy + fy / motor.mass * step, spin + torque / motor.moment * step

            return track
        controls, parameters, new = self._controls(i), self._parameters(i), np.zeros(3 + self._n_motion)

        def follow(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
            q = np.array([0.0, 0.0, heading, *self.motion[i]])
            model.advance(q, controls, step, parameters, new)
            self.motion[i] = new[3:]
            return new[0] / step, new[1] / step, (new[2] - heading) / step

        return follow

    def observe(self, out: np.ndarray, robots: np.ndarray | None = None) -> None:
        """Write flat observations to `out` (count, size), float32: of all robots, or of those given by index."""
        if self._disturbed:
            self._noise_rows[:] = self.state[:, STEPS] % NOISE_ROWS
        self.layout.fill(self._all_robots if robots is None else robots, self._arrays, out)

    def at_goal(self, i: int) -> bool:
        """Return whether the pose of a robot equals its goal, within the tolerances."""
        return bool(stepping.at_goal(i, SimulationState(*self._arrays)))

    def at_horizon(self, i: int) -> bool:
        """Return whether the episode of a robot has reached the horizon."""
        return bool(self.state[i, STEPS] >= self.state[i, LAST_STEP])

    def ranges(self, i: int) -> np.ndarray:
        """Return the lidar ranges of a robot without noise (m); empty without a lidar."""
        return self.layout.scan(self._free.rows[i], self.fields[i])

    def __getstate__(self) -> dict[str, Any]:
        # Contact worlds have no memory between periods, so they can be created again.
        return {**self.__dict__, "_contacts": {}, "_record": None, "_pointers": None}


def _required_discs(discs: np.ndarray) -> int:
    """Return the number of discs in the array of footprints; one is for discs around the robot's position only."""
    return 1 if len(discs) == 1 and discs[0, 0] == 0.0 else max(len(discs), 2)


# Kernels that only some observations need.
OBSERVING = {"geodesic": solve_eikonal}


def _kernels(settings: EnvironmentSettings) -> tuple[Any, ...]:
    """Return the kernels of a step, so that those not in the cache are compiled together."""
    motors = stepping.command, stepping.drive_motors, stepping.read_velocities
    moving = motors if settings.motors else (stepping.drive_arcs,)
    if settings.model.drive == GENERAL:
        moving = (
            stepping.command,
            stepping.drive_paths,
            settings.model.advance,
            settings.model.state_cost or no_state_cost,
        )
    if settings.reward == "shaped":  # the optima of banks, which guide the robots, are checked
        moving = *moving, footprint_clearance, proximity_value
    if settings.observation in OBSERVING:
        moving = *moving, OBSERVING[settings.observation]
    if not settings.terminate_on_collision:
        moving = *moving, settings.model.advance, resolve_overlap, proximity_value, stepping.wheel_forces
    sampling = clearances, footprint_clearances
    return *sampling, stepping.start_episodes, *moving, stepping.end_periods, observe_robots
