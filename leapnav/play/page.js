"use strict";

// Colours of the optimum, of the other local optima, of Leapfrog's sweep and of the policy.
const OPTIMUM = "#d9730d", OTHER = "#8a8a8a", SWEEP = "#2a9d5c", POLICY = "#2662ab";
const PLOTS = 0.36; // share of the canvas's width
const IDLE = 250; // ms after the last change until the whole search begins
const byId = (id) => document.getElementById(id);
const canvas = byId("view"), pen = canvas.getContext("2d");

// What is shown; `window.play` for whoever wants to look at it.
const play = (window.play = {
  scenario: null, answer: null, before: null, shown: 0, sweeps: null, drive: null, chosen: null, time: null,
  waiting: 0, searched: false, error: null,
});
let drag = null, busy = false, searching = false, changed = false, timer = null, revision = 0;

// ---- Questions

async function ask(path, question) {
  play.waiting += 1;
  try {
    const asked = question && { method: "POST", headers: { "Content-Type": "application/json" } };
    const reply = await fetch(path, asked && { ...asked, body: JSON.stringify(question) }).catch(() => {
      throw new Error("the server does not answer");
    });
    const isJson = (reply.headers.get("content-type") || "").startsWith("application/json");
    const answer = isJson ? await reply.json() : { error: `the server answers ${reply.status}; see its terminal` };
    if (!reply.ok) throw new Error(answer.error);
    return answer;
  } finally {
    play.waiting -= 1;
  }
}

// The scenario was changed: follow it, always with the latest, and search everywhere when it rests.
function touch() {
  revision += 1;
  changed = true;
  play.searched = false;
  play.sweeps = null;
  play.drive = null;
  clearTimeout(timer);
  timer = setTimeout(search, IDLE);
  follow();
  show();
}

async function follow() {
  if (busy) return;
  busy = true;
  while (changed) {
    changed = false;
    try {
      const answer = await ask("/follow", { scenario: play.scenario, before: play.before });
      if (!play.searched) take(answer);
    } catch (error) {
      refuse(error);
    }
  }
  busy = false;
}

async function search() {
  // One at a time: the server answers in turn, and what is asked in vain would be in the way of what follows.
  if (drag !== null || searching) return;
  const asked = revision;
  searching = true;
  try {
    const answer = await ask("/search", { scenario: play.scenario });
    if (asked === revision) {
      play.searched = true;
      take(answer);
      if (byId("policy").value) await driven();
    }
  } catch (error) {
    if (asked === revision) refuse(error);
  } finally {
    searching = false;
  }
  if (asked !== revision) {
    clearTimeout(timer);
    timer = setTimeout(search, IDLE);
  }
}

function take(answer) {
  play.answer = answer;
  play.error = null;
  play.shown = 0;
  if (answer.id) play.before = answer.id;
  show();
}

function refuse(error) {
  play.error = error.message;
  show();
}

async function swept() {
  const asked = revision;
  byId("sweeps").disabled = true;
  try {
    const found = await ask("/sweeps", { scenario: play.scenario });
    if (asked !== revision) return;
    play.sweeps = found.sweeps;
    byId("number").max = Math.max(0, found.sweeps.length - 1);
    byId("number").value = 0;
    if (!found.sweeps.length) throw new Error(found.advice);
  } catch (error) {
    refuse(error);
  } finally {
    byId("sweeps").disabled = false;
    show();
  }
}

async function driven() {
  const asked = revision, policy = byId("policy").value;
  play.drive = null;
  show();
  if (!policy) return;
  try {
    const found = await ask("/drive", { scenario: play.scenario, policy });
    if (asked === revision && byId("policy").value === policy) play.drive = found;
  } catch (error) {
    refuse(error);
  }
  show();
}

function begin(scenario) {
  play.scenario = scenario;
  drag = null;
  play.chosen = null;
  play.before = null;
  play.answer = null;
  play.time = null;
  touch();
}

// ---- The plane

let view = { scale: 1, left: 0, top: 0 };
const toScreen = ([x, y]) => [view.left + view.scale * x, view.top - view.scale * y];
const toPlane = ([x, y]) => [(x - view.left) / view.scale, (view.top - y) / view.scale];

function fit(width, height) {
  const [x0, y0, x1, y1] = play.scenario.arena, room = 14;
  const scale = Math.min((width - 2 * room) / (x1 - x0), (height - 2 * room) / (y1 - y0));
  view = { scale, left: (width - scale * (x1 - x0)) / 2 - scale * x0, top: (height + scale * (y1 - y0)) / 2 + scale * y0 };
}

function line(points, color, width, dash = []) {
  pen.strokeStyle = color;
  pen.lineWidth = width;
  pen.setLineDash(dash);
  pen.beginPath();
  points.forEach((point, i) => (i ? pen.lineTo(...toScreen(point)) : pen.moveTo(...toScreen(point))));
  pen.stroke();
  pen.setLineDash([]);
}

const tip = ([x, y, heading]) => {
  const reach = Math.max(2.2 * play.scenario.robot.radius, 26 / view.scale);
  return [x + reach * Math.cos(heading), y + reach * Math.sin(heading)];
};

function robot(pose, color, filled, arrow) {
  const [x, y] = toScreen(pose), radius = view.scale * play.scenario.robot.radius;
  pen.lineWidth = 2;
  pen.strokeStyle = color;
  pen.beginPath();
  pen.arc(x, y, Math.max(radius, 3), 0, 2 * Math.PI);
  if (filled) {
    pen.fillStyle = color + "44";
    pen.fill();
  }
  pen.stroke();
  if (pose[2] === undefined || pose[2] === null) return;
  const end = arrow ? toScreen(tip(pose)) : [x + radius * Math.cos(pose[2]), y - radius * Math.sin(pose[2])];
  pen.beginPath();
  pen.moveTo(x, y);
  pen.lineTo(...end);
  pen.stroke();
  if (!arrow) return;
  pen.fillStyle = color;
  pen.beginPath();
  pen.arc(...end, 4, 0, 2 * Math.PI);
  pen.fill();
}

function outline(obstacle) {
  pen.beginPath();
  if (obstacle.circle) {
    pen.arc(...toScreen(obstacle.circle.center), view.scale * obstacle.circle.radius, 0, 2 * Math.PI);
  } else {
    obstacle.polygon.vertices.forEach((point, i) => (i ? pen.lineTo(...toScreen(point)) : pen.moveTo(...toScreen(point))));
    pen.closePath();
  }
}

// The pose at a time on a path of equally spaced states.
function poseAt(states, time, duration) {
  const place = Math.min(Math.max(time / duration, 0), 1) * (states.length - 1), k = Math.min(Math.floor(place), states.length - 2);
  if (k < 0) return states[0];
  return states[k].map((value, i) => value + (place - k) * (states[k + 1][i] - value));
}

function drawPlane(width, height) {
  const { scenario, answer } = play;
  fit(width, height);
  const [x0, y0, x1, y1] = scenario.arena, [left, top] = toScreen([x0, y1]);
  pen.fillStyle = "#fafafa";
  pen.fillRect(left, top, view.scale * (x1 - x0), view.scale * (y1 - y0));
  pen.strokeStyle = "#444";
  pen.lineWidth = 2;
  pen.strokeRect(left, top, view.scale * (x1 - x0), view.scale * (y1 - y0));
  (scenario.obstacles || []).forEach((obstacle, i) => {
    outline(obstacle);
    pen.fillStyle = i === play.chosen ? "#aebfd0" : "#c9c9c9";
    pen.fill();
    pen.strokeStyle = i === play.chosen ? "#336" : "#777";
    pen.lineWidth = i === play.chosen ? 2 : 1;
    pen.stroke();
  });
  const stale = play.error !== null;
  if (answer && answer.path) {
    answer.alternatives.forEach((other, i) => line(other.states, play.shown === i + 1 ? OPTIMUM : OTHER, 1.2, [5, 4]));
    if (play.sweeps && play.sweeps.length) {
      const sweep = play.sweeps[byId("number").value];
      line(sweep.states, SWEEP, 2);
      pen.fillStyle = SWEEP;
      for (const node of sweep.nodes) {
        pen.beginPath();
        pen.arc(...toScreen(node), 2.5, 0, 2 * Math.PI);
        pen.fill();
      }
    }
    line(answer.path.states, stale || !answer.success ? "#e9b98a" : OPTIMUM, 2.5);
  }
  if (play.drive) line(play.drive.states, POLICY, 2);
  robot(scenario.start, "#1a7a3c", true, true);
  robot(scenario.goal, "#b03a2e", true, true);
  if (play.time !== null) {
    if (answer && answer.path) robot(poseAt(answer.path.states, play.time, scenario.horizon), OPTIMUM, true, false);
    if (play.drive) {
      const duration = play.drive.period * (play.drive.states.length - 1);
      robot(poseAt(play.drive.states, play.time, Math.min(duration, scenario.horizon)), POLICY, true, false);
    }
  }
}

// ---- The optimum over time

function drawPlots(left, width, height) {
  const path = play.answer && play.answer.path;
  if (!path) return;
  const column = (rows, i) => rows.map((row) => row[i]);
  const plots = [
    ["controls", [["v (m/s)", column(path.controls, 0), "#2662ab"], ["ω (rad/s)", column(path.controls, 1), "#c0392b"]], 0.1],
    ["costates", [["λx", column(path.costates, 0), "#2662ab"], ["λy", column(path.costates, 1), "#2a9d5c"], ["λθ", column(path.costates, 2), "#c0392b"]], 0.1],
    ["Hamiltonian", [["H", path.hamiltonian, "#6b3fa0"]], 1e-3],
    ["clearance", [["m", path.along, "#555"]], 0.1],
  ];
  const gap = 30, each = (height - gap * plots.length - 8) / plots.length;
  plots.forEach(([title, curves, least], k) => {
    const top = 20 + k * (each + gap), all = curves.flatMap(([, values]) => values);
    let low = Math.min(...all), high = Math.max(...all);
    if (title === "clearance") low = Math.min(low, 0);
    const room = Math.max(0, least - (high - low)) / 2 + 0.05 * (high - low);
    low -= room;
    high += room;
    const at = (i, value) => [left + (i / (path.times.length - 1)) * width, top + each * (1 - (value - low) / (high - low))];
    pen.strokeStyle = "#bbb";
    pen.lineWidth = 1;
    pen.strokeRect(left, top, width, each);
    if (low < 0 && high > 0) {
      pen.beginPath();
      pen.moveTo(...at(0, 0));
      pen.lineTo(...at(path.times.length - 1, 0));
      pen.stroke();
    }
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.fillStyle = "#777";
    const digits = high - low < 0.01 ? 5 : 2;
    pen.fillText(high.toFixed(digits), left - 4, top + 9);
    pen.fillText(low.toFixed(digits), left - 4, top + each);
    pen.textAlign = "left";
    let x = left;
    pen.fillStyle = "#222";
    pen.fillText(title, x, top - 6);
    x += pen.measureText(title).width + 12;
    for (const [name, values, color] of curves) {
      pen.fillStyle = color;
      pen.fillText(name, x, top - 6);
      x += pen.measureText(name).width + 10;
      pen.strokeStyle = color;
      pen.lineWidth = 1.5;
      pen.beginPath();
      values.forEach((value, i) => (i ? pen.lineTo(...at(i, value)) : pen.moveTo(...at(i, value))));
      pen.stroke();
    }
    if (play.time !== null) {
      const x = left + (play.time / play.scenario.horizon) * width;
      pen.strokeStyle = OPTIMUM;
      pen.beginPath();
      pen.moveTo(x, top);
      pen.lineTo(x, top + each);
      pen.stroke();
    }
  });
  pen.fillStyle = "#777";
  pen.textAlign = "right";
  pen.fillText(`${play.scenario.horizon} s`, left + width, height - 4);
}

function draw() {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  if (!play.scenario) return;
  const split = width * (1 - PLOTS);
  drawPlane(split, height);
  drawPlots(split + 58, width - split - 72, height);
}

// ---- The column of figures

const text = (id, value) => (byId(id).textContent = value);
const number = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

function show() {
  draw();
  const { answer, error } = play, path = answer && answer.path;
  byId("status").classList.toggle("failed", error !== null || (answer !== null && !answer.success));
  text("status", error !== null ? error : answer ? (answer.success ? "Certified optimum" : answer.advice) : "Solving…");
  if (error === null && answer && answer.success && !play.searched) text("status", "Certified local optimum; searching…");
  text("cost", path ? number(path.cost, 6) : "–");
  text("clearance", path && path.clearance !== null ? `${number(path.clearance, 3)} m` : "–");
  text("residual", path && path.residual !== null ? path.residual.toExponential(0) : "–");
  text("milliseconds", answer ? `${number(answer.milliseconds, 1)} ms` : "–");
  const rows = path && play.searched ? [path, ...answer.alternatives] : path ? [path] : [];
  byId("alternatives").replaceChildren(
    ...rows.map((row, i) => {
      const element = document.createElement("tr");
      element.classList.toggle("shown", i === play.shown);
      const dearer = path.cost > 0 ? (100 * (row.cost / path.cost - 1)).toFixed(2) : "–";
      for (const cell of [number(row.cost, 4), dearer, number(row.clearance, 3), row.driving.join(", ")]) {
        element.appendChild(document.createElement("td")).textContent = cell;
      }
      element.addEventListener("click", () => {
        play.shown = i;
        show();
      });
      return element;
    }),
  );
  byId("number").disabled = !play.sweeps || !play.sweeps.length;
  const sweep = play.sweeps && play.sweeps[byId("number").value];
  text("sweep", sweep ? `sweep ${sweep.number}: J = ${sweep.cost.toFixed(4)}` : "");
  const drive = play.drive;
  const end = drive && (drive.success ? "reached the goal" : drive.collision ? "collided" : "missed the goal");
  const ratio = drive && drive.success && path && answer.success ? `, ${(drive.cost / path.cost).toFixed(3)} J*` : "";
  text("driven", drive ? `${end}, J = ${drive.cost.toFixed(4)}${ratio}` : "");
  byId("delete").disabled = play.chosen === null;
  if (document.activeElement !== byId("horizon") && play.scenario) byId("horizon").value = play.scenario.horizon;
}

// ---- Dragging

function inside(obstacle, [x, y]) {
  if (obstacle.circle) {
    const [cx, cy] = obstacle.circle.center;
    return Math.hypot(x - cx, y - cy) <= obstacle.circle.radius;
  }
  const points = obstacle.polygon.vertices;
  const sides = points.map(([ax, ay], i) => {
    const [bx, by] = points[(i + 1) % points.length];
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax);
  });
  return sides.every((side) => side >= 0) || sides.every((side) => side <= 0);
}

function grab(point) {
  const near = (a, b, pixels) => view.scale * Math.hypot(a[0] - b[0], a[1] - b[1]) <= pixels;
  for (const name of ["goal", "start"]) {
    const pose = play.scenario[name];
    if (pose[2] !== null && pose[2] !== undefined && near(tip(pose), point, 9)) return { kind: "turn", name };
    if (near(pose, point, Math.max(view.scale * play.scenario.robot.radius, 10))) return { kind: "pose", name };
  }
  const obstacles = play.scenario.obstacles || [];
  for (let i = obstacles.length - 1; i >= 0; i -= 1) if (inside(obstacles[i], point)) return { kind: "obstacle", i };
  return null;
}

function move(obstacle, dx, dy) {
  if (obstacle.circle) {
    const [x, y] = obstacle.circle.center;
    return { circle: { ...obstacle.circle, center: [x + dx, y + dy] } };
  }
  return { polygon: { vertices: obstacle.polygon.vertices.map(([x, y]) => [x + dx, y + dy]) } };
}

function resize(obstacle, factor) {
  if (obstacle.circle) return { circle: { ...obstacle.circle, radius: obstacle.circle.radius * factor } };
  const points = obstacle.polygon.vertices, middle = [0, 1].map((i) => points.reduce((sum, p) => sum + p[i], 0) / points.length);
  return { polygon: { vertices: points.map((p) => p.map((value, i) => middle[i] + factor * (value - middle[i]))) } };
}

function change(i, obstacle) {
  play.scenario.obstacles = play.scenario.obstacles.map((old, k) => (k === i ? obstacle : old));
  touch();
}

const place = (event) => {
  const box = canvas.getBoundingClientRect();
  return toPlane([event.clientX - box.left, event.clientY - box.top]);
};

canvas.addEventListener("pointerdown", (event) => {
  if (!play.scenario) return;
  const point = place(event), found = grab(point);
  play.chosen = found && found.kind === "obstacle" ? found.i : null;
  if (found) {
    drag = { ...found, from: point };
    canvas.setPointerCapture(event.pointerId);
  }
  show();
});

canvas.addEventListener("pointermove", (event) => {
  if (!drag) {
    if (play.scenario) canvas.style.cursor = grab(place(event)) ? "grab" : "default";
    return;
  }
  const point = place(event), [dx, dy] = [point[0] - drag.from[0], point[1] - drag.from[1]];
  if (drag.kind === "obstacle") {
    drag.from = point;
    change(drag.i, move(play.scenario.obstacles[drag.i], dx, dy));
    return;
  }
  const [x, y, heading] = play.scenario[drag.name];
  if (drag.kind === "turn") play.scenario[drag.name] = [x, y, Math.atan2(point[1] - y, point[0] - x)];
  else play.scenario[drag.name] = [x + dx, y + dy, heading === undefined ? null : heading];
  drag.from = point;
  touch();
});

for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, () => {
    if (!drag) return;
    drag = null;
    if (play.searched) return;
    clearTimeout(timer);
    timer = setTimeout(search, IDLE);
  });
}

// ---- Buttons and keys

function remove() {
  if (play.chosen === null) return;
  drag = null;
  play.scenario.obstacles = play.scenario.obstacles.filter((_, i) => i !== play.chosen);
  play.chosen = null;
  touch();
}

function add(make) {
  const [x0, y0, x1, y1] = play.scenario.arena;
  play.scenario.obstacles = [...(play.scenario.obstacles || []), make((x0 + x1) / 2, (y0 + y1) / 2)];
  play.chosen = play.scenario.obstacles.length - 1;
  touch();
}

const STEP = 0.05; // m
const ARROWS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };

canvas.addEventListener("keydown", (event) => {
  if (play.chosen === null) return;
  const obstacle = play.scenario.obstacles[play.chosen];
  if (event.key in ARROWS) change(play.chosen, move(obstacle, ...ARROWS[event.key]));
  else if (event.key === "+" || event.key === "=") change(play.chosen, resize(obstacle, 1.1));
  else if (event.key === "-") change(play.chosen, resize(obstacle, 1 / 1.1));
  else if (event.key === "Delete" || event.key === "Backspace") remove();
  else return;
  event.preventDefault();
});

byId("delete").addEventListener("click", remove);
byId("disc").addEventListener("click", () => add((x, y) => ({ circle: { center: [x, y], radius: 0.6 } })));
byId("box").addEventListener("click", () =>
  add((x, y) => ({ polygon: { vertices: [[x - 0.6, y - 0.4], [x + 0.6, y - 0.4], [x + 0.6, y + 0.4], [x - 0.6, y + 0.4]] } })));
byId("sweeps").addEventListener("click", swept);
byId("number").addEventListener("input", show);
byId("policy").addEventListener("change", driven);
byId("horizon").addEventListener("change", () => {
  play.scenario.horizon = Number(byId("horizon").value);
  touch();
});

let loads = 0;

byId("load").addEventListener("click", async () => {
  const query = new URLSearchParams({ family: byId("family").value, index: byId("index").value || "0" });
  const load = (loads += 1);
  try {
    const found = await ask(`/bank?${query}`);
    if (load === loads) begin(found.scenario);
  } catch (error) {
    refuse(error);
  }
});

byId("open").addEventListener("click", () => byId("file").click());
byId("file").addEventListener("change", async () => {
  const [file] = byId("file").files;
  if (!file) return;
  byId("file").value = "";
  try {
    const scenario = JSON.parse((await file.text()).replace(/^\uFEFF/, ""));
    begin((await ask("/check", { scenario })).scenario);
  } catch (error) {
    refuse(new Error(`${file.name}: ${error.message}`));
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
    const first = await ask("/first");
    for (const policy of first.policies) byId("policy").add(new Option(policy, policy));
    begin(first.scenario);
  } catch (error) {
    refuse(error);
  }
})();
