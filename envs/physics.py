"""The robot's world in pymunk: one Space per episode, exact arcs while nothing is touched, contact otherwise."""

from __future__ import annotations

import math

import pymunk

from leapnav.envs.obstacles import arc_clearance, sinc
from leapnav.envs.scenario import Scenario

WALL_THICKNESS = 1.0  # m, outside the arena
# A step that comes this near (m) to something is cut up, so that the contact is found before the bodies overlap much.
CONTACT_MARGIN = 0.01
CONTACT_SUBSTEPS = 20


class World:
    """One episode's physics, in a Space of its own: one that is re-used differs in the last bits after contacts."""

    def __init__(self, scenario: Scenario) -> None:
        self._field = scenario.field
        self._touched = False
        self.space = pymunk.Space()
        # Metres, not Chipmunk's customary pixels: bodies may overlap by a millimetre, and are pushed apart quickly.
        self.space.collision_slop = 1e-3
        self.space.collision_bias = 1e-9
        static = self.space.static_body
        for obstacle in scenario.obstacles:
            if obstacle.circle is not None:
                self.space.add(pymunk.Circle(static, obstacle.circle.radius, obstacle.circle.center))
            elif obstacle.polygon is not None:
                self.space.add(pymunk.Poly(static, obstacle.polygon.vertices))
        x_min, y_min, x_max, y_max = scenario.arena
        t = WALL_THICKNESS
        for left, below, right, above in (
            (x_min - t, y_min - t, x_min, y_max + t),
            (x_max, y_min - t, x_max + t, y_max + t),
            (x_min - t, y_min - t, x_max + t, y_min),
            (x_min - t, y_max, x_max + t, y_max + t),
        ):
            self.space.add(pymunk.Poly(static, [(left, below), (right, below), (right, above), (left, above)]))
        radius = scenario.robot.radius
        self.body = pymunk.Body(mass=1.0, moment=pymunk.moment_for_circle(1.0, 0.0, radius))
        self.body.position = scenario.start[0], scenario.start[1]
        self.body.angle = scenario.start[2]
        shape = pymunk.Circle(self.body, radius)
        shape.collision_type = 1
        self.space.add(self.body, shape)
        self.space.on_collision(1, None, begin=self._on_touch)

    def _on_touch(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
        self._touched = True

    @property
    def pose(self) -> tuple[float, float, float]:
        """(x, y, heading), the heading unwrapped."""
        x, y = self.body.position
        return x, y, self.body.angle

    def drive(self, speed: float, turn_rate: float, duration: float) -> tuple[float, bool]:
        """Holds a command for `duration` seconds: (smallest clearance on the arc in m, whether it touched anything).

        The exact arc of a command is a chord of length v h sinc(omega h / 2) at the mean heading. A body that is given
        the chord as its velocity ends where the arc ends, because Chipmunk moves bodies by an Euler step.
        """
        x, y = self.body.position
        heading = self.body.angle
        turn = turn_rate * duration
        clear = arc_clearance(x, y, heading, speed * duration, turn, self._field)
        self._touched = clear <= 0
        pieces = 1 if clear > CONTACT_MARGIN else CONTACT_SUBSTEPS
        along = speed * sinc(turn / pieces / 2)
        self.body.angular_velocity = turn_rate
        for piece in range(pieces):
            if not self._touched or piece == 0:  # from the first touch on, the velocity is what the contact leaves
                middle = heading + turn * (piece + 0.5) / pieces
                self.body.velocity = along * math.cos(middle), along * math.sin(middle)
            self.space.step(duration / pieces)
        return clear, self._touched
