"use strict";

// A person drives the robot: keys or a touch pad, in real time, with the robot's exact motion. At the end the server
// replays the actions in the environment and compares their cost with the optimum.

const CONTROL_PERIOD = 0.05; // s, as in the environment
const MAX_CATCH_UP = 0.25; // s; a longer pause of the page does not count as driving time
const SPEED_SMOOTHING = 0.2, TURN_SMOOTHING = 0.3; // largest change of an action per control period, by key
const MAX_DRIVEN_HORIZON = 300; // s, as on the server
const POSITION_TOLERANCE = 0.1, HEADING_TOLERANCE = 0.1; // m, rad, as in the environment
const DRIVE_KEYS = {
  ArrowUp: [1, 0], w: [1, 0], ArrowDown: [-1, 0], s: [-1, 0], ArrowLeft: [0, 1], a: [0, 1], ArrowRight: [0, -1], d: [0, -1],
};
const heldKeys = new Set();
let padCommand = null; // (speed, turn rate) as fractions of the limits, while the pad is held

// The time (s) after which the driving ends.
function maxDuration(scenario) {
  return isFree(scenario) ? Math.min(scenario.time_limit ?? MAX_DRIVEN_HORIZON, MAX_DRIVEN_HORIZON) : scenario.horizon;
}

function startDriving() {
  if (!canEdit() || drag !== null) return;
  if (!(maxDuration(play.scenario) > 0 && maxDuration(play.scenario) <= MAX_DRIVEN_HORIZON)) {
    play.notice = `driving: expected a horizon of at most ${MAX_DRIVEN_HORIZON} s`;
    show();
    return;
  }
  heldKeys.clear();
  padCommand = null;
  play.time = null;
  play.episode = null;
  play.notice = null;
  byId("policy").value = "";
  const pose = poseOf("start");
  play.driving = { scenario: play.scenario, pose, states: [pose], actions: [], action: [0, 0], time: 0, hasBegun: false };
  show();
  byId("drive-box").focus({ preventScroll: true });
  let last = null;
  const frame = (now) => {
    const driving = play.driving;
    if (!driving) return;
    const elapsed = last === null ? 0 : Math.min((now - last) / 1000, MAX_CATCH_UP);
    last = now;
    driving.hasBegun = driving.hasBegun || heldKeys.size > 0 || padCommand !== null;
    if (driving.hasBegun) advance(driving, elapsed);
    showDriving();
    draw();
    if (play.driving === driving) requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

// The command of the keys, approached gradually, or that of the pad.
function nextAction([speed, turn]) {
  if (padCommand) return padCommand;
  const target = [0, 0];
  for (const key of heldKeys) DRIVE_KEYS[key].forEach((value, i) => (target[i] += value));
  const approach = (value, goal, change) => value + Math.min(Math.max(goal - value, -change), change);
  const limited = target.map((value) => Math.min(Math.max(value, -1), 1));
  return [approach(speed, limited[0], SPEED_SMOOTHING), approach(turn, limited[1], TURN_SMOOTHING)];
}

// The pose after an arc of constant speed and turn rate.
function arcEnd([x, y, heading], distance, turn) {
  // sin(turn/2) / (turn/2), continuous at zero
  const half = turn / 2, chord = distance * (Math.abs(half) < 1e-6 ? 1 - (half * half) / 6 : Math.sin(half) / half);
  return [x + chord * Math.cos(heading + half), y + chord * Math.sin(heading + half), heading + turn];
}

function advance(driving, elapsed) {
  const { scenario } = driving, { max_speed: maxSpeed, max_turn_rate: maxTurnRate } = scenario.robot;
  const limit = maxDuration(scenario), maxCount = Math.ceil(limit / CONTROL_PERIOD - 1e-9);
  driving.time += elapsed;
  while (driving.actions.length < maxCount && driving.time >= (driving.actions.length + 1) * CONTROL_PERIOD) {
    const action = nextAction(driving.action).map((value) => Math.round(value * 1000) / 1000);
    const period = Math.min(CONTROL_PERIOD, limit - driving.actions.length * CONTROL_PERIOD);
    driving.action = action;
    driving.actions.push(action);
    driving.pose = arcEnd(driving.pose, action[0] * maxSpeed * period, action[1] * maxTurnRate * period);
    driving.states.push(driving.pose);
    if (isInContact(scenario, driving.pose) || (isFree(scenario) && isAtGoal(scenario, driving.pose))) {
      finishDriving();
      return;
    }
  }
  // The last period may be shorter than the others.
  if (driving.actions.length === maxCount || driving.time >= limit + CONTROL_PERIOD) finishDriving();
}

// Whether the robot is at the goal pose, within the tolerances; the server decides, too.
function isAtGoal({ goal }, [x, y, heading]) {
  const turn = hasHeading(goal) ? heading - goal[2] : 0;
  return Math.hypot(x - goal[0], y - goal[1]) <= POSITION_TOLERANCE && Math.abs(wrapped(turn)) <= HEADING_TOLERANCE;
}

// Whether the robot is in contact with an obstacle or a wall. The server decides; this only ends the driving.
function isInContact(scenario, pose) {
  const [x0, y0, x1, y1] = scenario.arena;
  return placedDiscs(scenario.robot, pose).some(({ center: [x, y], radius }) =>
    Math.min(x - x0, x1 - x, y - y0, y1 - y) <= radius ||
    (scenario.obstacles || []).some((obstacle) => isInside(obstacle, [x, y], radius)));
}

async function finishDriving() {
  const driving = play.driving;
  if (!driving) return;
  play.driving = null;
  heldKeys.clear();
  padCommand = null;
  show();
  canvas.focus({ preventScroll: true });
  if (driving.actions.length) await loadEpisode("/replay", { actions: driving.actions }, () => !play.driving);
}

function showDriving() {
  const driving = play.driving;
  if (!driving) return;
  const { scenario, time, hasBegun } = driving, left = Math.max(maxDuration(scenario) - time, 0).toFixed(1);
  const shown = isFree(scenario) ? `Time: ${time.toFixed(1)} s` : hasBegun ? `Time left: ${left} s` : `${left} s`;
  setText("drive-time", hasBegun ? shown : `${shown}; the time starts with the first input`);
}

// The outcome of an episode of a person or a policy, in one line.
function describeEpisode(episode) {
  const cost = `J = ${episode.cost.toFixed(4)}`, who = episode.policy === "you" ? "You" : episode.policy;
  if (episode.stopped && !episode.collision) return `${who}: stopped after ${episode.time.toFixed(2)} s`;
  if (episode.collision) return `${who}: collided after ${episode.time.toFixed(2)} s, ${cost}`;
  if (!episode.success) {
    const [x, y] = episode.states[episode.states.length - 1], goal = play.scenario.goal;
    const distance = Math.hypot(x - goal[0], y - goal[1]);
    const miss = distance > 0.1 ? `missed the goal by ${distance.toFixed(2)} m` : "missed the heading of the goal";
    return `${who}: ${miss}, ${cost}`;
  }
  if (episode.regret === null) return `${who}: reached the goal, ${cost}; no optimum is certified for the pose reached`;
  const percent = 100 * episode.regret, rounded = percent.toFixed(2).replace(/^-(0\.00)$/, "$1");
  const reason = percent <= -0.005 ? " (negative: the search did not find an optimum as good as this path)" : "";
  return `${who}: reached the goal, ${cost}, regret ${rounded}\u00a0%${reason}`;
}

// ---- Input

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (!play.driving) {
    const isField = event.target.matches("input:not([type=checkbox]), select, textarea");
    if (key === "d" && !isField && !event.repeat) {
      startDriving();
      event.preventDefault();
    }
    return;
  }
  if (key === "Escape") finishDriving();
  else if (key in DRIVE_KEYS) {
    if (!event.repeat) heldKeys.add(key); // the key that started the driving may still be held
  } else return;
  event.preventDefault();
});

document.addEventListener("keyup", (event) => {
  heldKeys.delete(event.key.length === 1 ? event.key.toLowerCase() : event.key);
});
window.addEventListener("blur", () => heldKeys.clear());

const pad = byId("pad");

function readPad(event) {
  const box = pad.getBoundingClientRect();
  const fraction = (value) => Math.min(Math.max(2 * value - 1, -1), 1);
  const [x, y] = [fraction((event.clientX - box.left) / box.width), fraction((event.clientY - box.top) / box.height)];
  padCommand = [-y, -x];
  byId("thumb").style.transform = `translate(${(x * box.width) / 2}px, ${(y * box.height) / 2}px)`;
}

pad.addEventListener("pointerdown", (event) => {
  pad.setPointerCapture(event.pointerId);
  readPad(event);
  event.preventDefault();
});
pad.addEventListener("pointermove", (event) => {
  if (padCommand) readPad(event);
});
for (const name of ["pointerup", "pointercancel"]) {
  pad.addEventListener(name, () => {
    if (play.driving && padCommand) play.driving.action = padCommand; // the keys slow down from here
    padCommand = null;
    byId("thumb").style.transform = "";
  });
}

byId("drive").addEventListener("click", startDriving);
byId("stop-driving").addEventListener("click", finishDriving);
byId("show-optimum").addEventListener("change", () => show());
