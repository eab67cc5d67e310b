"use strict";

// Geometry of robots, which consist of discs, and of obstacles: discs, convex polygons and capsules. Obstacles of other
// shapes are drawn by their outline, not edited.

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

const outlines = new Map(); // of other shapes, by their JSON text; empty until the server has answered

// The vertices of a polygon, or points on the outline of another shape.
function outlineOf(obstacle) {
  if (obstacle.polygon) return obstacle.polygon.vertices;
  const key = JSON.stringify(obstacle);
  if (!outlines.has(key)) {
    outlines.set(key, []);
    request("/outline", { obstacle }).then((answer) => {
      outlines.set(key, answer.outline);
      show();
    }).catch(showError);
  }
  return outlines.get(key);
}

// Whether a point is inside an obstacle that is enlarged by a margin (m).
function isInside(obstacle, point, margin = 0) {
  if (obstacle.circle) {
    const { center: [cx, cy], radius } = obstacle.circle;
    return Math.hypot(point[0] - cx, point[1] - cy) <= radius + margin;
  }
  if (obstacle.capsule) {
    const { start, end, radius } = obstacle.capsule;
    return segmentDistance(point, start, end) <= radius + margin;
  }
  const [x, y] = point, vertices = outlineOf(obstacle), sides = vertices.map((a, i) => [a, vertices[(i + 1) % vertices.length]]);
  const crossed = sides.filter(([[ax, ay], [bx, by]]) => ay > y !== by > y && x < ax + ((bx - ax) * (y - ay)) / (by - ay));
  return crossed.length % 2 === 1 || sides.some(([a, b]) => segmentDistance(point, a, b) <= margin);
}

function centerOf(obstacle) {
  if (obstacle.circle) return obstacle.circle.center;
  const points = obstacle.capsule ? [obstacle.capsule.start, obstacle.capsule.end] : outlineOf(obstacle);
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

// Adds the outline to the path of a canvas.
function traceObstacle(obstacle) {
  context.beginPath();
  if (obstacle.circle) {
    context.arc(...toScreen(obstacle.circle.center), Math.max(view.scale * obstacle.circle.radius, 0), 0, 2 * Math.PI);
    return;
  }
  if (obstacle.capsule) {
    const { start, end, radius } = obstacle.capsule, pixels = Math.max(view.scale * radius, 0);
    const angle = Math.atan2(start[1] - end[1], end[0] - start[0]); // the canvas counts y downwards
    context.arc(...toScreen(end), pixels, angle - Math.PI / 2, angle + Math.PI / 2);
    context.arc(...toScreen(start), pixels, angle + Math.PI / 2, angle + (3 * Math.PI) / 2);
  } else {
    outlineOf(obstacle).forEach((point, i) => (i ? context.lineTo(...toScreen(point)) : context.moveTo(...toScreen(point))));
  }
  context.closePath();
}
