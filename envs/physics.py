"""The robots' bodies in pymunk: one Space in which all robots move freely, and one for each that touches something.

Where nothing is touched, obstacles cannot matter to Chipmunk. So they stay out of the Space that all robots share,
which is what makes it fast (a broad phase over a thousand arenas takes twenty times as long as moving the bodies). A
robot that goes on after a touch gets a Space of its own with the obstacles of its arena. Contacts that share a Space
depend, in the last bits, on what else is in it and on what was; a robot's episode must not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numba import float64, types

from leapnav.envs.arcs import follow_arc
from leapnav.envs.compiling import njit
from leapnav.envs.fields import ARENA, unpack_field
from leapnav.envs.obstacles import clearance, proximity_value

WALL_THICKNESS = 1.0  # m, outside the arena
SKIN = 1e-3  # m by which the rim is felt farther out, so that a robot that slides along something stays in contact
DEEPEST = 1e-6  # m that a robot in contact may overlap what it touches
SHORT = 0.5  # of the robot's radius: a way after which it is still on the same side of what it touches
_field = types.Array(types.float64, 1, "C", readonly=True)
_options = {"cache": True, "error_model": "numpy", "nogil": True}

_KINEMATICS = (
    pymunk.batch.BodyFields.POSITION
    | pymunk.batch.BodyFields.ANGLE
    | pymunk.batch.BodyFields.VELOCITY
    | pymunk.batch.BodyFields.ANGULAR_VELOCITY
)
_FORCES = _KINEMATICS | pymunk.batch.BodyFields.FORCE | pymunk.batch.BodyFields.TORQUE


class FreeBodies:
    """Robots that touch nothing, in one Space, written and read as one buffer.

    Args:
        count: number of robots.
        mass, moment: of each, kg and kg m^2.
        forces: whether forces drive them; else velocities do.

    Attributes:
        rows (count, 6), with forces (count, 9): x, y, angle; velocity (2) and angular velocity; force (2) and torque.
            All per step: a velocity is a displacement. That lets each robot have a step of its own length.

    """

    def __init__(self, count: int, mass: float, moment: float, *, forces: bool) -> None:
        self._arguments = count, mass, moment, forces
        self._build(np.zeros((count, 9 if forces else 6)))

    def _build(self, rows: np.ndarray) -> None:
        self.rows = rows
        count, mass, moment, forces = self._arguments
        self._space = pymunk.Space()
        self._space.add(*(pymunk.Body(mass, moment) for _ in range(count)))
        self._fields = _FORCES if forces else _KINEMATICS
        self._written, self._read = pymunk.batch.Buffer(), pymunk.batch.Buffer()
        self._written.set_float_buf(self.rows)
        # What is read is always as long, so it always lies where it lies now.
        pymunk.batch.get_space_bodies(self._space, _KINEMATICS, self._read)
        self._arrived = np.frombuffer(self._read.float_buf()).reshape(-1, 6)
        self._kinematics = self.rows[:, :6]

    def advance(self) -> None:
        """One step: every body moves by its velocity, and its force then changes that."""
        # Everything is written, so nothing in the Space outlives a step.
        pymunk.batch.set_space_bodies(self._space, self._fields, self._written)
        self._space.step(1.0)
        self._read.clear()
        pymunk.batch.get_space_bodies(self._space, _KINEMATICS, self._read)
        self._kinematics[:] = self._arrived

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self._arguments, "rows": self.rows}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._arguments = state["arguments"]
        self._build(state["rows"])


Velocity = tuple[float, float, float]  # x, y, angular


class ContactWorld:
    """One robot and the obstacles of its arena, for the periods of an episode in which it touches something.

    Args:
        field: the packed field of the scenario.
        mass, moment: of the robot, kg and kg m^2.
        friction: between the robot and what it touches.

    """

    def __init__(self, field: np.ndarray, mass: float, moment: float, friction: float) -> None:
        self._field = field
        self._robot = mass, moment, friction
        self._space = pymunk.Space()
        self._space.collision_slop = SKIN  # metres, not Chipmunk's customary pixels
        static = self._space.static_body
        circles, polygons = unpack_field(field)
        shapes: list[pymunk.Shape] = [pymunk.Circle(static, r, (x, y)) for x, y, r in circles.tolist()]
        shapes += [pymunk.Poly(static, polygon[:, 3:].tolist()) for polygon in polygons]
        x_min, y_min, x_max, y_max = field[ARENA : ARENA + 4].tolist()
        t = WALL_THICKNESS
        for left, below, right, above in (
            (x_min - t, y_min - t, x_min, y_max + t),
            (x_max, y_min - t, x_max + t, y_max + t),
            (x_min - t, y_min - t, x_max + t, y_min),
            (x_min - t, y_max, x_max + t, y_max + t),
        ):
            shapes.append(pymunk.Poly(static, [(left, below), (right, below), (right, above), (left, above)]))
        for shape in shapes:
            shape.friction = 1.0  # Chipmunk multiplies the two
        self._space.add(*shapes)

    def drive(
        self,
        row: np.ndarray,
        velocity: np.ndarray,
        control: Callable[[float, float, float, float], Velocity],
        duration: float,
        pieces: int,
    ) -> tuple[float, float, float, float]:
        """Drives for `duration` seconds.

        Args:
            row: x, y, angle, overwritten.
            velocity: x, y and angular, m/s and rad/s, overwritten.
            control: from velocity (2), angle and angular velocity to the velocities wanted next, contacts left out.
            pieces: steps to take.

        Returns:
            The smallest clearance (m), and the integrals of the squared speed and turn rate driven and of Phi.

        """

        def apply(body: pymunk.Body, gravity: tuple[float, float], damping: float, dt: float) -> None:
            # Chipmunk calls this before it solves for the contacts, which then take away what leads into an obstacle.
            vx, vy, turn_rate = control(*body.velocity, body.angle, body.angular_velocity)
            body.velocity = vx, vy
            body.angular_velocity = turn_rate

        # The robot is new to the Space: what a body or a contact remembers must not reach from one period to the next.
        mass, moment, friction = self._robot
        body = pymunk.Body(mass, moment)
        rim = pymunk.Circle(body, self._field[2] + SKIN)
        rim.friction = friction
        x, y, angle = row[:3].tolist()
        body.position, body.angle = (x, y), angle
        body.velocity, body.angular_velocity = (velocity[0], velocity[1]), velocity[2]
        body.velocity_func = apply
        self._space.add(body, rim)
        step = duration / pieces
        lowest, speeds, turns = math.inf, 0.0, 0.0
        phi = proximity_value(x, y, self._field)
        near = phi / 2
        for _ in range(pieces):
            self._space.step(step)
            to_x, to_y, to_angle = _pose(body)
            to_x, to_y, depth = settle(x, y, to_x, to_y, self._field)
            body.position = to_x, to_y
            lowest = min(lowest, depth)
            speeds += ((to_x - x) ** 2 + (to_y - y) ** 2) / step
            turns += (to_angle - angle) ** 2 / step
            x, y, angle = to_x, to_y, to_angle
            phi = proximity_value(x, y, self._field)
            near += phi
        row[:3] = x, y, angle
        velocity[:] = *body.velocity, body.angular_velocity
        self._space.remove(body, rim)
        return lowest, speeds, turns, (near - phi / 2) * step


def _pose(body: pymunk.Body) -> tuple[float, float, float]:
    x, y = body.position
    return x, y, body.angle


@njit(types.UniTuple(float64, 3)(float64, float64, float64, float64, _field), **_options)
def settle(x, y, to_x, to_y, field):
    """Where a robot that Chipmunk moved from a free place to (to_x, to_y) comes to stand: x, y, clearance before.

    Chipmunk notices a contact when bodies overlap already, by up to the way of a step. After a short way the robot is
    pushed out to the nearest free place. After one so long that this might be on the other side, it stands where it
    first touches.
    """
    way = math.hypot(to_x - x, to_y - y)
    before = clearance(to_x, to_y, field)[0]
    if way > SHORT * field[2]:
        here = max(clearance(x, y, field)[0], DEEPEST)
        _, share, _ = follow_arc(x, y, math.atan2(to_y - y, to_x - x), way, 0.0, here, field)
        return x + share * (to_x - x), y + share * (to_y - y), before
    depth = before
    new_x, new_y = to_x, to_y
    h = 1e-6
    for _ in range(50):
        if depth >= -DEEPEST:
            return new_x, new_y, before
        nx = clearance(new_x + h, new_y, field)[0] - clearance(new_x - h, new_y, field)[0]
        ny = clearance(new_x, new_y + h, field)[0] - clearance(new_x, new_y - h, field)[0]
        size = math.hypot(nx, ny)
        if size == 0.0:
            break
        new_x -= depth * nx / size
        new_y -= depth * ny / size
        depth = clearance(new_x, new_y, field)[0]
    return x, y, before
