// Plots: the optimum or an alternative over time, or the curves of a lesson.

import { byId, durationOf, modelOf, play, robotOf, shownTime } from "./state.js";
import { alternativeColor, context, unit } from "./canvas.js";

// The local optimum whose curves are plotted: the optimum or the highlighted alternative.
export function shownPath() {
  const solution = play.solution;
  if (!solution || !solution.path) return null;
  const other = play.highlighted > 0 ? solution.alternatives[play.highlighted - 1] : null;
  return other && other.times ? other : solution.path;
}

export function shownPathName() {
  const path = shownPath();
  if (!path) return "";
  const excess = play.solution.path.cost > 0 ? 100 * (path.cost / play.solution.path.cost - 1) : 0;
  const name = play.searched ? "Optimum" : "Local optimum";
  if (path === play.solution.path) return `${name}, J = ${path.cost.toFixed(4)}`;
  return `Alternative ${play.highlighted}, J = ${path.cost.toFixed(4)} (+${excess.toFixed(2)} %)`;
}

export const shownPathColor = () => (play.highlighted > 0 ? alternativeColor(play.highlighted - 1) : play.colors.optimum);

function setFont(bold = false) {
  context.font = `${bold ? "600 " : ""}${12 * unit}px system-ui, sans-serif`;
}

// Draws one plot: title, curves [label, values, color] over `abscissae`, in a box. Options: `minRange` of the vertical
// axis, `isLogarithmic`, `includesZero`, `marks` (vertical lines [abscissa, color]), `dots` (whether values have dots).
export function drawPlot(box, title, curves, abscissae, options = {}) {
  const { left, top, width, height } = box, colors = play.colors;
  const { minRange = 0, isLogarithmic = false, includesZero = false, marks = [], dots = false } = options;
  const scaled = (value) => (isLogarithmic ? Math.log10(Math.max(value, 1e-16)) : value);
  const all = curves.flatMap(([, values]) => values).filter((value) => value !== null).map(scaled);
  if (!all.length) return;
  let low = Math.min(...all), high = Math.max(...all);
  if (includesZero) low = Math.min(low, 0);
  const margin = Math.max(0, Math.max(minRange, 1e-12) - (high - low)) / 2 + 0.06 * (high - low);
  low -= margin;
  high += margin;
  const first = Math.min(...abscissae), last = Math.max(...abscissae);
  const atX = (x) => left + ((x - first) / (last - first || 1)) * width;
  const atY = (value) => top + height * (1 - (scaled(value) - low) / (high - low));
  context.strokeStyle = colors.obstacle;
  context.lineWidth = unit;
  context.strokeRect(left, top, width, height);
  if (!isLogarithmic && low < 0 && high > 0) {
    context.beginPath();
    context.moveTo(left, atY(0));
    context.lineTo(left + width, atY(0));
    context.stroke();
  }
  setFont();
  context.textAlign = "right";
  context.fillStyle = colors.wall;
  const digits = high - low < 0.01 ? 4 : high - low < 1 ? 3 : 2;
  const label = (value) => (isLogarithmic ? `1e${Math.round(value)}` : value.toFixed(digits));
  context.fillText(label(high), left - 4 * unit, top + 9 * unit);
  context.fillText(label(low), left - 4 * unit, top + height);
  context.textAlign = "left";
  let x = left;
  const labelAt = (text, color) => {
    context.fillStyle = color;
    context.fillText(text, x, top - 6 * unit);
    x += context.measureText(text).width + 10 * unit;
  };
  setFont(true);
  labelAt(title, colors.wall);
  setFont();
  for (const [mark, color] of marks) {
    context.strokeStyle = color;
    context.lineWidth = 1.5 * unit;
    context.beginPath();
    context.moveTo(atX(mark), top);
    context.lineTo(atX(mark), top + height);
    context.stroke();
  }
  for (const [text, values, color, dash = []] of curves) {
    if (text) labelAt(text, color);
    context.strokeStyle = color;
    context.fillStyle = color;
    context.lineWidth = 1.7 * unit;
    context.setLineDash(dash.map((length) => length * unit));
    context.beginPath();
    let isConnected = false;
    values.forEach((value, i) => {
      if (value === null) return;
      const point = [atX(abscissae[i]), atY(value)];
      if (isConnected) context.lineTo(...point);
      else context.moveTo(...point);
      isConnected = true;
    });
    context.stroke();
    context.setLineDash([]);
    if (!dots || dash.length) continue;
    values.forEach((value, i) => {
      if (value === null) return;
      context.beginPath();
      context.arc(atX(abscissae[i]), atY(value), 2.5 * unit, 0, 2 * Math.PI);
      context.fill();
    });
  }
}

// The boxes of `count` plots below each other, with room for titles and for a label of the horizontal axis.
export function plotBoxes(count, width, height, headingHeight) {
  const left = 60 * unit, spacing = 26 * unit, bottom = 20 * unit;
  const plotHeight = Math.max((height - headingHeight - bottom - spacing * count) / count, 10);
  return Array.from({ length: count }, (_, k) => ({
    left, top: headingHeight + spacing + k * (plotHeight + spacing), width: Math.max(width - left - 12 * unit, 10),
    height: plotHeight,
  }));
}

export function drawAbscissa(boxes, first, last, name, height) {
  const { left, width } = boxes[0];
  setFont();
  context.fillStyle = play.colors.wall;
  const y = height - 5 * unit;
  context.textAlign = "left";
  context.fillText(first, left, y);
  context.textAlign = "center";
  context.fillText(name, left + width / 2, y);
  context.textAlign = "right";
  context.fillText(last, left + width, y);
}

export function drawPlots(width, height) {
  const path = shownPath();
  if (!path || (play.driving && !byId("show-optimum").checked)) return;
  const curves = play.colors.curves, column = (rows, i) => rows.map((row) => row[i]);
  const headingHeight = 16 * unit, boxes = plotBoxes(4, width, height, headingHeight);
  context.font = `600 ${13 * unit}px system-ui, sans-serif`;
  context.textAlign = "left";
  context.fillStyle = shownPathColor();
  context.fillText(shownPathName(), boxes[0].left, headingHeight - 2 * unit);
  const marks = shownTime() === 0 ? [] : [[shownTime(), play.colors.optimum]];
  const at = (box, title, lines, options) => drawPlot(box, title, lines, path.times, { marks, ...options });
  const { controls, states } = robotOf(play.scenario), isUnicycle = modelOf(play.scenario) === "unicycle";
  const controlNames = isUnicycle ? ["v (m/s)", "ω (rad/s)"] : controls;
  const poseNames = isUnicycle ? ["λx (1/m)", "λy (1/m)", "λθ (1/rad)"] : ["λx", "λy", "λθ"]; // little room for more
  const costateNames = states.map((name, i) => poseNames[i] || `λ ${name.split(" (")[0]}`);
  const lines = (names, rows) => names.map((name, i) => [name, column(rows, i), curves[i]]);
  at(boxes[0], "Controls", lines(controlNames, path.controls), { minRange: 0.1 });
  at(boxes[1], "Costates", lines(costateNames, path.costates), { minRange: 0.1 });
  at(boxes[2], "Hamiltonian", [["H (1/s)", path.hamiltonian, curves[5]]], { minRange: 1e-3 });
  at(boxes[3], "Clearance (m)", [["", path.clearances, curves[5]]], { minRange: 0.1, includesZero: true });
  const duration = play.scenario.horizon ?? Number(durationOf(path).toFixed(3));
  drawAbscissa(boxes, "0", `${duration} s`, "time", height);
}
