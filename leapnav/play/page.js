"use strict";

// State, requests and controls of the page. canvas.js draws it.

const SEARCH_DELAY = 250; // ms from the last change to the start of the full search

// What the page shows. It is a property of `window` so that tests and the console can read it.
const play = (window.play = {
  scenario: null, // as in a scenario file
  solution: null, // latest response of /follow or /search
  previousId: null, // id of the latest certified solution, the initial guess of the next one
  highlighted: 0, // row of the table of local optima
  sweeps: null,
  episode: null, // response of /drive
  selected: null, // index of an obstacle
  time: null, // s, during an animation
  pending: 0, // number of open requests
  searched: false, // whether the solution is that of the full search
  error: null,
});
let drag = null, following = false, searching = false, changed = false, searchTimer = null, revision = 0;

// ---- Requests

async function request(path, content) {
  play.pending += 1;
  try {
    const options = content && {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content),
    };
    const response = await fetch(path, options).catch(() => {
      throw new Error("the server does not respond");
    });
    const isJson = (response.headers.get("content-type") || "").startsWith("application/json");
    const result = isJson ? await response.json() : { error: `error ${response.status}; see the terminal of the server` };
    if (!response.ok) throw new Error(result.error);
    return result;
  } finally {
    play.pending -= 1;
  }
}

function scheduleSearch() {
  clearTimeout(searchTimer);
  searchTimer = setTimeout(search, SEARCH_DELAY);
}

// Called after every change of the scenario: a local optimum follows at once, the full search when changes pause.
function scenarioChanged() {
  revision += 1;
  changed = true;
  play.searched = false;
  play.sweeps = null;
  play.episode = null;
  scheduleSearch();
  follow();
  show();
}

async function follow() {
  if (following) return;
  following = true;
  while (changed) {
    changed = false;
    try {
      const solution = await request("/follow", { scenario: play.scenario, previous: play.previousId });
      if (!play.searched) setSolution(solution);
    } catch (error) {
      showError(error);
    }
  }
  following = false;
}

async function search() {
  // One search at a time: the server handles requests in order, and outdated ones would delay the next.
  if (drag !== null || searching) return;
  const searchedRevision = revision;
  searching = true;
  try {
    const solution = await request("/search", { scenario: play.scenario });
    if (searchedRevision === revision) {
      play.searched = true;
      setSolution(solution);
      if (byId("policy").value) await drivePolicy();
    }
  } catch (error) {
    if (searchedRevision === revision) showError(error);
  } finally {
    searching = false;
  }
  if (searchedRevision !== revision) scheduleSearch();
}

function setSolution(solution) {
  play.solution = solution;
  play.error = null;
  play.highlighted = 0;
  if (solution.id) play.previousId = solution.id;
  show();
}

function showError(error) {
  play.error = error.message;
  show();
}

async function loadSweeps() {
  const sweptRevision = revision;
  byId("sweeps").disabled = true;
  try {
    const result = await request("/sweeps", { scenario: play.scenario });
    if (sweptRevision !== revision) return;
    play.sweeps = result.sweeps;
    byId("sweep-slider").max = Math.max(0, result.sweeps.length - 1);
    byId("sweep-slider").value = 0;
    if (!result.sweeps.length) throw new Error(result.advice);
  } catch (error) {
    showError(error);
  } finally {
    byId("sweeps").disabled = false;
    show();
  }
}

async function drivePolicy() {
  const drivenRevision = revision, policy = byId("policy").value;
  play.episode = null;
  show();
  if (!policy) return;
  try {
    const episode = await request("/drive", { scenario: play.scenario, policy });
    if (drivenRevision === revision && byId("policy").value === policy) play.episode = episode;
  } catch (error) {
    showError(error);
  }
  show();
}

function setScenario(scenario) {
  play.scenario = scenario;
  drag = null;
  play.selected = null;
  play.previousId = null;
  play.solution = null;
  play.time = null;
  scenarioChanged();
}

// ---- The side panel

const setText = (id, value) => (byId(id).textContent = value);
const format = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

function show() {
  draw();
  const { solution, error, episode } = play, path = solution && solution.path;
  byId("status").classList.toggle("failed", error !== null || (solution !== null && !solution.success));
  if (error !== null) setText("status", error);
  else if (!solution) setText("status", "Solving…");
  else if (!solution.success) setText("status", solution.advice);
  else setText("status", play.searched ? "Certified optimum" : "Certified local optimum; searching…");
  setText("cost", path ? format(path.cost, 6) : "–");
  setText("clearance", path && path.clearance !== null ? `${format(path.clearance, 3)} m` : "–");
  setText("residual", path && path.residual !== null ? path.residual.toExponential(0) : "–");
  setText("milliseconds", solution ? `${format(solution.milliseconds, 1)} ms` : "–");
  const rows = path && play.searched ? [path, ...solution.alternatives] : path ? [path] : [];
  byId("alternatives").replaceChildren(
    ...rows.map((row, i) => {
      const element = document.createElement("tr");
      element.classList.toggle("highlighted", i === play.highlighted);
      const excess = path.cost > 0 ? (100 * (row.cost / path.cost - 1)).toFixed(2) : "–";
      for (const cell of [format(row.cost, 4), excess, format(row.clearance, 3), row.driving.join(", ")]) {
        element.appendChild(document.createElement("td")).textContent = cell;
      }
      element.addEventListener("click", () => {
        play.highlighted = i;
        show();
      });
      return element;
    }),
  );
  byId("sweep-slider").disabled = !play.sweeps || !play.sweeps.length;
  const sweep = play.sweeps && play.sweeps[byId("sweep-slider").value];
  setText("sweep", sweep ? `sweep ${sweep.index}: J = ${sweep.cost.toFixed(4)}` : "");
  const outcome = episode && (episode.success ? "reached the goal" : episode.collision ? "collided" : "missed the goal");
  const hasRatio = episode && episode.success && path && solution.success;
  const ratio = hasRatio ? `, ${(episode.cost / path.cost).toFixed(3)} J*` : "";
  setText("episode", episode ? `${outcome}, J = ${episode.cost.toFixed(4)}${ratio}` : "");
  byId("delete").disabled = play.selected === null;
  if (document.activeElement !== byId("horizon") && play.scenario) byId("horizon").value = play.scenario.horizon;
}

// ---- Editing

function isInside(obstacle, [x, y]) {
  if (obstacle.circle) {
    const [cx, cy] = obstacle.circle.center;
    return Math.hypot(x - cx, y - cy) <= obstacle.circle.radius;
  }
  const vertices = obstacle.polygon.vertices;
  const sides = vertices.map(([ax, ay], i) => {
    const [bx, by] = vertices[(i + 1) % vertices.length];
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax);
  });
  return sides.every((side) => side >= 0) || sides.every((side) => side <= 0);
}

// What can be dragged at a point (m): the heading or the position of a pose, or an obstacle.
function findHandle(point) {
  const isWithin = (a, b, pixels) => view.scale * Math.hypot(a[0] - b[0], a[1] - b[1]) <= pixels;
  for (const name of ["goal", "start"]) {
    const pose = play.scenario[name], hasHeading = pose[2] !== null && pose[2] !== undefined;
    if (hasHeading && isWithin(arrowTip(pose), point, 9)) return { kind: "heading", name };
    if (isWithin(pose, point, Math.max(view.scale * play.scenario.robot.radius, 10))) return { kind: "position", name };
  }
  const obstacles = play.scenario.obstacles || [];
  for (let i = obstacles.length - 1; i >= 0; i -= 1) if (isInside(obstacles[i], point)) return { kind: "obstacle", i };
  return null;
}

function moved(obstacle, dx, dy) {
  if (obstacle.circle) {
    const [x, y] = obstacle.circle.center;
    return { circle: { ...obstacle.circle, center: [x + dx, y + dy] } };
  }
  return { polygon: { vertices: obstacle.polygon.vertices.map(([x, y]) => [x + dx, y + dy]) } };
}

function scaled(obstacle, factor) {
  if (obstacle.circle) return { circle: { ...obstacle.circle, radius: obstacle.circle.radius * factor } };
  const vertices = obstacle.polygon.vertices;
  const center = [0, 1].map((i) => vertices.reduce((sum, vertex) => sum + vertex[i], 0) / vertices.length);
  const scale = (vertex) => vertex.map((value, i) => center[i] + factor * (value - center[i]));
  return { polygon: { vertices: vertices.map(scale) } };
}

function replaceObstacle(i, obstacle) {
  play.scenario.obstacles = play.scenario.obstacles.map((old, k) => (k === i ? obstacle : old));
  scenarioChanged();
}

const eventPoint = (event) => {
  const box = canvas.getBoundingClientRect();
  return toPlane([event.clientX - box.left, event.clientY - box.top]);
};

canvas.addEventListener("pointerdown", (event) => {
  if (!play.scenario) return;
  const point = eventPoint(event), handle = findHandle(point);
  play.selected = handle && handle.kind === "obstacle" ? handle.i : null;
  if (handle) {
    drag = { ...handle, from: point };
    canvas.setPointerCapture(event.pointerId);
  }
  show();
});

canvas.addEventListener("pointermove", (event) => {
  if (!drag) {
    if (play.scenario) canvas.style.cursor = findHandle(eventPoint(event)) ? "grab" : "default";
    return;
  }
  const point = eventPoint(event), [dx, dy] = [point[0] - drag.from[0], point[1] - drag.from[1]];
  if (drag.kind === "obstacle") {
    drag.from = point;
    replaceObstacle(drag.i, moved(play.scenario.obstacles[drag.i], dx, dy));
    return;
  }
  const [x, y, heading] = play.scenario[drag.name];
  if (drag.kind === "heading") play.scenario[drag.name] = [x, y, Math.atan2(point[1] - y, point[0] - x)];
  else play.scenario[drag.name] = [x + dx, y + dy, heading === undefined ? null : heading];
  drag.from = point;
  scenarioChanged();
});

for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, () => {
    if (!drag) return;
    drag = null;
    if (!play.searched) scheduleSearch();
  });
}

// ---- Buttons and keys

function removeSelected() {
  if (play.selected === null) return;
  drag = null;
  play.scenario.obstacles = play.scenario.obstacles.filter((_, i) => i !== play.selected);
  play.selected = null;
  scenarioChanged();
}

function addObstacle(makeAt) {
  const [x0, y0, x1, y1] = play.scenario.arena;
  play.scenario.obstacles = [...(play.scenario.obstacles || []), makeAt((x0 + x1) / 2, (y0 + y1) / 2)];
  play.selected = play.scenario.obstacles.length - 1;
  scenarioChanged();
}

const STEP = 0.05; // m per key press
const ARROWS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
const SCALE = 1.1; // per key press

canvas.addEventListener("keydown", (event) => {
  if (play.selected === null) return;
  const obstacle = play.scenario.obstacles[play.selected];
  if (event.key in ARROWS) replaceObstacle(play.selected, moved(obstacle, ...ARROWS[event.key]));
  else if (event.key === "+" || event.key === "=") replaceObstacle(play.selected, scaled(obstacle, SCALE));
  else if (event.key === "-") replaceObstacle(play.selected, scaled(obstacle, 1 / SCALE));
  else if (event.key === "Delete" || event.key === "Backspace") removeSelected();
  else return;
  event.preventDefault();
});

byId("delete").addEventListener("click", removeSelected);
byId("add-disc").addEventListener("click", () => addObstacle((x, y) => ({ circle: { center: [x, y], radius: 0.6 } })));
byId("add-box").addEventListener("click", () =>
  addObstacle((x, y) =>
    ({ polygon: { vertices: [[x - 0.6, y - 0.4], [x + 0.6, y - 0.4], [x + 0.6, y + 0.4], [x - 0.6, y + 0.4]] } })));
byId("sweeps").addEventListener("click", loadSweeps);
byId("sweep-slider").addEventListener("input", show);
byId("policy").addEventListener("change", drivePolicy);
byId("horizon").addEventListener("change", () => {
  play.scenario.horizon = Number(byId("horizon").value);
  scenarioChanged();
});

let loads = 0; // number of clicks on Load; only the response to the last one counts

byId("load").addEventListener("click", async () => {
  const query = new URLSearchParams({ family: byId("family").value, index: byId("index").value || "0" });
  const load = (loads += 1);
  try {
    const result = await request(`/bank?${query}`);
    if (load === loads) setScenario(result.scenario);
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
    setScenario((await request("/check", { scenario })).scenario);
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
    play.time = time <= play.scenario.horizon ? time : null;
    draw();
    if (play.time !== null) requestAnimationFrame(frame);
  }
  requestAnimationFrame(frame);
});

new ResizeObserver(draw).observe(canvas);

(async () => {
  try {
    const initial = await request("/initial");
    for (const policy of initial.policies) byId("policy").add(new Option(policy, policy));
    setScenario(initial.scenario);
  } catch (error) {
    showError(error);
  }
})();
