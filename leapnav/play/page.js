// The panels of the page and their controls.

import {
  byId, canEdit, changeScenario, closeLesson, drivePolicy, durationOf, edit, format, isFree, loadSweeps, modelOf,
  play, request, robotOf, setDisplay, setScenario, setText, show, showError, shownTime,
} from "./state.js";
import { alternativeColor, canvas } from "./canvas.js";
import { showLesson } from "./lessons.js";
import { draw, resize } from "./drawing.js";
import { showSelection } from "./editing.js";
import { moves } from "./shapes.js";
import { openLink } from "./link.js";
import { describeEpisode } from "./driving.js";

const DEFAULT_HORIZON = 10, DEFAULT_TIME_WEIGHT = 0.5; // s, 1/s
const DEFAULT_FAMILY = "clutter";

const settings = () => document.querySelectorAll("[data-group]"); // number inputs of robot and cost

// ---- Display

function display() {
  draw();
  const { solution, error, episode } = play, path = solution && solution.path;
  byId("status").classList.toggle("failed", error !== null || (solution !== null && !solution.success));
  if (error !== null) setText("status", error);
  else if (!solution) setText("status", "Solving…");
  else setText("status", solution.success ? (play.searched ? "Certified optimum" : "Certified local optimum; searching…") : failureText());
  const needed = error === null && solution && !solution.success ? solution.needed_horizon : null;
  byId("use-horizon").hidden = !needed;
  if (needed) setText("use-horizon", `Use ${needed}\u00a0s`);
  setText("notice", play.notice || "");
  setText("cost", path ? format(path.cost, 6) : "–");
  byId("barrier-term").hidden = byId("barrier").hidden = !(path && path.barrier > 0);
  if (path) setText("barrier", `${format(100 * path.barrier, 3)}\u00a0% of J`);
  setText("duration", path ? `${format(durationOf(path), 3)}\u00a0s` : "–");
  setText("clearance", path && path.clearance !== null ? `${format(path.clearance, 3)}\u00a0m` : "–");
  setText("residual", path && path.residual !== null ? path.residual.toExponential(0) : "–");
  setText("milliseconds", solution ? `${format(solution.milliseconds, 1)}\u00a0ms` : "–");
  showAlternatives(path);
  byId("sweep-slider").disabled = !play.sweeps || !play.sweeps.length;
  const sweep = play.sweeps && play.sweeps[byId("sweep-slider").value];
  setText("sweep", sweep ? `sweep ${sweep.index}: J = ${sweep.cost.toFixed(4)}` : "");
  setText("episode", episode ? describeEpisode(episode) : "");
  if (episode) byId("episode").style.color = episode.success ? play.colors.policy : play.colors.failure;
  byId("drive-box").hidden = play.driving === null;
  document.body.classList.toggle("is-driving", play.driving !== null);
  showTime();
  showSelection();
  showSettings();
  showLesson();
}

function failureText() {
  const { solution, scenario } = play;
  if (solution.status !== "HORIZON_TOO_SHORT") return solution.advice;
  const reach = `The goal is out of reach in ${scenario.horizon}\u00a0s at the robot's limits`;
  if (solution.needed_horizon) return `${reach}; ${solution.needed_horizon}\u00a0s are needed.`;
  return play.searched ? `${reach}, and no longer horizon was found that suffices.` : `${reach}.`;
}

let shownRows = null; // solution and state of the search whose rows the table contains

function showAlternatives(path) {
  const key = path && play.searched ? play.solution : path;
  if (key !== shownRows) {
    const rows = path && play.searched ? [path, ...play.solution.alternatives] : path ? [path] : [];
    byId("alternatives").replaceChildren(...rows.map((row, i) => alternativeRow(row, i, path)));
    shownRows = key;
  }
  [...byId("alternatives").children].forEach((element, i) => {
    element.classList.toggle("highlighted", i === play.highlighted);
    element.setAttribute("aria-selected", String(i === play.highlighted));
  });
}

function alternativeRow(row, i, path) {
  const element = document.createElement("tr");
  const excess = path.cost > 0 ? (100 * (row.cost / path.cost - 1)).toFixed(2) : "–";
  for (const cell of [format(row.cost, 4), excess, format(row.clearance, 3), row.driving.join(", ")]) {
    element.appendChild(document.createElement("td")).textContent = cell;
  }
  element.firstChild.style.borderLeftColor = i ? alternativeColor(i - 1) : play.colors.optimum;
  element.tabIndex = 0;
  const highlight = () => {
    play.highlighted = i;
    show();
  };
  element.addEventListener("click", highlight);
  element.addEventListener("keydown", (event) => {
    const neighbour = { ArrowDown: element.nextSibling, ArrowUp: element.previousSibling }[event.key];
    if (event.key === "Enter" || event.key === " ") highlight();
    else if (neighbour) neighbour.focus();
    else return;
    event.preventDefault();
  });
  return element;
}

// Numbers of the scenario; a field that is being edited keeps its text.
function showSettings() {
  if (!play.scenario) return;
  const free = isFree(play.scenario), path = play.solution && play.solution.path;
  byId("free-horizon").checked = free;
  byId("horizon").disabled = free;
  if (free) byId("horizon").value = path ? durationOf(path).toFixed(2) : "";
  else if (document.activeElement !== byId("horizon")) byId("horizon").value = play.scenario.horizon;
  showRobotFields();
  const { weights } = robotOf(play.scenario);
  for (const input of settings()) {
    const { group, field } = input.dataset, value = (play.scenario[group] || {})[field];
    if (document.activeElement !== input) input.value = value === undefined ? "" : value;
    if (field === "speed_weight" || field === "turn_weight") input.disabled = !weights.includes(field);
    if (field === "time_weight") input.disabled = !free;
  }
}

// The slider of the time, if an obstacle moves.
function showTime() {
  const { scenario, solution, lesson } = play, path = solution && solution.path;
  byId("time-box").hidden = !scenario || lesson !== null || !(scenario.obstacles || []).some(moves);
  if (!scenario) return;
  const end = scenario.horizon ?? (path ? durationOf(path) : play.clock), slider = byId("time-slider");
  if (end > 0) slider.max = end;
  slider.value = shownTime();
  setText("time-shown", `${shownTime().toFixed(1)}\u00a0s`);
}

let shownFields = null; // the names of the robot's numbers that have inputs, as one text

// A robot with a footprint has no radius; footprints are not edited.
function showRobotFields() {
  byId("model").value = modelOf(play.scenario);
  const hidden = (play.scenario.robot || {}).footprint ? ["model", "radius"] : ["model"];
  const { fields } = robotOf(play.scenario);
  const numbers = Object.keys(fields).filter((field) => typeof fields[field] === "number" && !hidden.includes(field));
  if (numbers.join() === shownFields) return;
  shownFields = numbers.join();
  byId("robot-fields").replaceChildren(...numbers.flatMap((field) => {
    const label = document.createElement("label"), input = document.createElement("input");
    input.id = label.htmlFor = field.replaceAll("_", "-");
    label.textContent = `${field[0].toUpperCase()}${field.slice(1).replaceAll("_", " ")}`;
    Object.assign(input, { type: "number", min: 0, step: 0.05 });
    Object.assign(input.dataset, { group: "robot", field });
    return [label, input];
  }));
}

// ---- Controls

document.addEventListener("change", ({ target: input }) => {
  const { group, field } = input.dataset;
  if (group && canEdit()) edit({ [group]: { ...play.scenario[group], [field]: Number(input.value) } });
});

// Another model starts with its defaults and the present radius or footprint; weights that it does not use get their default.
byId("model").addEventListener("change", () => {
  if (!canEdit()) return;
  const { fields: { radius, ...fields }, weights } = play.robots[byId("model").value];
  const { start_motion, goal_motion, ...scenario } = play.scenario;
  const kept = [...weights, "proximity_weight", "proximity_scale", "time_weight"];
  const cost = Object.entries(scenario.cost || {}).filter(([name]) => kept.includes(name));
  const { radius: present, footprint } = scenario.robot || {};
  const size = footprint ? { footprint } : { radius: present || radius };
  changeScenario({ ...scenario, robot: { ...fields, ...size }, cost: Object.fromEntries(cost) });
});

byId("horizon").addEventListener("change", () => {
  if (canEdit()) edit({ horizon: Number(byId("horizon").value) });
});

// A horizon that becomes fixed is the duration of the optimum.
byId("free-horizon").addEventListener("change", () => {
  if (!canEdit()) return;
  const { time_limit: limit, ...scenario } = play.scenario, { time_weight: weight, ...cost } = scenario.cost || {};
  const path = play.solution && play.solution.path;
  const duration = path ? Math.max(Number(durationOf(path).toFixed(2)), 0.01) : DEFAULT_HORIZON;
  if (isFree(scenario)) changeScenario({ ...scenario, horizon: duration, cost });
  else changeScenario({ ...scenario, horizon: null, cost: { ...cost, time_weight: DEFAULT_TIME_WEIGHT } });
});

byId("use-horizon").addEventListener("click", () => {
  const { needed_horizon: needed } = play.solution;
  if (canEdit() && needed) edit({ horizon: needed });
});

byId("sweeps").addEventListener("click", loadSweeps);
byId("sweep-slider").addEventListener("input", show);
byId("time-slider").addEventListener("input", () => {
  play.clock = Number(byId("time-slider").value);
  show();
});
byId("policy").addEventListener("change", drivePolicy);

let loads = 0; // number of clicks on Load; only the response to the last one counts

byId("load").addEventListener("click", async () => {
  const query = new URLSearchParams({ family: byId("family").value, index: byId("index").value || "0" });
  const load = (loads += 1);
  try {
    const result = await request(`/bank?${query}`);
    if (load !== loads || play.driving) return;
    closeLesson();
    setScenario(result.scenario);
  } catch (error) {
    showError(error);
  }
});

byId("open").addEventListener("click", () => byId("file").click());
byId("file").addEventListener("change", async () => {
  const [file] = byId("file").files;
  if (!file) return;
  byId("file").value = "";
  try {
    const scenario = JSON.parse((await file.text()).replace(/^\uFEFF/, ""));
    const checked = await request("/check", { scenario });
    closeLesson();
    setScenario(checked.scenario);
  } catch (error) {
    showError(new Error(`${file.name}: ${error.message}`));
  }
});

byId("save").addEventListener("click", () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(play.scenario) + "\n"], { type: "application/json" }));
  link.download = `${(play.scenario.name || "scenario").replace(/[^\w.-]+/g, "-")}.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
});

byId("play").addEventListener("click", () => {
  let start = null;
  function frame(now) {
    start = start === null ? now : start;
    const time = (now - start) / 1000;
    const path = play.solution && play.solution.path, duration = play.scenario.horizon ?? (path ? durationOf(path) : 0);
    play.time = time <= duration && canEdit() ? time : null;
    draw();
    showTime();
    if (play.time !== null) requestAnimationFrame(frame);
  }
  requestAnimationFrame(frame);
});

document.addEventListener("keydown", (event) => {
  if (event.key !== "?" || event.target.matches("input, select, textarea")) return;
  byId("keys").open = !byId("keys").open;
  if (byId("keys").open) byId("keys").scrollIntoView({ block: "nearest" });
});

setDisplay(display);
const observer = new ResizeObserver(resize);
observer.observe(canvas);
observer.observe(byId("plots"));

(async () => {
  try {
    const initial = await request("/initial");
    play.colors = initial.colors;
    play.robots = initial.robots;
    for (const model of Object.keys(initial.robots)) byId("model").add(new Option(model.replaceAll("_", " "), model));
    document.documentElement.style.setProperty("--failure", initial.colors.failure);
    for (const family of initial.families) byId("family").add(new Option(family, family));
    byId("family").value = DEFAULT_FAMILY;
    for (const policy of initial.policies) byId("policy").add(new Option(policy, policy));
    if (await openLink()) return;
    const { notice } = play;
    setScenario(initial.scenario);
    play.notice = notice;
    show();
  } catch (error) {
    showError(error);
  }
})();
