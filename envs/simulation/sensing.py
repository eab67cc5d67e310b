"""Sensing of the robot's surroundings (kernels): lidar ranges, or a map of the nearest obstacles."""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64, types

from leapnav.envs.field.distance import part_geometry
from leapnav.envs.field.layout import PART_TYPE, displacement_of, edges_of, header_of, motion_of, parts_in
from leapnav.envs.field.packing import field_parts
from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.internals import part_of
from leapnav.envs.kernels.types import CONSTANT, MATRIX, NOTHING, VECTOR, tuple_of
from leapnav.envs.settings import FULL_CIRCLE

ROUNDING = 1e-9  # m, of two computations of the same range
WALL_ENTRIES = 6  # of a map, before the obstacles
# Up to this number of beams it takes less time to intersect a circle with all of them, in vector instructions, than to
# find those that may meet it.
MAX_VECTORISED_BEAMS = 64


@kernel(types.UniTuple(int64, 2)(float64, float64, float64, int64, float64))
def _beams_towards(ahead, left, radius, count, fov):
    """Return the first beam that may meet a circle, and the number after the last one.

    The numbers are less than 2 count; beam count + k is beam k.

    Args:
        ahead, left: centre of the circle (m) in the lidar's frame.
        radius: of the circle (m).
        count: number of beams.
        fov: field of view (rad), see `EnvironmentSettings.beam_angles`.

    """
    distance = math.sqrt(ahead * ahead + left * left)
    if distance <= radius:
        return 0, count
    ratio = radius / distance
    half = ratio * (1.0 + ratio * ratio * (math.pi / 2 - 1.0))  # at least asin(ratio)
    bearing = math.atan2(left, ahead)
    if fov < FULL_CIRCLE:
        if count == 1 or abs(bearing) + half > math.pi:  # the circle is behind, on both sides
            return 0, count
        spacing = fov / (count - 1)
        first = math.floor((bearing - half + fov / 2) / spacing)
        last = math.ceil((bearing + half + fov / 2) / spacing)
        first, last = max(first, 0), min(last + 1, count)
        return (first, last) if first < last else (0, 0)
    density = count / FULL_CIRCLE
    first, last = math.floor((bearing - half) * density), math.ceil((bearing + half) * density)
    if last - first >= count:
        return 0, count
    return (count + first, count + last + 1) if first < 0 else (first, last + 1)


@kernel(float64(float64, float64, float64, float64, float64))
def _range_to_circle(dx, dy, cx, cy, r):
    """Return the distance (m) from the origin in the direction (dx, dy) to a circle, infinite if the ray misses it."""
    along = cx * dx + cy * dy
    beside = cx * dy - cy * dx
    square = r * r - beside * beside
    return along - math.sqrt(square) if square > 0.0 and along > 0.0 else np.inf


@kernel(float64(float64, float64, float64, float64, CONSTANT, PART_TYPE))
def _range_to_polygon(x, y, dx, dy, field, part):
    """Return the distance (m) from (x, y) in the direction (dx, dy) to a rounded polygon, infinite if there is no hit.

    If (x, y) is inside a polygon without rounding, the distance is negative; a rounded one must not contain (x, y).
    """
    edges, rounding = edges_of(field, part), part.rounding
    # Between `enter` and `leave`, the ray is inside the half-planes of all edges, moved outwards by the rounding.
    enter, leave, entered = -np.inf, np.inf, 0
    for k in range(part.edges):
        edge = edges[k]
        height = edge.nx * x + edge.ny * y - edge.offset - rounding
        rate = edge.nx * dx + edge.ny * dy
        if rate < 0.0:
            if -height / rate > enter:
                enter, entered = -height / rate, k
        elif rate > 0.0:
            leave = min(leave, -height / rate)
        elif height > 0.0:  # a ray parallel to an edge is entirely inside or outside its half-plane
            return np.inf
    if enter > leave or leave <= 0.0:
        return np.inf
    if rounding == 0.0:
        return enter
    if enter >= 0.0:
        edge = edges[entered]
        px, py = x + enter * dx - edge.x, y + enter * dy - edge.y
        if 0.0 <= edge.nx * py - edge.ny * px <= edge.length:
            return enter
    # The half-planes extend beyond the circles around the vertices, which round the corners.
    nearest = np.inf
    for edge in edges:
        nearest = min(nearest, _range_to_circle(dx, dy, edge.x - x, edge.y - y, rounding))
    return nearest


@kernel(NOTHING(float64, float64, float64, float64, VECTOR, VECTOR, VECTOR))
def _shorten(cx, cy, r, reach, dxs, dys, nearest):
    """Shorten rays from the origin in the directions (dxs, dys), of lengths `nearest` (m), to the rim of a circle."""
    for k in range(len(nearest)):
        along = cx * dxs[k] + cy * dys[k]
        beside = cx * dys[k] - cy * dxs[k]
        square = r * r - beside * beside
        half = math.sqrt(square if square > 0.0 else 0.0)
        hit = along - half if square > 0.0 and along + half > 0.0 else reach
        nearest[k] = hit if hit < nearest[k] else nearest[k]


@kernel(NOTHING(float64, float64, float64, float64, CONSTANT, tuple_of(float64, float64), MATRIX, MATRIX))
def scan(x, y, heading, time, field, view, beams, scratch):
    """Compute lidar ranges (m).

    Polygons are intersected only with the beams that may meet a circle around them, and so are circles if there are
    many beams.

    Args:
        x, y, heading: position (m) and heading (rad) of the lidar.
        time: of the episode (s), for the positions of moving obstacles.
        field: the packed field of the scenario.
        view: maximum range (m) and field of view (rad).
        beams (2, n): cosines and sines of the angles of the beams in the lidar's frame, see
            `EnvironmentSettings.beam_angles`.
        scratch (3, 2 n): working memory; the first n entries of row 2 are the ranges afterwards.

    """
    count, cos, sin = beams.shape[1], math.cos(heading), math.sin(heading)
    reach, fov = view
    dxs, dys, nearest = scratch[0], scratch[1], scratch[2]
    parts, arena = parts_in(field), header_of(field).arena
    has_polygons = header_of(field).edges > 0
    to_right, to_top, to_left, to_bottom = arena[2] - x, arena[3] - y, arena[0] - x, arena[1] - y
    for k in range(count):
        dx = cos * beams[0, k] - sin * beams[1, k]
        dy = sin * beams[0, k] + cos * beams[1, k]
        across = (to_right if dx > 0.0 else to_left) / dx if dx != 0.0 else np.inf
        along = (to_top if dy > 0.0 else to_bottom) / dy if dy != 0.0 else np.inf
        first = across if across < along else along
        dxs[k], dys[k] = dx, dy
        nearest[k] = first if first < reach else reach
    # The beams that may meet an obstacle are consecutive, if beam count + k is beam k.
    selects = count > MAX_VECTORISED_BEAMS or has_polygons
    if selects:
        for k in range(count):
            dxs[count + k], dys[count + k], nearest[count + k] = dxs[k], dys[k], nearest[k]
    for part in parts:
        moved_x, moved_y = displacement_of(field, part, time)
        px, py = x - moved_x, y - moved_y
        cx, cy = part.x - px, part.y - py
        if cx * cx + cy * cy >= (part.rim + reach) ** 2:
            continue
        first, size = 0, count
        if part.edges > 0 or count > MAX_VECTORISED_BEAMS:
            first, last = _beams_towards(cos * cx + sin * cy, cos * cy - sin * cx, part.rim, count, fov)
            size = last - first
        if part.edges == 0:
            rays = part_of(dxs, first, size), part_of(dys, first, size), part_of(nearest, first, size)
            _shorten(cx, cy, part.rim, reach, rays[0], rays[1], rays[2])
            continue
        is_inside = part.rounding > 0.0 and part_geometry(px, py, 0.0, field, part)[0] <= 0.0
        for k in range(first, first + size):
            hit = 0.0 if is_inside else _range_to_polygon(px, py, dxs[k], dys[k], field, part)
            nearest[k] = min(nearest[k], hit)
    for k in range(count):
        hit = min(nearest[k], nearest[count + k]) if selects else nearest[k]
        nearest[k] = hit if hit > 0.0 else 0.0


@kernel(NOTHING(VECTOR, float64, CONSTANT, float64, MATRIX, MATRIX, VECTOR))
def beam_velocities(state, time, field, fov, beams, scratch, out):
    """Compute the velocity of the obstacle that each beam of a lidar meets, in the lidar's frame.

    Args:
        state: x, y (m) and heading (rad) of the lidar, and further entries.
        time: of the episode (s).
        field: the packed field of the scenario.
        fov: field of view (rad).
        beams (2, n): see `scan`.
        scratch (3, 2 n): the working memory after `scan`.
        out (2 n or more,): overwritten by the components ahead of all beams, then those to the left (m/s); 0 where a
            beam meets nothing that moves.

    """
    count, x, y, cos, sin = beams.shape[1], state[0], state[1], math.cos(state[2]), math.sin(state[2])
    dxs, dys, ranges = scratch[0], scratch[1], scratch[2]
    out[: 2 * count] = 0.0
    header, parts = header_of(field), parts_in(field)
    for number in range(header.parts - header.moving, header.parts):
        part = parts[number]
        moved_x, moved_y, vx, vy = motion_of(field, part, time)
        px, py = x - moved_x, y - moved_y
        cx, cy = part.x - px, part.y - py
        first, last = _beams_towards(cos * cx + sin * cy, cos * cy - sin * cx, part.rim, count, fov)
        for beam in range(first, last):
            k = beam % count
            if part.edges == 0:
                hit = _range_to_circle(dxs[k], dys[k], cx, cy, part.rim)
            else:
                hit = _range_to_polygon(px, py, dxs[k], dys[k], field, part)
            if hit <= ranges[k] + ROUNDING:
                out[k], out[count + k] = cos * vx + sin * vy, cos * vy - sin * vx


def check_map(field: np.ndarray, map_vertices: int) -> None:
    """Raise ValueError if an obstacle in the field has more vertices than each row of the map."""
    vertices = max((len(part.vertices) for part in field_parts(field)), default=0)
    if vertices > map_vertices:
        raise ValueError(
            f"map_vertices: expected at least {vertices}, the number of vertices of an obstacle in the scenario, "
            f"got {map_vertices}"
        )


@kernel(
    NOTHING(float64, float64, float64, float64, CONSTANT, int64, int64, VECTOR),
)
def map_surroundings(x, y, heading, time, field, obstacles, vertices, out):
    """Describe the walls and the nearest parts of obstacles in the robot's frame, in order of distance.

    Each part of an obstacle is a polygon rounded by a radius; a disc has one vertex, a capsule two, a polygon the
    radius 0. Its row contains 1, the radius and the vertices, which are repeated to fill the row. Rows without a part
    are zeros.

    Args:
        x, y, heading: position (m) and heading (rad) of the robot.
        time: of the episode (s), for the positions of moving obstacles.
        field: the packed field of the scenario.
        obstacles, vertices: number of rows, and of vertices in each.
        out (WALL_ENTRIES + obstacles (2 + 2 vertices),): overwritten. With 2 more entries for each obstacle, these are
            the velocities (m/s) of the parts, ahead and to the left.

    """
    parts, arena, cos, sin = parts_in(field), header_of(field).arena, math.cos(heading), math.sin(heading)
    out[0], out[1], out[2], out[3] = x - arena[0], y - arena[1], arena[2] - x, arena[3] - y
    out[4], out[5] = cos, sin
    end = WALL_ENTRIES + obstacles * (2 + 2 * vertices)
    out[WALL_ENTRIES:] = 0.0
    # Insertion sort into a list of the nearest shapes.
    distances = np.full(obstacles, np.inf)
    numbers = np.zeros(obstacles, np.int64)
    for number in range(len(parts)):
        moved_x, moved_y = displacement_of(field, parts[number], time)
        distance = part_geometry(x - moved_x, y - moved_y, 0.0, field, parts[number])[0]
        rank = obstacles
        while rank > 0 and distance < distances[rank - 1]:
            rank -= 1
        if rank < obstacles:
            for k in range(obstacles - 1, rank, -1):
                distances[k], numbers[k] = distances[k - 1], numbers[k - 1]
            distances[rank], numbers[rank] = distance, number
    for k in range(min(obstacles, len(parts))):
        part = parts[numbers[k]]
        moved_x, moved_y = displacement_of(field, part, time)
        px, py = x - moved_x, y - moved_y
        edges = edges_of(field, part)
        if part.knots > 0 and end + 2 * obstacles <= len(out):
            _, _, vx, vy = motion_of(field, part, time)
            out[end + 2 * k], out[end + 2 * k + 1] = cos * vx + sin * vy, cos * vy - sin * vx
        row = WALL_ENTRIES + k * (2 + 2 * vertices)
        out[row], out[row + 1] = 1.0, part.rounding
        for j in range(vertices):
            dx, dy = part.x - px, part.y - py
            if part.edges > 0:
                edge = edges[j % part.edges]
                dx, dy = edge.x - px, edge.y - py
            out[row + 2 + 2 * j] = cos * dx + sin * dy
            out[row + 3 + 2 * j] = cos * dy - sin * dx
