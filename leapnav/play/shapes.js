// Geometry of robots (discs or a rectangle), and of obstacles: discs, convex polygons and capsules. Obstacles of other
// shapes are unions of these; they are drawn, not edited.

import { request, show, showError } from "./state.js";

export const hasHeading = (pose) => pose[2] !== null && pose[2] !== undefined;

// The rows of an outline: rear, front, half width and radius (m) of its discs, or of its rectangle.
function rowsOf(footprint, radius, ahead = 0) {
  const { box } = footprint || {};
  if (box) {
    const middle = ahead + (box.offset || 0);
    return [[middle - box.length / 2, middle + box.length / 2, box.width / 2, 0]];
  }
  const discs = (footprint || [{ radius }]).map((disc) => [ahead + (disc.offset || 0), disc.radius]);
  return discs.map(([at, size]) => [at, at, 0, size]);
}

const outlineOf = ({ footprint, radius }) => rowsOf(footprint, radius);

// The discs or the rectangle of a robot at a state, as obstacles, and those of its trailer, whose hitch angle is the last
// entry. If its heading is free: the disc that is covered at any heading, or a point.
export function robotParts(robot, state) {
  const [x, y, heading] = state, rows = outlineOf(robot);
  if (!hasHeading(state)) {
    const covered = rows.map(([rear, front, halfWidth, radius]) => Math.min(halfWidth, front, -rear) + radius);
    return [{ circle: { center: [x, y], radius: Math.max(...covered, 0) } }];
  }
  const parts = placed(rows, x, y, heading);
  if (!robot.trailer) return parts;
  const hitch = state.length > 3 ? state[state.length - 1] : 0;
  return [...parts, ...placed(rowsOf(robot.trailer, null, -robot.hitch_length), x, y, heading + hitch)];
}

function placed(rows, x, y, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), place = ([a, b]) => [x + a * c - b * s, y + a * s + b * c];
  return rows.map(([rear, front, w, radius]) => (w
    ? { polygon: { vertices: [[rear, -w], [front, -w], [front, w], [rear, w]].map(place) } }
    : { circle: { center: place([rear, 0]), radius } }));
}

// The distance (m) from the reference point of a robot to its front, and half of its largest width.
export const frontOf = (robot) => Math.max(...outlineOf(robot).map(([, front, , radius]) => front + radius));
export const halfWidthOf = (robot) => Math.max(...outlineOf(robot).map(([, , halfWidth, radius]) => halfWidth + radius));

function segmentDistance([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], length = dx * dx + dy * dy;
  const t = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / (length || 1), 0), 1);
  return Math.hypot(x - ax - t * dx, y - ay - t * dy);
}

const unions = new Map(); // parts of other shapes, by their JSON text; empty until the server has answered

// The discs, polygons and capsules of which an obstacle consists, as obstacles.
export function partsOf(obstacle) {
  if (obstacle.circle || obstacle.polygon || obstacle.capsule) return [obstacle];
  const key = JSON.stringify(obstacle);
  if (!unions.has(key)) {
    unions.set(key, []);
    request("/parts", { obstacle }).then((answer) => {
      unions.set(key, answer.parts);
      show();
    }).catch(showError);
  }
  return unions.get(key);
}

// Whether an obstacle moves by itself.
export const moves = ({ velocity, path }) => Boolean(path || (velocity && (velocity[0] || velocity[1])));

// The displacement (m) of an obstacle at a time (s), and its velocity (m/s).
export function motionOf({ velocity, path }, time) {
  if (velocity) return { displacement: velocity.map((v) => v * time), velocity };
  const k = path ? path.times.filter((t) => t <= time).length - 1 : -1;
  if (k < 0) return { displacement: [0, 0], velocity: [0, 0] };
  const { times, points } = path, [x0, y0] = points[0], from = points[k], to = points[k + 1] || from;
  const span = k + 1 < times.length ? times[k + 1] - times[k] : 1;
  const rate = [0, 1].map((i) => (to[i] - from[i]) / span), elapsed = time - times[k];
  return { displacement: [from[0] - x0 + rate[0] * elapsed, from[1] - y0 + rate[1] * elapsed], velocity: rate };
}

// The parts of an obstacle where it is at a time (s).
export function partsAt(obstacle, time) {
  const [dx, dy] = motionOf(obstacle, time).displacement;
  return dx || dy ? partsOf(obstacle).map((part) => moved(part, dx, dy)) : partsOf(obstacle);
}

// Whether a point is inside an obstacle at a time (s).
export const isInside = (obstacle, point, time) => partsAt(obstacle, time).some((part) => isInsidePart(part, point));

export function isInsidePart(part, point) {
  if (part.circle) {
    const { center: [cx, cy], radius } = part.circle;
    return Math.hypot(point[0] - cx, point[1] - cy) <= radius;
  }
  if (part.capsule) {
    const { start, end, radius } = part.capsule;
    return segmentDistance(point, start, end) <= radius;
  }
  const [x, y] = point, { vertices } = part.polygon, sides = vertices.map((a, i) => [a, vertices[(i + 1) % vertices.length]]);
  const crossed = sides.filter(([[ax, ay], [bx, by]]) => ay > y !== by > y && x < ax + ((bx - ax) * (y - ay)) / (by - ay));
  return crossed.length % 2 === 1;
}

export function centerOf(obstacle) {
  if (obstacle.circle) return obstacle.circle.center;
  const { capsule, polygon } = obstacle;
  const points = capsule ? [capsule.start, capsule.end] : polygon ? polygon.vertices : partsOf(obstacle).map(centerOf);
  return [0, 1].map((i) => points.reduce((sum, point) => sum + point[i], 0) / (points.length || 1));
}

// An obstacle after a map of its points and a factor of its size, with the same mass and motion.
function mapped(obstacle, map, factor = 1) {
  const { circle, polygon, capsule, ...others } = obstacle;
  if (circle) return { circle: { center: map(circle.center), radius: circle.radius * factor }, ...others };
  if (polygon) return { polygon: { vertices: polygon.vertices.map(map) }, ...others };
  if (capsule) {
    return { capsule: { start: map(capsule.start), end: map(capsule.end), radius: capsule.radius * factor }, ...others };
  }
  return obstacle;
}

export function moved(obstacle, dx, dy) {
  const shift = ([x, y]) => [x + dx, y + dy], result = mapped(obstacle, shift);
  return result.path ? { ...result, path: { ...result.path, points: result.path.points.map(shift) } } : result;
}

// Scaled and rotated about its centre.
export function transformed(obstacle, factor, angle) {
  const [cx, cy] = centerOf(obstacle), c = factor * Math.cos(angle), s = factor * Math.sin(angle);
  const map = ([x, y]) => [cx + c * (x - cx) - s * (y - cy), cy + s * (x - cx) + c * (y - cy)];
  return obstacle.circle ? mapped(obstacle, (center) => center, factor) : mapped(obstacle, map, factor);
}

export const canRotate = (obstacle) => Boolean(obstacle.polygon || obstacle.capsule);
