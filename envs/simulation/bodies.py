"""What pymunk simulates: robots with motors, and robots in contact with obstacles.

Robots without motors and without contact follow the exact path of their model, see `leapnav.envs.simulation.paths`.
Robots with motors share one Space without obstacles while they are not in contact: a broad phase over 1000 arenas takes
20 times as long as moving the bodies. A robot that continues after a collision gets its own Space with the obstacles of
its arena. Contacts in one Space depend, in the last bits, on its other contents and on its history, and an episode must
not depend on either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numba import float64
from pymunk.constraints import Constraint, GearJoint, PivotJoint

from leapnav.envs.field.clearance import footprint_clearance
from leapnav.envs.field.layout import read_header
from leapnav.envs.field.packing import FieldPart, displacements, field_parts, parts_at, replace_parts
from leapnav.envs.field.proximity import footprint_value
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CONSTANT_MATRIX, VECTOR, constant
from leapnav.envs.robots.footprints import axis_of, corners_of
from leapnav.envs.settings import Motor
from leapnav.envs.simulation.stepping import GRAVITY

WALL_THICKNESS = 1.0  # m, outside the arena
CONTACT_MARGIN = 1e-3  # m by which the rim is enlarged, so that a robot sliding along an obstacle stays in contact
MAX_OVERLAP = 1e-6  # m, of a robot in contact with an obstacle
GROUND_FRICTION = 0.5  # of obstacles with a mass; wood, cardboard and plastics on a floor have 0.3 to 0.6
DIFFERENCE = 1e-6  # m, of finite differences of the clearance
MAX_CORRECTED_STEP = 0.5  # robot radii: after a longer step the robot may be on the other side of an obstacle

_KINEMATICS = (
    pymunk.batch.BodyFields.POSITION
    | pymunk.batch.BodyFields.ANGLE
    | pymunk.batch.BodyFields.VELOCITY
    | pymunk.batch.BodyFields.ANGULAR_VELOCITY
)
_FORCES = _KINEMATICS | pymunk.batch.BodyFields.FORCE | pymunk.batch.BodyFields.TORQUE


class MotorBodies:
    """The robots with motors, while they are not in contact, in one Space that is written and read as one buffer.

    Args:
        count: number of robots.
        motor: mass and moment of inertia of each.

    Attributes:
        rows (count, 9): x, y, angle; velocity (2) and angular velocity; force (2) and torque. Time is measured in
            steps, so a velocity is a displacement. Each robot can have its own step length.

    """

    def __init__(self, count: int, motor: Motor) -> None:
        self._arguments = count, motor
        self.rows = np.zeros((count, 9))
        self._space = pymunk.Space()
        self._space.add(*(pymunk.Body(motor.mass, motor.moment) for _ in range(count)))
        self._written, self._read = pymunk.batch.Buffer(), pymunk.batch.Buffer()
        self._written.set_float_buf(self.rows)
        # The buffer never changes its size, so its memory is not reallocated and the view stays valid.
        pymunk.batch.get_space_bodies(self._space, _KINEMATICS, self._read)
        self._arrived = np.frombuffer(self._read.float_buf()).reshape(-1, 6)

    def advance(self) -> None:
        """Take one step: each body moves by its velocity, which its force then changes."""
        # The whole state is written, so that the Space keeps nothing from earlier steps.
        pymunk.batch.set_space_bodies(self._space, _FORCES, self._written)
        self._space.step(1.0)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, _KINEMATICS, self._read)
        self.rows[:, :6] = self._arrived

    def __reduce__(self) -> tuple[Any, ...]:
        return MotorBodies, self._arguments  # each step writes all rows


# From velocity (2), angle and angular velocity to the velocities (x, y, angular) of the next step without contacts.
VelocityFunction = Callable[[float, float, float, float], tuple[float, float, float]]


class ContactWorld:
    """One robot and the obstacles of its arena, for the control periods with contact.

    Obstacles with a mass are at rest at the start of each period and whenever the robot does not push them. Moving
    obstacles follow their paths, whatever they push.

    Args:
        field: the packed field of the scenario.
        outline (K, 5): footprint of the robot, see `leapnav.envs.robots.footprints.outline_of`.
        motor: mass, moment of inertia and friction of the robot.
        masses: mass (kg) of each obstacle; None: it does not move.

    Attributes:
        field: the packed field, in which the obstacles are where the robot has pushed them.

    """

    def __init__(
        self, field: np.ndarray, outline: np.ndarray, motor: Motor, masses: Sequence[float | None] = ()
    ) -> None:
        self.field, self._outline, self._motor = field, outline, motor
        # For the proximity cost: Chipmunk does not resolve the position of a robot in contact more finely.
        margins = np.where(outline[:, 1:2] > outline[:, :1], (-1, 1, 1, 0, 0), (0, 0, 0, 1, 0))
        self._smaller = constant(outline - CONTACT_MARGIN * margins)
        self._space = pymunk.Space()
        self._space.collision_slop = CONTACT_MARGIN  # in metres; the default of 0.1 is meant for pixels
        static = self._space.static_body
        shapes: list[pymunk.Shape] = []
        self._parts = field_parts(field)
        self._movable = {k: pymunk.Body() for k, mass in enumerate(masses) if mass is not None}
        self._knots = {part.obstacle: part.knots for part in self._parts if len(part.knots)}
        self._moving = {k: pymunk.Body(body_type=pymunk.Body.KINEMATIC) for k in self._knots}
        bodies = {**self._movable, **self._moving}
        for part in self._parts:
            body, points = bodies.get(part.obstacle, static), part.vertices.tolist()
            if len(points) == 1:
                shapes.append(pymunk.Circle(body, part.rounding, points[0]))
            elif len(points) == 2:
                shapes.append(pymunk.Segment(body, points[0], points[1], part.rounding))
            else:
                shapes.append(pymunk.Poly(body, points, radius=part.rounding))
        for k, body in self._movable.items():
            area = sum(shape.area for shape in body.shapes)
            for shape in body.shapes:
                shape.mass = (masses[k] or 0.0) * shape.area / area
        x_min, y_min, x_max, y_max = read_header(field)["arena"].tolist()
        t = WALL_THICKNESS
        for left, below, right, above in (
            (x_min - t, y_min - t, x_min, y_max + t),
            (x_max, y_min - t, x_max + t, y_max + t),
            (x_min - t, y_min - t, x_max + t, y_min),
            (x_min - t, y_max, x_max + t, y_max + t),
        ):
            shapes.append(pymunk.Poly(static, [(left, below), (right, below), (right, above), (left, above)]))
        for shape in shapes:
            shape.friction = 1.0  # Chipmunk multiplies the coefficients of both shapes
        self._space.add(*bodies.values(), *shapes)
        for body in self._movable.values():
            self._space.add(*_ground_friction(static, body))

    def simulate(
        self,
        state: np.ndarray,
        velocity: np.ndarray,
        steer: VelocityFunction,
        time: float,
        duration: float,
        substeps: int,
    ) -> tuple[float, float, float, float]:
        """Simulate a period with contacts.

        Args:
            state (n,): state of the robot, whose pose is overwritten. The angles of its joints do not change.
            velocity: velocity (2) (m/s) and angular velocity (rad/s); overwritten.
            steer: see `VelocityFunction`.
            time: of the episode (s), at the start of the period.
            duration: length of the period (s).
            substeps: number of steps.

        Returns:
            The smallest clearance (m), and the integrals of the squared speed, of the squared turn rate and of Phi.

        """

        def apply(body: pymunk.Body, gravity: tuple[float, float], damping: float, dt: float) -> None:
            # Chipmunk calls this before it solves for the contacts, which remove the velocity into an obstacle.
            vx, vy, turn_rate = steer(*body.velocity, body.angle, body.angular_velocity)
            body.velocity = vx, vy
            body.angular_velocity = turn_rate

        # A new body in each period: the memory of bodies and contacts must not carry over to the next period.
        body = pymunk.Body(self._motor.mass, self._motor.moment)
        outline = [self._shape(body, row, state) for row in self._outline.tolist()]
        x, y, angle = state[:3].tolist()
        body.position, body.angle = (x, y), angle
        body.velocity, body.angular_velocity = (velocity[0], velocity[1]), velocity[2]
        body.velocity_func = apply
        self._space.add(body, *outline)
        step = duration / substeps
        lowest, speed_integral, turn_integral = math.inf, 0.0, 0.0
        phi = footprint_value(constant(state), self._smaller, self._field_at(time))
        phi_sum = phi / 2  # trapezoidal rule
        for k in range(substeps):
            self._start_moving(time + k * step, step)
            self._space.step(step)
            before = constant(state.copy())
            state[:3] = _pose(body)
            self._move_obstacles()
            field = self._field_at(time + (k + 1) * step)
            lowest = min(lowest, resolve_overlap(before, state, self._outline, field))
            body.position = float(state[0]), float(state[1])
            moved = (state[:3] - before[:3]).tolist()
            speed_integral += (moved[0] ** 2 + moved[1] ** 2) / step
            turn_integral += moved[2] ** 2 / step
            phi = footprint_value(constant(state), self._smaller, field)
            phi_sum += phi
        velocity[:] = *body.velocity, body.angular_velocity
        self._space.remove(body, *outline)
        return lowest, speed_integral, turn_integral, (phi_sum - phi / 2) * step

    def _start_moving(self, time: float, step: float) -> None:
        """Place the moving obstacles at a time (s), with the velocities that lead to their places after a step (s)."""
        for k, body in self._moving.items():
            first, last = displacements(self._knots[k], np.array([time, time + step])).tolist()
            body.position = first[0], first[1]
            body.velocity = (last[0] - first[0]) / step, (last[1] - first[1]) / step

    def _field_at(self, time: float) -> np.ndarray:
        """Return the packed field with the moving obstacles at rest where they are at a time (s)."""
        return replace_parts(self.field, parts_at(self.field, time)) if self._moving else self.field

    def _move_obstacles(self) -> None:
        """Update the field after obstacles have moved."""
        if not any(body.position != (0.0, 0.0) or body.angle for body in self._movable.values()):
            return

        def moved(part: FieldPart) -> FieldPart:
            body = self._movable.get(part.obstacle)
            if body is None:
                return part
            return part._replace(vertices=np.array([body.local_to_world(vertex) for vertex in part.vertices.tolist()]))

        self.field = replace_parts(self.field, [moved(part) for part in self._parts])

    def _shape(self, body: pymunk.Body, row: Sequence[float], state: np.ndarray) -> pymunk.Shape:
        """Return a disc or a rectangle of the footprint, enlarged by the margin."""
        rear, front, _, radius, _ = row
        relative = np.array([0.0, 0.0, 0.0, *state[3:]])
        if front > rear:
            corners = [(x, y) for x, y in corners_of(row, relative.tolist()).tolist()]
            shape: pymunk.Shape = pymunk.Poly(body, corners, radius=radius + CONTACT_MARGIN)
        else:
            axis = axis_of(row, relative.tolist())
            shape = pymunk.Circle(body, radius + CONTACT_MARGIN, (rear * math.cos(axis), rear * math.sin(axis)))
        shape.friction = self._motor.friction
        return shape


def _ground_friction(static: pymunk.Body, body: pymunk.Body) -> tuple[Constraint, ...]:
    """Return the constraints by which the ground slows a body with the largest force and torque of its friction."""
    force = GROUND_FRICTION * body.mass * GRAVITY
    linear = PivotJoint(static, body, body.center_of_gravity, body.center_of_gravity)
    angular = GearJoint(static, body, 0.0, 1.0)
    linear.max_force, angular.max_force = force, force * math.sqrt(body.moment / body.mass)  # at the radius of gyration
    for constraint in (linear, angular):
        constraint.max_bias = 0.0  # the joint resists the velocity and does not return the body to its place
    return linear, angular


def _pose(body: pymunk.Body) -> tuple[float, float, float]:
    x, y = body.position
    return x, y, body.angle


@kernel(float64(CONSTANT, VECTOR, CONSTANT_MATRIX, CONSTANT))
def resolve_overlap(before, state, outline, field):
    """Move a robot out of an obstacle that it overlaps after a step of Chipmunk.

    Chipmunk detects a contact only after bodies overlap, by up to the length of a step. After a short step, the robot
    is moved to the nearest free position. After a long step, that might be on the other side of the obstacle, so the
    robot is moved back to the first contact of the step.

    Args:
        before (n,): state before the step.
        state (n,): state after the step; its position is overwritten.
        outline (K, 5): footprint of the robot.
        field: packed obstacle field.

    Returns:
        The clearance (m) after the step.

    """
    x, y, to_x, to_y = before[0], before[1], state[0], state[1]
    step = math.hypot(to_x - x, to_y - y)
    found = footprint_clearance(state, outline, field)[0]
    smallest = np.inf
    for k in range(len(outline)):
        smallest = min(smallest, outline[k, 2] + outline[k, 3])
    if step > MAX_CORRECTED_STEP * smallest:
        # Steps of at most the clearance, so that the first contact is not missed.
        fraction = 0.0
        state[0], state[1] = x, y
        here = max(footprint_clearance(state, outline, field)[0], MAX_OVERLAP)
        while fraction < 1.0:
            following = min(fraction + here / step, 1.0)
            state[0], state[1] = x + following * (to_x - x), y + following * (to_y - y)
            here = footprint_clearance(state, outline, field)[0]
            if here < MAX_OVERLAP:
                break
            fraction = following
        state[0], state[1] = x + fraction * (to_x - x), y + fraction * (to_y - y)
        return found
    depth = found
    for _ in range(50):
        if depth >= -MAX_OVERLAP:
            return found
        new_x, new_y = state[0], state[1]
        state[0] = new_x + DIFFERENCE
        nx = footprint_clearance(state, outline, field)[0]
        state[0] = new_x - DIFFERENCE
        nx -= footprint_clearance(state, outline, field)[0]
        state[0], state[1] = new_x, new_y + DIFFERENCE
        ny = footprint_clearance(state, outline, field)[0]
        state[1] = new_y - DIFFERENCE
        ny -= footprint_clearance(state, outline, field)[0]
        size = math.hypot(nx, ny)
        if size == 0.0:
            break
        state[0], state[1] = new_x - depth * nx / size, new_y - depth * ny / size
        depth = footprint_clearance(state, outline, field)[0]
    state[0], state[1] = x, y
    return found
