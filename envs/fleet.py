"""Robots in arenas of their own, all at once: what the single and the vector environment have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from leapnav.envs import driving
from leapnav.envs.bank import ScenarioBank
from leapnav.envs.driving import (
    CLEARANCE,
    COLUMNS,
    EFFORT,
    GUIDES,
    HERE,
    LAST_STEP,
    PROXIMITY,
    REMAINING,
    SPEED,
    SPIN,
    STEPS,
    TURN_RATE,
    VX,
)
from leapnav.envs.observations import Layout
from leapnav.envs.obstacles import clearance, sinc
from leapnav.envs.physics import ContactWorld, FreeBodies
from leapnav.envs.scenario import GOAL, TASK_COLUMNS, Scenario
from leapnav.envs.sensing import most_vertices
from leapnav.envs.settings import Settings

LONGEST_PIECE = 0.01  # s, of a period that forces drive
CONTACT_PIECE = 0.0025  # s, of a period in contact
NOISE_ROWS = 32  # control periods whose noise is drawn together


class Fleet:
    """The episodes of `count` robots that know nothing of each other.

    Args:
        count: number of robots.
        settings: see `Settings`.

    Attributes:
        layout: what is observed.
        poses (count, 3): x, y (m), heading (rad, unwrapped).
        state (count, COLUMNS): see `leapnav.envs.driving`.
        tasks (count, TASK_COLUMNS): see `leapnav.envs.scenario`.
        fields (count, L): packed obstacle fields, each row filled up with anything.

    """

    def __init__(self, count: int, settings: Settings) -> None:
        self.settings = settings
        self.layout = Layout(settings)
        self.state = np.zeros((count, COLUMNS))
        self.tasks = np.zeros((count, TASK_COLUMNS))
        self.fields = np.zeros((count, 0))
        self._packed = settings.packed()
        self._disturbed, self._motors = settings.disturbed, settings.motors
        self._maps = settings.observation == "map"
        self._pieces = math.ceil(settings.control_period / LONGEST_PIECE - 1e-9)
        self._lengths = np.zeros(count, dtype=int)
        self._guides = np.zeros((count, GUIDES, 3))
        motor = settings.motor
        self._free = FreeBodies(count, motor.mass, motor.moment, forces=settings.motors)
        self._contacts: dict[int, ContactWorld] = {}
        width = 7 + settings.lidar_beams if settings.disturbed else 0
        self._noise = np.zeros((count, NOISE_ROWS if settings.disturbed else 1, width))
        self._noise_rows = np.zeros(count, dtype=np.int64)
        self._generators: list[np.random.Generator | None] = [None] * count
        self._everyone, self._numbers = np.ones(count, dtype=bool), np.arange(count)

    @property
    def poses(self) -> np.ndarray:  # noqa: D102 (an attribute, see the class)
        return self._free.rows[:, :3]

    def begin(
        self,
        robots: Sequence[int] | np.ndarray,
        choices: Sequence[Scenario | int],
        bank: ScenarioBank | None = None,
        generators: Sequence[np.random.Generator] = (),
    ) -> None:
        """Starts episodes.

        Args:
            robots: their numbers.
            choices: for each a scenario, or the number of one in the bank.
            bank: that the numbers are of.
            generators: of the disturbances, one for each of these robots; none if nothing is disturbed.

        Raises:
            ValueError: a scenario does not fit the observation. No episode is started then.

        """
        numbers = np.asarray(robots, dtype=np.int64)
        fields = [_field_of(choice, bank) for choice in choices]
        for field in fields:
            self._check_fits(field)
        longest = max(map(len, fields))
        if longest > self.fields.shape[1]:
            # Whole cache lines, and an odd number of them: rows at powers of two would compete for the same places.
            wider = np.zeros((len(self.fields), 16 * math.ceil(longest / 16) + 8))
            wider[:, : self.fields.shape[1]] = self.fields
            self.fields = wider
        for i, choice, field in zip(numbers.tolist(), choices, fields, strict=True):
            self.fields[i, : len(field)] = field
            self._lengths[i] = len(field)
            if isinstance(choice, Scenario):
                self.tasks[i] = choice.task
            else:
                self.tasks[i] = _of(bank).tasks[choice]
            if self.settings.reward == "shaped":
                self._guides[i] = self._guide(choice, bank, self.tasks[i])
            self._contacts.pop(i, None)
        driving.start_episodes(
            numbers, self._free.rows, self.state, self.tasks, self.fields, self._guides, self._packed
        )
        if self._disturbed:
            for i, generator in zip(numbers.tolist(), generators, strict=True):
                self._generators[i] = generator
                self._draw_noise(i)

    def check(self, choice: Scenario | int | None, bank: ScenarioBank | None) -> None:
        """Checks that a scenario can be observed; with None, that all of the bank can.

        Raises:
            ValueError: it cannot.

        """
        if choice is not None:
            self._check_fits(_field_of(choice, bank))
        elif bank is not None:
            for number in range(len(bank)):
                self._check_fits(bank.field(number))

    def _check_fits(self, field: np.ndarray) -> None:
        if not self._maps:
            return
        vertices = most_vertices(field)
        if vertices > self.settings.map_vertices:
            raise ValueError(
                f"map_vertices: expected at least {vertices}, which a polygon of the scenario has, "
                f"got {self.settings.map_vertices}"
            )

    def _guide(self, choice: Scenario | int, bank: ScenarioBank | None, task: np.ndarray) -> np.ndarray:
        """Points (GUIDES, 3) with the way from there to the goal: along the reference, or the goal alone."""
        guides = np.zeros((GUIDES, 3))
        guides[:, :2] = task[GOAL : GOAL + 2]
        if not isinstance(choice, Scenario):
            path = _of(bank).states(choice)[:, :2].astype(float)
            way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
            picked = np.linspace(0, len(path) - 1, GUIDES).round().astype(int)
            guides[:, :2], guides[:, 2] = path[picked], way[-1] - way[picked]
        return guides

    def _draw_noise(self, i: int) -> None:
        generator = self._generators[i]
        assert generator is not None  # every robot that moves has begun
        self._noise[i] = generator.standard_normal(self._noise.shape[1:])

    def step(self, actions: np.ndarray, active: np.ndarray | None = None) -> None:
        """One control period.

        Args:
            actions (count, 2): float64.
            active (count,): bool, which robots take part; all if None. The others stay as they are.

        Raises:
            ValueError: an action is not finite; nothing has changed then.

        """
        active = self._everyone if active is None else active
        state, rows = self.state, self._free.rows
        if self._disturbed:
            self._noise_rows[:] = state[:, STEPS] % NOISE_ROWS
        faulty = driving.command(actions, active, state, self.tasks, self._noise, self._noise_rows, self._packed)
        if faulty >= 0:
            whose = "" if len(state) == 1 else f" for robot {faulty}"
            raise ValueError(f"action: expected two finite numbers, got {actions[faulty].tolist()}{whose}")
        if self._motors:
            for piece in range(self._pieces):
                driving.drive_motors(rows, state, self.tasks, self.fields, self._packed, piece, self._pieces)
                self._free.advance()
                driving.read_velocities(rows, state, self._pieces)
        else:
            driving.drive_arcs(rows, state, self.tasks, self.fields, self._packed)
            self._free.advance()
        if not self.settings.terminate_on_collision:
            for i in np.flatnonzero(state[:, REMAINING] > 0).tolist():
                self._drive_in_contact(i)
        driving.end_periods(rows, active, state, self.tasks, self._guides, self._packed)
        if self._disturbed:
            # What is sensed at the end of a period is disturbed by the next row, which the next period then drives by.
            for i in np.flatnonzero(active & (state[:, STEPS] % NOISE_ROWS == 0)).tolist():
                self._draw_noise(i)

    def _drive_in_contact(self, i: int) -> None:
        """The rest of a period after a touch."""
        row, body = self.state[i], self._free.rows[i]
        duration = float(row[REMAINING])
        field = self.field(i)
        motor = self.settings.motor
        if i not in self._contacts:
            self._contacts[i] = ContactWorld(field, motor.mass, motor.moment, motor.friction)
        pieces = math.ceil(duration / CONTACT_PIECE)
        step = duration / pieces
        speed, turn_rate = float(row[SPEED]), float(row[TURN_RATE])
        velocity = row[VX : SPIN + 1].copy()
        if self._motors:

            def control(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
                fx, fy, torque = driving.wheel_forces(vx, vy, heading, spin, speed, turn_rate, step, self._packed)
                return vx + fx / motor.mass * step, vy + fy / motor.mass * step, spin + torque / motor.moment * step
        else:

            def control(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
                along = speed * sinc(turn_rate * step / 2)
                middle = heading + turn_rate * step / 2
                return along * math.cos(middle), along * math.sin(middle), turn_rate

            velocity[:] = control(0.0, 0.0, float(body[2]), 0.0)
        lowest, speeds, turns, near = self._contacts[i].drive(body, velocity, control, duration, pieces)
        if self._motors:
            row[VX : SPIN + 1] = velocity
        row[EFFORT] += driving.effort(self.tasks, i, speeds, turns)
        row[PROXIMITY] += near
        row[HERE] = clearance(body[0], body[1], field)[0]
        row[CLEARANCE] = min(row[CLEARANCE], lowest)

    def field(self, i: int) -> np.ndarray:
        """The packed obstacle field of a robot's scenario."""
        return self.fields[i, : self._lengths[i]]

    def observe(self, out: np.ndarray, robots: np.ndarray | None = None) -> None:
        """Writes the flat observations into `out` (count, size), float32: of all, or of robots given by number."""
        if self._disturbed:
            self._noise_rows[:] = self.state[:, STEPS] % NOISE_ROWS
        arrays = self._free.rows, self.state, self.tasks, self.fields, self._noise, self._noise_rows
        self.layout.fill(self._numbers if robots is None else robots, *arrays, self._packed, out)

    def at_goal(self, i: int) -> bool:
        """Whether a robot's pose is its goal's, within the tolerances."""
        return bool(driving.at_goal(i, self._free.rows, self.tasks, self._packed))

    def at_horizon(self, i: int) -> bool:
        """Whether a robot's time is up."""
        return bool(self.state[i, STEPS] >= self.state[i, LAST_STEP])

    def ranges(self, i: int) -> np.ndarray:
        """A robot's lidar ranges, undisturbed; empty without a lidar."""
        return self.layout.scan(self._free.rows[i], self.field(i))

    def __getstate__(self) -> dict[str, Any]:
        # A contact has no memory from one period to the next, so it can be made again.
        return {**self.__dict__, "_contacts": {}}


def _of(bank: ScenarioBank | None) -> ScenarioBank:
    assert bank is not None  # numbers of scenarios come with their bank
    return bank


def _field_of(choice: Scenario | int, bank: ScenarioBank | None) -> np.ndarray:
    return choice.field if isinstance(choice, Scenario) else _of(bank).field(choice)
