// Editing of the scenario by mouse, touch and keyboard.

import { byId, canEdit, edit, isFree, play, redo, scheduleSearch, setText, show, undo } from "./state.js";
import { canRotate, centerOf, hasHeading, isInside, isInsidePart, motionOf, moved, robotParts, transformed } from "./shapes.js";
import { arrowTip, canvas, toPlane, view } from "./canvas.js";

const STEP = 0.05, FINE_STEP = 0.01; // m per key press
const TURN = Math.PI / 36, FINE_TURN = Math.PI / 180; // rad per key press
const SCALE = 1.1, FINE_SCALE = 1.02; // change of size per key press
const HANDLE_SIZE = { mouse: 10, pen: 14, touch: 22 }; // smallest radius of a handle (pixels)

// ---- Changes of the selection

const obstaclesOf = () => play.scenario.obstacles || [];
export const poseOf = (name) => [...play.scenario[name], null].slice(0, 3);
const isPose = (selected) => selected === "start" || selected === "goal";
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

function replaceObstacle(i, obstacle, group) {
  edit({ obstacles: obstaclesOf().map((old, k) => (k === i ? obstacle : old)) }, group);
}

function setPose(name, pose, group) {
  edit({ [name]: pose }, group);
}

function moveSelected(dx, dy, group) {
  if (isPose(play.selected)) {
    const [x, y, heading] = poseOf(play.selected);
    setPose(play.selected, [x + dx, y + dy, heading], group);
  } else if (play.selected !== null) replaceObstacle(play.selected, moved(obstaclesOf()[play.selected], dx, dy), group);
}

function rotateSelected(angle, group) {
  if (isPose(play.selected)) {
    const [x, y, heading] = poseOf(play.selected);
    setPose(play.selected, [x, y, wrapped((heading === null ? 0 : heading) + angle)], group);
  } else if (play.selected !== null && canRotate(obstaclesOf()[play.selected])) {
    replaceObstacle(play.selected, transformed(obstaclesOf()[play.selected], 1, angle), group);
  }
}

function resizeSelected(factor, group) {
  if (typeof play.selected !== "number") return;
  replaceObstacle(play.selected, transformed(obstaclesOf()[play.selected], factor, 0), group);
}

function removeSelected() {
  if (typeof play.selected !== "number") return;
  const removed = play.selected;
  play.drag = null;
  play.selected = null;
  edit({ obstacles: obstaclesOf().filter((_, i) => i !== removed) });
}

function toggleFreeHeading() {
  const [x, y, heading] = poseOf("goal");
  setPose("goal", [x, y, heading === null ? 0 : null]);
}

function addObstacle(makeAt) {
  if (!canEdit()) return;
  const [x0, y0, x1, y1] = play.scenario.arena;
  play.selected = obstaclesOf().length;
  edit({ obstacles: [...obstaclesOf(), makeAt((x0 + x1) / 2, (y0 + y1) / 2)] });
}

const addDisc = () => addObstacle((x, y) => ({ circle: { center: [x, y], radius: 0.6 } }));
const addBox = () =>
  addObstacle((x, y) =>
    ({ polygon: { vertices: [[x - 0.6, y - 0.4], [x + 0.6, y - 0.4], [x + 0.6, y + 0.4], [x - 0.6, y + 0.4]] } }));

const addCapsule = () =>
  addObstacle((x, y) => ({ capsule: { start: [x - 0.8, y], end: [x + 0.8, y], radius: 0.2 } }));

function selectNext(step) {
  if (!canEdit()) return;
  const all = ["start", "goal", ...obstaclesOf().keys()], current = all.indexOf(play.selected);
  const next = current < 0 ? (step > 0 ? 0 : all.length - 1) : (current + step + all.length) % all.length;
  play.selected = all[next];
  show();
}

function describeSelection() {
  const at = ([x, y]) => `(${x.toFixed(2)}, ${y.toFixed(2)}) m`, selected = play.selected;
  if (selected === null || !play.scenario) return "nothing selected";
  if (isPose(selected)) {
    const pose = poseOf(selected), heading = hasHeading(pose) ? `${((180 / Math.PI) * pose[2]).toFixed(0)}°` : "free";
    return `${selected} ${at(pose)}, heading ${heading}`;
  }
  const obstacle = obstaclesOf()[selected], { displacement } = motionOf(obstacle, play.clock);
  const position = at(centerOf(obstacle).map((value, i) => value + displacement[i]));
  if (obstacle.circle) return `disc ${selected} ${position}, radius ${obstacle.circle.radius.toFixed(2)} m`;
  return `${Object.keys(obstacle)[0]} ${selected} ${position}`;
}

// ---- Mouse and touch

// What can be dragged at a point (m): the heading or the position of a pose, or an obstacle.
function findHandle(point, pointerType = "mouse") {
  const size = HANDLE_SIZE[pointerType] || HANDLE_SIZE.mouse;
  const isWithin = (a, b, pixels) => view.scale * Math.hypot(a[0] - b[0], a[1] - b[1]) <= pixels;
  for (const name of ["goal", "start"]) {
    const pose = poseOf(name);
    if (hasHeading(pose) && isWithin(arrowTip(pose), point, size)) return { kind: "heading", name };
    const isOnRobot = robotParts(play.scenario.robot, pose).some((part) => isInsidePart(part, point));
    if (isOnRobot || isWithin(pose, point, size)) return { kind: "position", name };
  }
  const obstacles = obstaclesOf();
  for (let i = obstacles.length - 1; i >= 0; i -= 1) if (isInside(obstacles[i], point, play.clock)) return { kind: "obstacle", i };
  return null;
}

const clientPoint = ({ clientX, clientY }) => {
  const box = canvas.getBoundingClientRect();
  return toPlane([clientX - box.left, clientY - box.top]);
};

// A touch that hits a handle drags it; any other touch scrolls the page.
canvas.addEventListener("touchstart", (event) => {
  if (canEdit() && event.touches.length === 1 && findHandle(clientPoint(event.touches[0]), "touch")) event.preventDefault();
}, { passive: false });

canvas.addEventListener("pointerdown", (event) => {
  if (!canEdit() || !event.isPrimary) return;
  const point = clientPoint(event), handle = findHandle(point, event.pointerType);
  if (!handle && event.pointerType === "touch") return; // the page may scroll; pointerup ends a tap
  play.selected = handle && (handle.kind === "obstacle" ? handle.i : handle.name);
  if (handle) {
    play.drag = { ...handle, from: point };
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
  }
  show();
});

canvas.addEventListener("pointermove", (event) => {
  if (!event.isPrimary) return;
  if (!play.drag) {
    if (canEdit()) canvas.style.cursor = findHandle(clientPoint(event), event.pointerType) ? "grab" : "default";
    return;
  }
  if (play.moveTime === null) play.moveTime = performance.now();
  const point = clientPoint(event), [dx, dy] = [point[0] - play.drag.from[0], point[1] - play.drag.from[1]], group = play.drag;
  play.drag.from = point;
  if (play.drag.kind === "obstacle") {
    replaceObstacle(play.drag.i, moved(obstaclesOf()[play.drag.i], dx, dy), group);
    return;
  }
  const [x, y, heading] = poseOf(play.drag.name);
  if (play.drag.kind === "heading") setPose(play.drag.name, [x, y, Math.atan2(point[1] - y, point[0] - x)], group);
  else setPose(play.drag.name, [x + dx, y + dy, heading], group);
});

canvas.addEventListener("pointerup", (event) => {
  if (!play.drag && event.pointerType === "touch" && canEdit()) {
    play.selected = null;
    show();
  }
});

for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, (event) => {
    if (!play.drag || !event.isPrimary) return;
    play.drag = null;
    if (!play.searched) scheduleSearch();
  });
}

// ---- Keys and buttons

// The actions of keys and buttons, by name, with the fine or the coarse step.
const ACTIONS = {
  left: (isFine, group) => moveSelected(isFine ? -FINE_STEP : -STEP, 0, group),
  right: (isFine, group) => moveSelected(isFine ? FINE_STEP : STEP, 0, group),
  up: (isFine, group) => moveSelected(0, isFine ? FINE_STEP : STEP, group),
  down: (isFine, group) => moveSelected(0, isFine ? -FINE_STEP : -STEP, group),
  "turn-left": (isFine, group) => rotateSelected(isFine ? FINE_TURN : TURN, group),
  "turn-right": (isFine, group) => rotateSelected(isFine ? -FINE_TURN : -TURN, group),
  grow: (isFine, group) => resizeSelected(isFine ? FINE_SCALE : SCALE, group),
  shrink: (isFine, group) => resizeSelected(1 / (isFine ? FINE_SCALE : SCALE), group),
  remove: removeSelected,
  "free-heading": toggleFreeHeading,
  next: () => selectNext(1),
  previous: () => selectNext(-1),
  "add-disc": addDisc,
  "add-box": addBox,
  "add-capsule": addCapsule,
  undo,
  redo,
};

// Keys of the canvas. Tab is not among them, so that it leaves the canvas.
const KEYS = {
  ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
  q: "turn-left", ",": "turn-left", "<": "turn-left", e: "turn-right", ".": "turn-right", ">": "turn-right",
  "+": "grow", "=": "grow", "-": "shrink", _: "shrink", "*": "grow",
  Delete: "remove", Backspace: "remove", f: "free-heading",
  n: "next", "]": "next", PageDown: "next", p: "previous", "[": "previous", PageUp: "previous",
  a: "add-disc", b: "add-box", c: "add-capsule",
};

canvas.addEventListener("keydown", (event) => {
  if (!canEdit() || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Escape" && play.selected !== null) {
    play.selected = null;
    show();
    return;
  }
  const name = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!name || (event.key.startsWith("Arrow") && play.selected === null)) return;
  // The repetitions of a key that is held down are undone together.
  if (!event.repeat) keyGroup = {};
  ACTIONS[name](event.shiftKey && event.key !== "+" && event.key !== "_" && event.key !== "*", keyGroup);
  event.preventDefault();
});
let keyGroup = {};

document.addEventListener("keydown", (event) => {
  const isField = event.target.matches("input:not([type=range]):not([type=checkbox]), select, textarea");
  if (isField || !(event.ctrlKey || event.metaKey) || event.altKey) return;
  const key = event.key.toLowerCase();
  if (key === "z" || key === "y") {
    (key === "y" || event.shiftKey ? redo : undo)();
    event.preventDefault();
  }
});

for (const button of document.querySelectorAll("[data-action]")) {
  button.addEventListener("click", () => {
    if (canEdit()) ACTIONS[button.dataset.action](false, null);
  });
}

// The buttons that apply to the selection.
export function showSelection() {
  const { selected } = play, isObstacle = typeof selected === "number";
  const isFixed = isObstacle && !canRotate(obstaclesOf()[selected] || {});
  const enabled = {
    left: selected !== null, right: selected !== null, up: selected !== null, down: selected !== null,
    "turn-left": selected !== null && !isFixed, "turn-right": selected !== null && !isFixed,
    grow: isObstacle, shrink: isObstacle, remove: isObstacle, undo: play.undo.length > 0, redo: play.redo.length > 0,
  };
  for (const [name, isEnabled] of Object.entries(enabled)) {
    for (const button of document.querySelectorAll(`[data-action="${name}"]`)) button.disabled = !isEnabled;
  }
  const isFree = Boolean(play.scenario) && !hasHeading(poseOf("goal"));
  byId("free-heading").setAttribute("aria-pressed", String(isFree));
  setText("selection", describeSelection());
}
