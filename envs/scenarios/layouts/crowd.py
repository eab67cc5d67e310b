"""Pedestrians of a social-force model (D. Helbing, P. Molnar, Physical Review E 51, 1995, p. 4282)."""

from __future__ import annotations

import numpy as np

from leapnav.envs.scenarios.layouts.layout import ARENA

STEP = 0.1  # s
RELAXATION = 0.5  # s in which a pedestrian reaches the desired velocity
# Acceleration (m/s2) of two pedestrians that touch, and the distance (m) over which it decreases by the factor e.
REPULSION, RANGE = 3.0, 0.35
CLOSEST = 0.5  # m, distance of the centres of two pedestrians that touch
MAX_SPEED_FACTOR = 1.3  # largest speed, relative to the desired one
ARRIVED = 0.5  # m from its goal a pedestrian gets another one
SLOWEST, FASTEST = 0.5, 1.1  # m/s, desired speeds


def simulate_crowd(rng: np.random.Generator, count: int, times: np.ndarray) -> np.ndarray:
    """Simulate pedestrians that walk to one random point of the arena after another and avoid each other.

    Args:
        rng: generator of start, goals and desired speeds.
        count: number of pedestrians.
        times: (K,), increasing times (s) of at least 0.

    Returns:
        Their positions (K, count, 2) (m).

    """
    low, high = np.array(ARENA[:2]) + CLOSEST, np.array(ARENA[2:]) - CLOSEST
    position, goal = rng.uniform(low, high, (2, count, 2))
    speed = rng.uniform(SLOWEST, FASTEST, (count, 1))
    velocity = np.zeros((count, 2))
    steps = np.round(times / STEP).astype(int)
    found = np.empty((steps[-1] + 1, count, 2))
    for k in range(len(found)):
        found[k] = position
        arrived = np.hypot(*(goal - position).T) < ARRIVED
        goal[arrived] = rng.uniform(low, high, (int(arrived.sum()), 2))
        way = goal - position
        force = (speed * way / np.hypot(*way.T)[:, None] - velocity) / RELAXATION
        apart = position[:, None] - position
        distance = np.hypot(*apart.T).T
        np.fill_diagonal(distance, np.inf)
        push = REPULSION * np.exp((CLOSEST - distance) / RANGE) / distance
        force += (push[:, :, None] * apart).sum(axis=1)
        velocity = velocity + STEP * force
        fastest = np.hypot(*velocity.T)[:, None] / (MAX_SPEED_FACTOR * speed)
        velocity /= np.maximum(fastest, 1.0)
        position = np.clip(position + STEP * velocity, low, high)
    return found[steps]
