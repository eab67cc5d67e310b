// The plane: its transformation to pixels, and the drawing of scenarios, paths and robots. All colours come from the
// server (`play.colors`).

import { byId, play, shownScenario } from "./state.js";
import { centerOf, frontOf, halfWidthOf, hasHeading, motionOf, moves, partsAt, robotParts } from "./shapes.js";

export const canvas = byId("view");
export let context = canvas.getContext("2d");

// ---- The plane

export let view = { scale: 1, left: 0, top: 0 }; // pixels per metre, and the pixel of the origin
export let unit = 1; // pixels per unit of line widths and font sizes
export const toScreen = ([x, y]) => [view.left + view.scale * x, view.top - view.scale * y];
export const toPlane = ([x, y]) => [(x - view.left) / view.scale, (view.top - y) / view.scale];

export function fitView(width, height) {
  const [x0, y0, x1, y1] = shownScenario().arena, margin = 6 * unit;
  const scale = Math.max(Math.min((width - 2 * margin) / (x1 - x0), (height - 2 * margin) / (y1 - y0)), 1e-9);
  view = { scale, left: (width - scale * (x1 - x0)) / 2 - scale * x0, top: (height + scale * (y1 - y0)) / 2 + scale * y0 };
}

export function drawLine(points, color, width, dash = []) {
  context.strokeStyle = color;
  context.lineWidth = width * unit;
  context.lineJoin = "round";
  context.setLineDash(dash.map((length) => length * unit));
  context.beginPath();
  points.forEach((point, i) => (i ? context.lineTo(...toScreen(point)) : context.moveTo(...toScreen(point))));
  context.stroke();
  context.setLineDash([]);
}

export function drawPoints(points, color, radius) {
  context.fillStyle = color;
  for (const point of points) {
    context.beginPath();
    context.arc(...toScreen(point), radius * unit, 0, 2 * Math.PI);
    context.fill();
  }
}

export const arrowTip = ([x, y, heading]) => {
  const { robot } = shownScenario();
  const length = Math.max(frontOf(robot) + 1.2 * halfWidthOf(robot), (26 * unit) / view.scale);
  return [x + length * Math.cos(heading), y + length * Math.sin(heading)];
};

export function drawRobot(pose, color, hasArrow, isSelected = false) {
  const { robot } = shownScenario(), [x, y] = toScreen(pose), smallest = (3 * unit) / view.scale;
  const parts = robotParts(robot, pose).map((part) => (part.polygon ? part
    : { circle: { ...part.circle, radius: Math.max(part.circle.radius, smallest) } }));
  context.lineWidth = (isSelected ? 4 : 2) * unit;
  context.strokeStyle = color;
  context.beginPath();
  parts.forEach(addPart);
  context.fillStyle = color + "44";
  context.fill();
  context.stroke();
  if (isSelected) drawSelection(parts);
  if (!hasHeading(pose)) return;
  const front = view.scale * Math.max(frontOf(robot), smallest);
  const end = hasArrow ? toScreen(arrowTip(pose)) : [x + front * Math.cos(pose[2]), y - front * Math.sin(pose[2])];
  context.lineWidth = 2 * unit;
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(...end);
  context.stroke();
  if (!hasArrow) return;
  context.fillStyle = color;
  context.beginPath();
  context.arc(...end, 4.5 * unit, 0, 2 * Math.PI);
  context.fill();
}

// A dashed circle around the parts of a robot.
function drawSelection(parts) {
  const points = parts.flatMap(({ circle, polygon }) => (polygon ? polygon.vertices.map((vertex) => [vertex, 0])
    : [[circle.center, circle.radius]]));
  const centre = [0, 1].map((i) => points.reduce((sum, [point]) => sum + point[i], 0) / points.length);
  const [x, y] = toScreen(centre);
  const radius = view.scale * Math.max(...points.map(([[px, py], r]) => Math.hypot(px - centre[0], py - centre[1]) + r));
  context.strokeStyle = play.colors.wall;
  context.lineWidth = unit;
  context.setLineDash([4 * unit, 3 * unit]);
  context.beginPath();
  context.arc(x, y, radius + 5 * unit, 0, 2 * Math.PI);
  context.stroke();
  context.setLineDash([]);
}

// The pose at a time, interpolated between states at equal intervals.
export function poseAt(states, time, duration) {
  const position = Math.min(Math.max(time / duration, 0), 1) * (states.length - 1);
  const k = Math.min(Math.floor(position), states.length - 2);
  if (k < 0) return states[0];
  return states[k].map((value, i) => value + (position - k) * (states[k + 1][i] - value));
}

// Adds the outline of a part to the path of the canvas.
function addPart({ circle, capsule, polygon }) {
  if (circle) {
    const [x, y] = toScreen(circle.center), pixels = Math.max(view.scale * circle.radius, 0);
    context.moveTo(x + pixels, y);
    context.arc(x, y, pixels, 0, 2 * Math.PI);
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

const ARROW_TIME = 1; // s; the arrow of an obstacle is as long as its way in this time

// The velocity of an obstacle as an arrow from where it is.
function drawVelocity(obstacle, time) {
  const { displacement: [dx, dy], velocity: [vx, vy] } = motionOf(obstacle, time), [x, y] = centerOf(obstacle);
  if (!vx && !vy) return;
  const start = [x + dx, y + dy], end = [x + dx + ARROW_TIME * vx, y + dy + ARROW_TIME * vy];
  const angle = Math.atan2(vy, vx), length = (7 * unit) / view.scale;
  const head = [2.6, -2.6].map((turn) => [end[0] + length * Math.cos(angle + turn), end[1] + length * Math.sin(angle + turn)]);
  drawLine([start, end], play.colors.wall, 1.4);
  drawLine([head[0], end, head[1]], play.colors.wall, 1.4);
}

// Obstacles are drawn where they are at a time (s).
export function drawScenario(scenario, selected = null, time = 0) {
  const [x0, y0, x1, y1] = scenario.arena, [left, top] = toScreen([x0, y1]), colors = play.colors;
  context.strokeStyle = colors.wall;
  context.lineWidth = 2 * unit;
  context.strokeRect(left, top, view.scale * (x1 - x0), view.scale * (y1 - y0));
  (scenario.obstacles || []).forEach((obstacle, i) => {
    const isSelected = i === selected;
    context.fillStyle = colors.obstacle;
    context.strokeStyle = isSelected ? colors.wall : colors.edge;
    context.lineWidth = (isSelected ? 3 : 1) * unit;
    context.setLineDash(isSelected ? [6 * unit, 3 * unit] : []);
    for (const part of partsAt(obstacle, time)) {
      context.beginPath();
      addPart(part);
      context.fill();
      context.stroke();
    }
    context.setLineDash([]);
    if (moves(obstacle)) drawVelocity(obstacle, time);
  });
}

export const drawPoses = (scenario, selected = null) => {
  for (const name of ["start", "goal"]) {
    const motion = scenario[`${name}_motion`] || [];
    drawRobot([...[...scenario[name], null].slice(0, 3), ...motion], play.colors[name], true, selected === name);
  }
};

export const alternativeColor = (i) => play.colors.alternatives[i % play.colors.alternatives.length];

// ---- Both canvases

// Prepares a canvas for drawing in CSS pixels and returns its size.
export function prepareCanvas(element) {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = element;
  if (element.width !== Math.round(width * ratio) || element.height !== Math.round(height * ratio)) {
    element.width = Math.round(width * ratio);
    element.height = Math.round(height * ratio);
  }
  context = element.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return [width, height];
}

// Line widths and fonts of the canvases follow the font size of the page.
export function updateUnit() {
  unit = parseFloat(getComputedStyle(document.documentElement).fontSize) / 14;
}
