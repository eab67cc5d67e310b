// The two guided lessons: their numbers and sentences come from the server, see lessons.py.

import { byId, closeLesson, lessonScenario, lessonStep, play, request, setText, show, showError } from "./state.js";
import { drawLine, drawPoints, drawPoses, drawScenario, poseAt } from "./canvas.js";
import { drawAbscissa, drawPlot, plotBoxes } from "./plots.js";

// The iterate of a method at the step; a method that has ended keeps its last one.
const iterateAt = (method, step) => method.iterates[Math.min(step, method.iterates.length - 1)];

const methodColor = (i) => play.colors.curves[[0, 3, 2][i]]; // the second curve's colour is close to the optimum's
const METHOD_LABELS = ["single", "multiple", "Leapfrog"];

const BRANCHES = { minimum: "local minimum", saddle: "saddle", lost: "Leapfrog beyond the fold" };

function branchColor(branch) {
  return { minimum: play.colors.alternatives[0], saddle: play.colors.failure, lost: play.colors.sweep }[branch];
}

export async function openLesson(name) {
  if (play.driving) return;
  play.lesson = { name, content: null, step: 0 };
  play.notice = null;
  const opened = play.lesson;
  show();
  setText("lesson-title", "Computing…");
  try {
    const content = await request("/lesson", { lesson: name });
    if (play.lesson !== opened) return;
    play.lesson.content = content;
    byId("lesson-slider").max = content.steps.length - 1;
    show();
    byId("lesson-box").focus({ preventScroll: true });
    byId("stage").scrollIntoView({ block: "start" });
  } catch (error) {
    play.lesson = null;
    showError(error);
  }
}

function setLessonStep(step) {
  if (!play.lesson || !play.lesson.content) return;
  play.lesson.step = Math.min(Math.max(step, 0), play.lesson.content.steps.length - 1);
  show();
}

// ---- The box with text, numbers and controls

function lessonTable() {
  const { name, content, step } = play.lesson;
  if (name === "methods") {
    return {
      header: ["method", "cost J", "residual", "to the goal", "state"],
      rows: content.methods.map((method, i) => {
        const iterate = iterateAt(method, step), last = method.iterates.length - 1;
        const state = step < last ? `iteration ${step}` : `${method.status} at iteration ${last}`;
        const miss = iterate.miss < 5e-4 ? "0" : iterate.miss.toFixed(3);
        const cost = iterate.cost < 1e4 ? iterate.cost.toFixed(4) : iterate.cost.toExponential(0);  // in contact
        return [methodColor(i), method.name, cost, iterate.residual.toExponential(0),
          `${miss}\u00a0m`, state];
      }),
    };
  }
  const { branch, cost, status, optimum, conjugate_time: time, horizon } = lessonStep();
  const point = time === null ? "–" : `${time.toFixed(2)}\u00a0s, ${(time / horizon).toFixed(3)}\u00a0T`;
  return {
    header: ["extremal", "cost J", "conjugate point", "status"],
    rows: [
      [branchColor(branch), BRANCHES[branch], cost.toFixed(4), point, branch === "lost" ? `Newton: ${status}` : status],
      [play.colors.optimum, "global optimum", optimum.cost.toFixed(4), "", ""],
    ],
  };
}

export function showLesson() {
  const isOpen = play.lesson !== null;
  document.body.classList.toggle("has-lesson", isOpen);
  byId("lesson-box").hidden = !isOpen;
  if (!isOpen || !play.lesson.content) return;
  const { content, step } = play.lesson, { title, text } = lessonStep(), { header, rows } = lessonTable();
  setText("lesson-title", content.title);
  setText("lesson-step", `${title} (${step + 1}/${content.steps.length})`);
  setText("lesson-text", text.replace(/(\d)e-/g, "$1e\u2011")); // numbers are not broken
  byId("lesson-slider").value = step;
  byId("lesson-previous").disabled = step === 0;
  byId("lesson-next").disabled = step === content.steps.length - 1;
  const cells = (tag, values) => values.map((value) => {
    const cell = document.createElement(tag);
    cell.textContent = value;
    return cell;
  });
  const line = (elements) => {
    const row = document.createElement("tr");
    row.append(...elements);
    return row;
  };
  byId("lesson-table").replaceChildren(
    line(cells("th", header)),
    ...rows.map(([color, ...values]) => {
      const elements = cells("td", values);
      elements[0].style.borderLeftColor = color;
      return line(elements);
    }),
  );
}

// ---- Drawing

export function drawLesson() {
  const { name, content, step } = play.lesson, scenario = lessonScenario(), colors = play.colors;
  drawScenario(scenario);
  if (name === "methods") {
    drawLine(content.optimum.states, colors.optimum, 5);
    content.methods.forEach((method, i) => {
      const iterate = iterateAt(method, step);
      for (const piece of iterate.pieces) drawLine(piece, methodColor(i), 2.2);
      if (iterate.pieces.length > 1) drawPoints(iterate.nodes, methodColor(i), 3.5);
    });
  } else {
    const { branch, states, optimum, conjugate_time: time, horizon } = lessonStep();
    drawLine(optimum.states, colors.optimum, 2.5);
    if (branch === "lost") drawLine(content.steps[step - 1].states, colors.alternatives[0], 1.5, [5, 4]);
    drawLine(states, branchColor(branch), 2.5, branch === "lost" ? [8, 6] : []);
    if (time !== null && time < horizon) drawPoints([poseAt(states, time, horizon)], branchColor(branch), 6);
  }
  drawPoses(scenario);
}

export function drawLessonPlots(width, height) {
  const { name, content, step } = play.lesson, colors = play.colors;
  if (name === "methods") {
    const indices = content.steps.map((_, k) => k), marks = [[step, colors.wall]];
    const curves = (key, methods = [0, 1, 2]) => methods.map((i) => {
      const { iterates } = content.methods[i];
      return [METHOD_LABELS[i], indices.map((k) => (k < iterates.length ? iterates[k][key] : null)), methodColor(i)];
    });
    const boxes = plotBoxes(3, width, height, 0), options = { marks, dots: true };
    drawPlot(boxes[0], "Residual", curves("residual"), indices, { ...options, isLogarithmic: true });
    drawPlot(boxes[1], "Distance to the goal (m)", curves("miss", [0, 1]), indices, { ...options, includesZero: true });
    const optimum = ["optimum", indices.map(() => content.optimum.cost), colors.optimum, [4, 3]];
    drawPlot(boxes[2], "Cost J", [...curves("cost", [1, 2]), optimum], indices, options);
    drawAbscissa(boxes, "0", String(indices.length - 1), "iteration", height);
    return;
  }
  const { steps } = content, headings = steps.map(({ heading }) => heading), marks = [[headings[step], colors.wall]];
  const fold = steps.findIndex(({ branch }) => branch === "lost") - 1;
  const values = (key, branch) => steps.map((row, k) =>
    row.branch === branch || (branch === "saddle" && k === fold) ? row[key] : null);
  const optimum = steps.map((row) => (row.branch === "saddle" ? null : row.optimum.cost));
  const boxes = plotBoxes(2, width, height, 0), options = { marks, dots: true };
  drawPlot(boxes[0], "Cost J", [
    ["minimum", values("cost", "minimum"), branchColor("minimum")],
    ["saddle", values("cost", "saddle"), branchColor("saddle")], ["optimum", optimum, colors.optimum],
  ], headings, options);
  drawPlot(boxes[1], "Conjugate point (s)", [
    ["minimum", values("conjugate_time", "minimum"), branchColor("minimum")],
    ["saddle", values("conjugate_time", "saddle"), branchColor("saddle")],
    ["horizon", steps.map(({ horizon }, k) => (k === 0 || k === fold + 1 ? horizon : null)), colors.wall, [4, 3]],
  ], headings, options);
  drawAbscissa(boxes, Math.min(...headings).toFixed(2), Math.max(...headings).toFixed(2), "heading of the goal (rad)", height);
}

// ---- Controls

byId("lesson-previous").addEventListener("click", () => setLessonStep(play.lesson.step - 1));
byId("lesson-next").addEventListener("click", () => setLessonStep(play.lesson.step + 1));
byId("lesson-slider").addEventListener("input", () => setLessonStep(Number(byId("lesson-slider").value)));
byId("lesson-close").addEventListener("click", closeLesson);
for (const button of document.querySelectorAll("[data-lesson]")) {
  button.addEventListener("click", () => openLesson(button.dataset.lesson));
}

byId("lesson-box").addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (event.key === "Escape") closeLesson();
  else if (step && event.target !== byId("lesson-slider")) setLessonStep(play.lesson.step + step);
  else return;
  event.preventDefault();
});
