"""Batched simulation of independent robots, shared by the single and the vector environment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from leapnav.envs.field.clearance import clearances, footprint_clearance, footprint_clearances
from leapnav.envs.field.proximity import footprint_value
from leapnav.envs.field.rectangle import OUTLINE_ENTRIES
from leapnav.envs.geodesics import geodesic_map, solve_eikonal
from leapnav.envs.kernels import prepare
from leapnav.envs.kernels.internals import FunctionPointer, places_of, writable
from leapnav.envs.kernels.types import constant
from leapnav.envs.scenarios.bank import ScenarioBank
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.scenarios.sources import get_scenario
from leapnav.envs.settings import EnvironmentSettings
from leapnav.envs.simulation import stepping
from leapnav.envs.simulation.bodies import ContactWorld, MotorBodies, VelocityFunction, resolve_overlap
from leapnav.envs.simulation.observations import ObservationLayout, observe_robots
from leapnav.envs.simulation.paths import ADVANCE_FUNCTION, STATE_COST_FUNCTION, coast, no_state_cost
from leapnav.envs.simulation.sensing import check_map
from leapnav.envs.simulation.state import (
    EPISODE,
    EPISODE_FORMAT,
    N_GUIDE_POINTS,
    SIMULATION,
    Episode,
    FieldStore,
    Simulation,
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
        episodes (count,): records of `leapnav.envs.simulation.state.Episode`.
        states (count, n): states of the robots.
        fields: the packed obstacle fields.

    """

    def __init__(self, count: int, settings: EnvironmentSettings) -> None:
        prepare(*_kernels(settings))
        self.settings = settings
        self.layout = ObservationLayout(settings, count)
        n, m = settings.model.sizes()
        self.episodes, self.states = np.zeros(count, EPISODE), np.zeros((count, n))
        self.fields = FieldStore(count)
        self._geodesic = settings.observation == "geodesic"
        width = 2 * m + 3 + settings.lidar_beams if settings.disturbed else 0
        self._noise = np.zeros((count, NOISE_ROWS if settings.disturbed else 1, width))
        self._generators: list[np.random.Generator | None] = [None] * count
        self._simulation = Simulation(
            episodes=self.episodes,
            states=self.states,
            controls=np.zeros((count, m)),
            goals=np.zeros((count, n)),
            middles=np.zeros((count, m)),
            halves=np.zeros((count, m)),
            weights=np.zeros((count, m)),
            parameters=np.zeros((count, 0)),
            outlines=np.zeros((count, 1, OUTLINE_ENTRIES)),
            fields=self.fields.places,
            guides=np.zeros((count, N_GUIDE_POINTS, 3)),
            noise=self._noise,
            maps=np.zeros((count, 0), np.float32),
            settings=settings.packed(),
        )
        self._connect()
        self._substeps = math.ceil(settings.control_period / MAX_MOTOR_STEP - 1e-9)
        self._bodies = MotorBodies(count, settings.motor) if settings.motors else None
        self._contacts: dict[int, ContactWorld] = {}
        self._masses: list[tuple[float | None, ...]] = [()] * count  # of the obstacles
        self._all_active, self._all_robots = np.ones(count, dtype=bool), np.arange(count)

    def _connect(self) -> None:
        """Prepare the arguments of the kernels."""
        self._places = places_of(self._simulation, SIMULATION)
        model = self.settings.model
        advance, cost = (coast, None) if self.settings.motors else (model.advance, model.state_cost)
        self._pointers = (
            FunctionPointer(advance, ADVANCE_FUNCTION),
            FunctionPointer(cost or no_state_cost, STATE_COST_FUNCTION),
        )
        self._addresses = tuple(pointer.address for pointer in self._pointers)

    def _replace(self, **arrays: np.ndarray) -> None:
        """Replace arrays of the simulation."""
        self._simulation = self._simulation._replace(**arrays)
        self._places = places_of(self._simulation, SIMULATION)

    def episode(self, i: int) -> Episode:
        """Return the episode of a robot."""
        return Episode._make(EPISODE_FORMAT.unpack_from(cast(Any, self.episodes), i * EPISODE.itemsize))

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
        self._make_room(scenarios)
        sim = self._simulation
        self.episodes[indices] = np.zeros((), EPISODE)
        self.layout.actions[indices] = 0.0
        for i, scenario, reference in zip(indices.tolist(), scenarios, references, strict=True):
            self.fields[i], task, outline = scenario.field, scenario.task, scenario.outline
            self.states[i], sim.goals[i], sim.middles[i], sim.halves[i], sim.weights[i], sim.parameters[i] = task
            sim.outlines[i], sim.outlines[i, : len(outline)] = 0.0, outline
            self.episodes["horizon"][i] = scenario.episode_limit
            self.episodes["time_weight"][i] = scenario.cost.time_weight
            if self.settings.shaped:
                self.episodes[["speed_weight", "turn_weight"]][i] = scenario.robot.metric(scenario.cost)
                sim.guides[i] = guide_points(task.goal[:2], reference)
            self._contacts.pop(i, None)
            self._masses[i] = tuple(obstacle.mass for obstacle in scenario.obstacles)
        if self._geodesic:
            self._store_maps(indices)
        stepping.start_episodes(indices, self._places)
        if self.settings.disturbed:
            for i, generator in zip(indices.tolist(), generators, strict=True):
                self._generators[i] = generator
                self._draw_noise(i)

    def _reference(self, choice: Scenario | int, bank: ScenarioBank | None) -> np.ndarray | None:
        """Return the path (N, n) of the optimum that guides the shaped reward; None without such a reward or path."""
        if not self.settings.shaped or isinstance(choice, Scenario) or bank is None:
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
        if self.settings.observation == "map":
            check_map(scenario.field, self.settings.map_vertices)

    def _make_room(self, scenarios: Sequence[Scenario]) -> None:
        """Enlarge the arrays of footprints and parameters."""
        sim = self._simulation
        rows = max(len(scenario.outline) for scenario in scenarios) - sim.outlines.shape[1]
        if rows > 0:
            self._replace(outlines=np.pad(sim.outlines, ((0, 0), (0, rows), (0, 0))))
        n_parameters = len(scenarios[0].task.parameters)
        if n_parameters != sim.parameters.shape[1]:
            self._replace(parameters=np.zeros((len(self.states), n_parameters)))

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
            for scenario in bank if self.settings.observation == "map" else bank[:1]:
                self._check_scenario(scenario)

    def _store_maps(self, robots: np.ndarray) -> None:
        """Store the geodesic maps of robots."""
        maps = [geodesic_map(self.fields[i], *self._simulation.goals[i, :2].tolist()) for i in robots.tolist()]
        missing = max(map(len, maps)) - self._simulation.maps.shape[1]
        if missing > 0:
            self._replace(maps=np.pad(self._simulation.maps, ((0, 0), (0, missing))))
        for i, packed in zip(robots.tolist(), maps, strict=True):
            self._simulation.maps[i, : len(packed)] = packed

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
        if self._bodies is None:
            invalid = stepping.drive(actions, active, self._places, self._addresses)
        else:
            invalid = stepping.begin_periods(actions, active, self._places)
        if invalid >= 0:
            robot = "" if len(self.states) == 1 else f" for robot {invalid}"
            expected = in_words(actions.shape[1])
            raise ValueError(f"action: expected {expected} finite numbers, got {actions[invalid].tolist()}{robot}")
        if self.settings.previous_action:
            np.copyto(self.layout.actions, np.clip(actions, -1.0, 1.0), where=active[:, None])
        incomplete: np.ndarray | None = None
        if self._bodies is not None:
            incomplete = active
            for substep in range(self._substeps + 1):
                stepping.push_bodies(self._bodies.rows, self._places, self._addresses, substep, self._substeps)
                if substep < self._substeps:
                    self._bodies.advance()
        if not self.settings.terminate_on_collision:
            in_contact = self.episodes["remaining"] > 0
            for i in np.flatnonzero(in_contact).tolist():
                self._drive_in_contact(i)
            incomplete = in_contact if incomplete is None else incomplete
        if incomplete is not None:
            stepping.end_periods(incomplete, self._places)
        if self.settings.disturbed:
            # The observation at the end of a period uses the noise row of the next period.
            for i in np.flatnonzero(active & (self.episodes["steps"] % NOISE_ROWS == 0)).tolist():
                self._draw_noise(i)

    def _drive_in_contact(self, i: int) -> None:
        """Simulate the rest of a period after a contact."""
        sim, episode, state, model = self._simulation, self.episodes[i], self.states[i], self.settings.model
        controls = sim.controls[i]
        outline = constant(sim.outlines[i][sim.outlines[i, :, 2:4].any(axis=1)])
        if i not in self._contacts:
            self._contacts[i] = ContactWorld(self.fields[i], outline, self.settings.motor, self._masses[i])
        duration = float(episode["remaining"])
        substeps = math.ceil(duration / MAX_CONTACT_STEP)
        steer = self._velocity_function(i, duration / substeps)
        before, pose = state.copy(), state[:3]
        if self.settings.motors:
            velocity = np.array([episode["vx"], episode["vy"], episode["spin"]])
        else:
            velocity = np.array(steer(0.0, 0.0, float(pose[2]), 0.0))
        world = self._contacts[i]
        time = float(episode["time"]) + float(episode["duration"]) - duration
        found = world.simulate(state, velocity, steer, time, duration, substeps)
        lowest, squared_speed, squared_turn_rate, proximity = found
        if world.field is not self.fields[i]:  # obstacles have moved; the next world begins with them at rest
            self.fields[i] = world.field
            del self._contacts[i]
        if self.settings.motors:
            episode["vx"], episode["vy"], episode["spin"] = velocity
        ahead = velocity[0] * math.cos(pose[2]) + velocity[1] * math.sin(pose[2])
        for name, value in zip(model.velocity_states, (ahead, velocity[2]), strict=False):
            state[model.state_names.index(name)] = value  # what the contact has left of the velocity
        # The effort is that of the actual motion, or of the controls, which are held. Further states change also in
        # contact; the state cost is that at both ends of the period.
        if self.settings.commands_motion:
            episode["effort"] += stepping.effort(sim.weights[i], np.sqrt([squared_speed, squared_turn_rate]))
        else:
            episode["effort"] += stepping.effort(sim.weights[i], controls) * duration
        if model.state_cost is not None:
            parameters, states = constant(sim.parameters[i]), (np.array([*pose, *before[3:]]), state)
            ends = sum(model.state_cost(q, parameters) for q in states)
            episode["effort"] += ends / 2 * duration
        episode["proximity"] += proximity
        timed = constant(np.append(state, time + duration))
        episode["pose_clearance"] = footprint_clearance(timed, outline, self.fields[i])[0]
        episode["clearance"] = min(episode["clearance"], lowest)

    def _velocity_function(self, i: int, step: float) -> VelocityFunction:
        """Return the function from the velocity of a robot in contact to that of its next step without contact."""
        sim, motor, model, state = self._simulation, self.settings.motor, self.settings.model, self.states[i]
        controls, packed = sim.controls[i].copy(), sim.settings[0]["motor"]
        if self.settings.motors:

            def track(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
                fx, fy, torque = stepping.wheel_forces(np.array([vx, vy, spin]), heading, controls, step, packed)
                return vx + fx / motor.mass * step, vy + fy / motor.mass * step, spin + torque / motor.moment * step

            return track
        parameters = constant(sim.parameters[i])
        new, joints = np.zeros(len(state)), np.unique(sim.outlines[i, :, 4]).astype(int)
        joints = joints[joints > 0]  # a trailer does not turn relative to a robot in contact

        def follow(vx: float, vy: float, heading: float, spin: float) -> tuple[float, float, float]:
            model.advance(np.array([0.0, 0.0, heading, *state[3:]]), controls, step, parameters, new)
            new[joints] = state[joints]
            state[3:] = new[3:]
            return new[0] / step, new[1] / step, (new[2] - heading) / step

        return follow

    def observe(self, out: np.ndarray, robots: np.ndarray | None = None) -> None:
        """Write flat observations to `out` (count, size), float32: of all robots, or of those given by index."""
        self.layout.fill(self._all_robots if robots is None else robots, self._places, out)

    def at_goal(self, i: int) -> bool:
        """Return whether the pose of a robot equals its goal, within the tolerances."""
        return bool(stepping.at_goal(i, self._simulation))

    def ranges(self, i: int) -> np.ndarray:
        """Return the lidar ranges of a robot without noise (m); empty without a lidar."""
        return self.layout.scan(self.states[i], float(self.episodes["time"][i]), self.fields[i])

    def __getstate__(self) -> dict[str, Any]:
        # Contact worlds have no memory between periods, so they can be created again.
        shared = ("_simulation", "_places", "_pointers", "_addresses", "episodes", "states", "_noise")
        arrays = self._simulation._replace(fields=np.zeros(0))
        return {**{k: v for k, v in self.__dict__.items() if k not in shared}, "_contacts": {}, "_arrays": arrays}

    def __setstate__(self, state: dict[str, Any]) -> None:
        arrays: Simulation = writable(state.pop("_arrays"))
        self.__dict__.update(state)
        self._simulation = arrays._replace(fields=self.fields.places)
        self.episodes, self.states, self._noise = arrays.episodes, arrays.states, arrays.noise
        self._connect()


def _kernels(settings: EnvironmentSettings) -> tuple[Any, ...]:
    """Return the kernels of a step, so that those not in the cache are compiled together."""
    model = settings.model
    kernels = [clearances, footprint_clearance, footprint_clearances]  # also of the check of a scenario
    kernels += [stepping.start_episodes, observe_robots]
    if settings.motors:
        kernels += [stepping.begin_periods, stepping.push_bodies, stepping.end_periods, coast, no_state_cost]
    else:
        kernels += [stepping.drive, model.advance, model.state_cost or no_state_cost]
    if settings.shaped:  # the optima of banks, which guide the robots, are checked
        kernels.append(footprint_value)
    if settings.observation == "geodesic":
        kernels.append(solve_eikonal)
    if not settings.terminate_on_collision:
        kernels += [resolve_overlap, footprint_value, stepping.effort, stepping.wheel_forces, stepping.end_periods]
    return tuple(kernels)
