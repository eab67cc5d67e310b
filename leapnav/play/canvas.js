"use strict";

// Drawing of the scenario and the plots. The state `play` is in page.js.

const OPTIMUM_COLOR = "#d9730d", OTHER_COLOR = "#8a8a8a", SWEEP_COLOR = "#2a9d5c", POLICY_COLOR = "#2662ab";
const PLOT_FRACTION = 0.36; // of the width of the canvas
const byId = (id) => document.getElementById(id);
const canvas = byId("view"), context = canvas.getContext("2d");

// ---- The plane

let view = { scale: 1, left: 0, top: 0 }; // pixels per metre, and the pixel of the origin
const toScreen = ([x, y]) => [view.left + view.scale * x, view.top - view.scale * y];
const toPlane = ([x, y]) => [(x - view.left) / view.scale, (view.top - y) / view.scale];

function fitView(width, height) {
  const [x0, y0, x1, y1] = play.scenario.arena, margin = 14;
  const scale = Math.min((width - 2 * margin) / (x1 - x0), (height - 2 * margin) / (y1 - y0));
  view = { scale, left: (width - scale * (x1 - x0)) / 2 - scale * x0, top: (height + scale * (y1 - y0)) / 2 + scale * y0 };
}

function drawLine(points, color, width, dash = []) {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.beginPath();
  points.forEach((point, i) => (i ? context.lineTo(...toScreen(point)) : context.moveTo(...toScreen(point))));
  context.stroke();
  context.setLineDash([]);
}

const arrowTip = ([x, y, heading]) => {
  const length = Math.max(2.2 * play.scenario.robot.radius, 26 / view.scale);
  return [x + length * Math.cos(heading), y + length * Math.sin(heading)];
};

function drawRobot(pose, color, hasArrow) {
  const [x, y] = toScreen(pose), radius = view.scale * play.scenario.robot.radius;
  context.lineWidth = 2;
  context.strokeStyle = color;
  context.beginPath();
  context.arc(x, y, Math.max(radius, 3), 0, 2 * Math.PI);
  context.fillStyle = color + "44";
  context.fill();
  context.stroke();
  if (pose[2] === undefined || pose[2] === null) return;
  const end = hasArrow ? toScreen(arrowTip(pose)) : [x + radius * Math.cos(pose[2]), y - radius * Math.sin(pose[2])];
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(...end);
  context.stroke();
  if (!hasArrow) return;
  context.fillStyle = color;
  context.beginPath();
  context.arc(...end, 4, 0, 2 * Math.PI);
  context.fill();
}

function traceObstacle(obstacle) {
  context.beginPath();
  if (obstacle.circle) {
    context.arc(...toScreen(obstacle.circle.center), view.scale * obstacle.circle.radius, 0, 2 * Math.PI);
  } else {
    const vertices = obstacle.polygon.vertices;
    vertices.forEach((point, i) => (i ? context.lineTo(...toScreen(point)) : context.moveTo(...toScreen(point))));
    context.closePath();
  }
}

// The pose at a time, interpolated between states at equal intervals.
function poseAt(states, time, duration) {
  const position = Math.min(Math.max(time / duration, 0), 1) * (states.length - 1);
  const k = Math.min(Math.floor(position), states.length - 2);
  if (k < 0) return states[0];
  return states[k].map((value, i) => value + (position - k) * (states[k + 1][i] - value));
}

function drawPlane(width, height) {
  const { scenario, solution } = play;
  fitView(width, height);
  const [x0, y0, x1, y1] = scenario.arena, [left, top] = toScreen([x0, y1]);
  context.fillStyle = "#fafafa";
  context.fillRect(left, top, view.scale * (x1 - x0), view.scale * (y1 - y0));
  context.strokeStyle = "#444";
  context.lineWidth = 2;
  context.strokeRect(left, top, view.scale * (x1 - x0), view.scale * (y1 - y0));
  (scenario.obstacles || []).forEach((obstacle, i) => {
    traceObstacle(obstacle);
    context.fillStyle = i === play.selected ? "#aebfd0" : "#c9c9c9";
    context.fill();
    context.strokeStyle = i === play.selected ? "#336" : "#777";
    context.lineWidth = i === play.selected ? 2 : 1;
    context.stroke();
  });
  const isOutdated = play.error !== null;
  if (solution && solution.path) {
    solution.alternatives.forEach((other, i) =>
      drawLine(other.states, play.highlighted === i + 1 ? OPTIMUM_COLOR : OTHER_COLOR, 1.2, [5, 4]));
    if (play.sweeps && play.sweeps.length) {
      const sweep = play.sweeps[byId("sweep-slider").value];
      drawLine(sweep.states, SWEEP_COLOR, 2);
      context.fillStyle = SWEEP_COLOR;
      for (const node of sweep.nodes) {
        context.beginPath();
        context.arc(...toScreen(node), 2.5, 0, 2 * Math.PI);
        context.fill();
      }
    }
    drawLine(solution.path.states, isOutdated || !solution.success ? "#e9b98a" : OPTIMUM_COLOR, 2.5);
  }
  if (play.episode) drawLine(play.episode.states, POLICY_COLOR, 2);
  drawRobot(scenario.start, "#1a7a3c", true);
  drawRobot(scenario.goal, "#b03a2e", true);
  if (play.time !== null) {
    if (solution && solution.path) {
      drawRobot(poseAt(solution.path.states, play.time, scenario.horizon), OPTIMUM_COLOR, false);
    }
    if (play.episode) {
      const duration = play.episode.period * (play.episode.states.length - 1);
      drawRobot(poseAt(play.episode.states, play.time, Math.min(duration, scenario.horizon)), POLICY_COLOR, false);
    }
  }
}

// ---- Plots over time

function drawPlots(left, width, height) {
  const path = play.solution && play.solution.path;
  if (!path) return;
  const column = (rows, i) => rows.map((row) => row[i]);
  // Title, curves (label, values, color), and the minimum range of the vertical axis.
  const plots = [
    ["controls", [["v (m/s)", column(path.controls, 0), "#2662ab"], ["ω (rad/s)", column(path.controls, 1), "#c0392b"]], 0.1],
    ["costates", [["λx", column(path.costates, 0), "#2662ab"], ["λy", column(path.costates, 1), "#2a9d5c"], ["λθ", column(path.costates, 2), "#c0392b"]], 0.1],
    ["Hamiltonian", [["H", path.hamiltonian, "#6b3fa0"]], 1e-3],
    ["clearance", [["m", path.clearances, "#555"]], 0.1],
  ];
  const spacing = 30, plotHeight = (height - spacing * plots.length - 8) / plots.length;
  plots.forEach(([title, curves, minRange], k) => {
    const top = 20 + k * (plotHeight + spacing), all = curves.flatMap(([, values]) => values);
    let low = Math.min(...all), high = Math.max(...all);
    if (title === "clearance") low = Math.min(low, 0);
    const margin = Math.max(0, minRange - (high - low)) / 2 + 0.05 * (high - low);
    low -= margin;
    high += margin;
    const at = (i, value) =>
      [left + (i / (path.times.length - 1)) * width, top + plotHeight * (1 - (value - low) / (high - low))];
    context.strokeStyle = "#bbb";
    context.lineWidth = 1;
    context.strokeRect(left, top, width, plotHeight);
    if (low < 0 && high > 0) {
      context.beginPath();
      context.moveTo(...at(0, 0));
      context.lineTo(...at(path.times.length - 1, 0));
      context.stroke();
    }
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "right";
    context.fillStyle = "#777";
    const digits = high - low < 0.01 ? 5 : 2;
    context.fillText(high.toFixed(digits), left - 4, top + 9);
    context.fillText(low.toFixed(digits), left - 4, top + plotHeight);
    context.textAlign = "left";
    let x = left;
    context.fillStyle = "#222";
    context.fillText(title, x, top - 6);
    x += context.measureText(title).width + 12;
    for (const [label, values, color] of curves) {
      context.fillStyle = color;
      context.fillText(label, x, top - 6);
      x += context.measureText(label).width + 10;
      context.strokeStyle = color;
      context.lineWidth = 1.5;
      context.beginPath();
      values.forEach((value, i) => (i ? context.lineTo(...at(i, value)) : context.moveTo(...at(i, value))));
      context.stroke();
    }
    if (play.time !== null) {
      const x = left + (play.time / play.scenario.horizon) * width;
      context.strokeStyle = OPTIMUM_COLOR;
      context.beginPath();
      context.moveTo(x, top);
      context.lineTo(x, top + plotHeight);
      context.stroke();
    }
  });
  context.fillStyle = "#777";
  context.textAlign = "right";
  context.fillText(`${play.scenario.horizon} s`, left + width, height - 4);
}

function draw() {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  if (!play.scenario) return;
  const planeWidth = width * (1 - PLOT_FRACTION);
  drawPlane(planeWidth, height);
  drawPlots(planeWidth + 58, width - planeWidth - 72, height);
}
