"use strict";

// Geometry of robots, which consist of discs, and of obstacles: discs, convex polygons and capsules. Obstacles of other
// shapes are unions of these; they are drawn, not edited.

// The discs of a robot: offsets along its axis, positive ahead, and radii (m).
const discsOf = (robot) => robot.footprint || [{ offset: 0, radius: robot.radius }];

const hasHeading = (pose) => pose[2] !== null && pose[2] !== undefined;

// The discs of a robot at a pose. If its heading is free: the one that is covered at any heading, or a point.
function placedDiscs(robot, [x, y, heading]) {
  const discs = discsOf(robot);
  if (!hasHeading([x, y, heading])) {
    return [{ center: [x, y], radius: Math.max(...discs.map(({ offset, radius }) => radius - Math.abs(offset)), 0) }];
  }
  return discs.map(({ offset, radius }) =>
    ({ center: [x + offset * Math.cos(heading), y + offset * Math.sin(heading)], radius }));
}

// The distance (m) from the reference point of a robot to its front.
const frontOf = (robot) => Math.max(...discsOf(robot).map(({ offset, radius }) => offset + radius));

function segmentDistance([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], length = dx * dx + dy * dy;
  const t = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / (length || 1), 0), 1);
  return Math.hypot(x - ax - t * dx, y - ay - t * dy);
}

const unions = new Map(); // parts of other shapes, by their JSON text; empty until the server has answered

// The discs, polygons and capsules of which an obstacle consists, as obstacles.
function partsOf(obstacle) {
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

// Whether a point is inside an obstacle that is enlarged by a margin (m).
const isInside = (obstacle, point, margin = 0) => partsOf(obstacle).some((part) => isInsidePart(part, point, margin));

function isInsidePart(part, point, margin) {
  if (part.circle) {
    const { center: [cx, cy], radius } = part.circle;
    return Math.hypot(point[0] - cx, point[1] - cy) <= radius + margin;
  }
  if (part.capsule) {
    const { start, end, radius } = part.capsule;
    return segmentDistance(point, start, end) <= radius + margin;
  }
  const [x, y] = point, { vertices } = part.polygon, sides = vertices.map((a, i) => [a, vertices[(i + 1) % vertices.length]]);
  const crossed = sides.filter(([[ax, ay], [bx, by]]) => ay > y !== by > y && x < ax + ((bx - ax) * (y - ay)) / (by - ay));
  return crossed.length % 2 === 1 || sides.some(([a, b]) => segmentDistance(point, a, b) <= margin);
}

function centerOf(obstacle) {
  if (obstacle.circle) return obstacle.circle.center;
  const { capsule, polygon } = obstacle;
  const points = capsule ? [capsule.start, capsule.end] : polygon ? polygon.vertices : partsOf(obstacle).map(centerOf);
  return [0, 1].map((i) => points.reduce((sum, point) => sum + point[i], 0) / (points.length || 1));
}

// An obstacle after a map of its points and a factor of its size.
function mapped(obstacle, map, factor = 1) {
  const { circle, polygon, capsule } = obstacle;
  if (circle) return { circle: { center: map(circle.center), radius: circle.radius * factor } };
  if (polygon) return { polygon: { vertices: polygon.vertices.map(map) } };
  if (capsule) return { capsule: { start: map(capsule.start), end: map(capsule.end), radius: capsule.radius * factor } };
  return obstacle;
}

const moved = (obstacle, dx, dy) => mapped(obstacle, ([x, y]) => [x + dx, y + dy]);

// Scaled and rotated about its centre.
function transformed(obstacle, factor, angle) {
  const [cx, cy] = centerOf(obstacle), c = factor * Math.cos(angle), s = factor * Math.sin(angle);
  const map = ([x, y]) => [cx + c * (x - cx) - s * (y - cy), cy + s * (x - cx) + c * (y - cy)];
  return obstacle.circle ? mapped(obstacle, (center) => center, factor) : mapped(obstacle, map, factor);
}

const canRotate = (obstacle) => Boolean(obstacle.polygon || obstacle.capsule);

// Makes the outline of a part the path of the canvas.
function tracePart({ circle, capsule, polygon }) {
  context.beginPath();
  if (circle) {
    context.arc(...toScreen(circle.center), Math.max(view.scale * circle.radius, 0), 0, 2 * Math.PI);
    return;
  }
  if (capsule) {
    const { start, end, radius } = capsule, pixels = Math.max(view.scale * radius, 0);
    const angle = Math.atan2(start[1] - end[1], end[0] - start[0]); // the canvas counts y downwards
    context.arc(...toScreen(end), pixels, angle - Math.PI / 2, angle + Math.PI / 2);
    context.arc(...toScreen(start), pixels, angle + Math.PI / 2, angle + (3 * Math.PI) / 2);
  } else {
    polygon.vertices.forEach((point, i) => (i ? context.lineTo(...toScreen(point)) : context.moveTo(...toScreen(point))));
  }
  context.closePath();
}
