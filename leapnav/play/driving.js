// A person drives the robot: keys or a touch pad, in real time. The server steps the environment and, at the end, compares
// the cost with the optimum.

import { byId, canEdit, isFree, loadEpisode, play, request, setText, show, showError } from "./state.js";
import { canvas } from "./canvas.js";
import { draw } from "./drawing.js";

const MAX_CATCH_UP = 0.25; // s; a longer pause of the page does not count as driving time
const SPEED_SMOOTHING = 0.2, TURN_SMOOTHING = 0.3; // largest change of a command per control period, by key
const DRIVE_KEYS = {
  ArrowUp: [1, 0], w: [1, 0], ArrowDown: [-1, 0], s: [-1, 0], ArrowLeft: [0, 1], a: [0, 1], ArrowRight: [0, -1], d: [0, -1],
};
const heldKeys = new Set();
let padCommand = null; // ahead and to the left, from -1 to 1, while the pad is held

function startDriving() {
  if (!canEdit() || play.drag !== null) return;
  heldKeys.clear();
  padCommand = null;
  play.time = null;
  play.episode = null;
  play.notice = null;
  byId("policy").value = "";
  // `id`, `states`, `period` and `limit` (s) come from the server. `time`: of the person's input; `commands`: those that
  // are not sent yet; `count`: of those that are.
  const begun = { id: null, states: [play.scenario.start], time: 0, command: [0, 0], commands: [], count: 0 };
  play.driving = { ...begun, isSending: false, hasBegun: false };
  connect(play.driving);
  show();
  byId("drive-box").focus({ preventScroll: true });
  let last = null;
  const frame = (now) => {
    const { driving } = play;
    if (!driving) return;
    const elapsed = last === null ? 0 : Math.min((now - last) / 1000, MAX_CATCH_UP);
    last = now;
    driving.hasBegun = driving.hasBegun || heldKeys.size > 0 || padCommand !== null;
    if (driving.hasBegun && driving.id) advance(driving, elapsed);
    showDriving();
    draw();
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

async function connect(driving) {
  try {
    Object.assign(driving, await request("/driving/start", { scenario: play.scenario }));
  } catch (error) {
    if (play.driving !== driving) return;
    play.driving = null;
    play.notice = `driving: ${error.message}`;
    show();
  }
}

// The command of the keys, approached gradually, or that of the pad.
function nextCommand([ahead, left]) {
  if (padCommand) return padCommand;
  const target = [0, 0];
  for (const key of heldKeys) DRIVE_KEYS[key].forEach((value, i) => (target[i] += value));
  const approach = (value, goal, change) => value + Math.min(Math.max(goal - value, -change), change);
  const limited = target.map((value) => Math.min(Math.max(value, -1), 1));
  return [approach(ahead, limited[0], SPEED_SMOOTHING), approach(left, limited[1], TURN_SMOOTHING)];
}

function advance(driving, elapsed) {
  driving.time += elapsed;
  while (driving.time >= (driving.count + driving.commands.length + 1) * driving.period) {
    driving.command = nextCommand(driving.command).map((value) => Math.round(value * 1000) / 1000);
    driving.commands.push(driving.command);
  }
  if (driving.commands.length && !driving.isSending) send(driving);
}

// The server executes the commands and responds with the poses that follow.
async function send(driving) {
  const commands = driving.commands.splice(0, driving.max_commands);
  driving.count += commands.length;
  driving.isSending = true;
  try {
    const { states, done } = await request("/driving/step", { id: driving.id, commands });
    driving.states.push(...states);
    driving.isSending = false;
    if (done && play.driving === driving) finishDriving();
  } catch (error) {
    if (play.driving !== driving) return;
    play.driving = null;
    showError(error);
  }
}

async function finishDriving() {
  const { driving } = play;
  if (!driving) return;
  play.driving = null;
  heldKeys.clear();
  padCommand = null;
  show();
  canvas.focus({ preventScroll: true });
  if (driving.count) await loadEpisode("/driving/finish", { id: driving.id }, () => !play.driving);
}

function showDriving() {
  const { driving } = play;
  if (!driving || !driving.id) return;
  const { time, hasBegun, limit } = driving, left = Math.max(limit - time, 0).toFixed(1);
  const shown = isFree(play.scenario) ? `Time: ${time.toFixed(1)} s` : hasBegun ? `Time left: ${left} s` : `${left} s`;
  setText("drive-time", hasBegun ? shown : `${shown}; the time starts with the first input`);
}

// The outcome of an episode of a person or a policy, in one line.
export function describeEpisode(episode) {
  const cost = `J = ${episode.cost.toFixed(4)}`, who = episode.policy === "you" ? "You" : episode.policy;
  if (episode.stopped && !episode.collision) return `${who}: stopped after ${episode.time.toFixed(2)} s`;
  if (episode.collision) return `${who}: collided after ${episode.time.toFixed(2)} s, ${cost}`;
  if (!episode.success) return `${who}: missed ${episode.missed}, ${cost}`;
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
    if (play.driving && padCommand) play.driving.command = padCommand; // the keys slow down from here
    padCommand = null;
    byId("thumb").style.transform = "";
  });
}

byId("drive").addEventListener("click", startDriving);
byId("stop-driving").addEventListener("click", finishDriving);
byId("show-optimum").addEventListener("change", () => show());
