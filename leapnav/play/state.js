// State of the page, requests to the server, and the history of changes.

const SEARCH_DELAY = 250; // ms from the last change to the start of the full search
const MAX_HISTORY = 200; // changes that can be undone
const MAX_LATENCIES = 500;

export const byId = (id) => document.getElementById(id);
export const setText = (id, value) => {
  if (byId(id).textContent !== value) byId(id).textContent = value;
};
export const format = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

// What the page shows. It is a property of `window` so that tests and the console can read it.
export const play = (window.play = {
  scenario: null, // as in a scenario file; replaced, never changed in place
  solution: null, // latest response of /follow or /search
  previousId: null, // id of the latest certified solution, the initial guess of the next one
  highlighted: 0, // row of the table of local optima
  sweeps: null,
  episode: null, // response of /drive or /replay
  selected: null, // "start", "goal" or the index of an obstacle
  time: null, // s, during an animation
  clock: 0, // s, of the slider: where moving obstacles are drawn and edited
  pending: 0, // number of open requests
  searched: false, // whether the solution is that of the full search
  error: null,
  notice: null, // a line that is shown until the next change
  colors: null, // by name, from the server
  robots: {}, // by model, from the server: defaults, names of states and controls, weights of the cost
  lesson: null, // the open lesson, see lessons.js
  driving: null, // the person's episode in progress, see driving.js
  undo: [], // earlier scenarios
  redo: [],
  drag: null, // what the pointer drags, see editing.js
  moveTime: null, // time (ms) of the first pointer move that is in no request yet
  latencies: [], // ms from a pointer move to the drawing of the followed optimum
});
let following = false, searching = false, changed = false, searchTimer = null, revision = 0;

export const isFree = (scenario) => scenario.horizon === null;
export const durationOf = (path) => path.times[path.times.length - 1]; // s

export const robotOf = (scenario) => play.robots[modelOf(scenario)];

export const modelOf = (scenario) => (scenario.robot || {}).model || "unicycle";

// The step of the open lesson, the scenario of that step, and the scenario that is drawn.
export const lessonStep = () => play.lesson.content.steps[play.lesson.step];
export const lessonScenario = () => lessonStep().scenario || play.lesson.content.scenario;
export const shownScenario = () => (play.lesson && play.lesson.content ? lessonScenario() : play.scenario);

// The time (s) that is drawn: of the animation, of the person's episode, or of the slider.
export function shownTime() {
  const { driving, time, clock } = play;
  if (driving) return driving.id ? driving.period * (driving.states.length - 1) : 0;
  return time === null ? clock : time;
}

export const canEdit = () => play.scenario !== null && !play.lesson && !play.driving;

// Displays the state; page.js says how.
let display = () => {};
export const show = () => display();
export function setDisplay(update) {
  display = update;
}

// ---- Requests

export async function request(path, content) {
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

export function scheduleSearch() {
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
  play.notice = null;
  scheduleSearch();
  follow();
  show();
}

async function follow() {
  if (following) return;
  following = true;
  while (changed) {
    changed = false;
    const movedAt = play.moveTime;
    play.moveTime = null;
    try {
      const solution = await request("/follow", { scenario: play.scenario, previous: play.previousId });
      if (!play.searched) setSolution(solution);
      if (movedAt !== null) {
        play.latencies.push(performance.now() - movedAt);
        if (play.latencies.length > MAX_LATENCIES) play.latencies.shift();
      }
    } catch (error) {
      showError(error);
    }
  }
  following = false;
}

async function search() {
  // One search at a time: the server handles requests in order, and outdated ones would delay the next.
  if (play.drag !== null || searching) return;
  const searchedRevision = revision;
  searching = true;
  try {
    const solution = await request("/search", { scenario: play.scenario });
    if (searchedRevision === revision) {
      play.searched = true;
      setSolution(solution);
      if (byId("policy").value && !play.driving) await drivePolicy();
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

export function showError(error) {
  play.error = error.message;
  show();
}

export async function loadSweeps() {
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

// Requests an episode of the selected policy, or the replay of a person's actions.
export async function loadEpisode(path, content, isCurrent) {
  const drivenRevision = revision;
  play.episode = null;
  show();
  try {
    const episode = await request(path, { scenario: play.scenario, ...content });
    if (drivenRevision === revision && isCurrent()) play.episode = episode;
  } catch (error) {
    if (drivenRevision === revision) showError(error);
  }
  show();
}

export async function drivePolicy() {
  const policy = byId("policy").value;
  if (policy) await loadEpisode("/drive", { policy }, () => byId("policy").value === policy);
  else {
    play.episode = null;
    show();
  }
}

// ---- Changes of the scenario

let lastGroup = null;

// Changes fields of the scenario. Successive changes with the same group, such as those of a drag, are undone together.
export function edit(fields, group = null) {
  changeScenario({ ...play.scenario, ...fields }, group);
}

export function changeScenario(scenario, group = null) {
  if (group === null || group !== lastGroup) remember();
  lastGroup = group;
  play.scenario = scenario;
  scenarioChanged();
}

function remember() {
  play.undo.push(play.scenario);
  if (play.undo.length > MAX_HISTORY) play.undo.shift();
  play.redo = [];
  forgetLink();
}

export function setScenario(scenario) {
  if (play.scenario !== null) remember();
  lastGroup = null;
  replaceScenario(scenario);
}

function replaceScenario(scenario) {
  play.scenario = scenario;
  play.drag = null;
  play.driving = null;
  play.selected = null;
  play.previousId = null;
  play.solution = null;
  play.time = null;
  play.clock = 0;
  scenarioChanged();
}

function moveInHistory(from, to) {
  if (!from.length || play.drag !== null || play.driving || play.lesson) return;
  to.push(play.scenario);
  lastGroup = null;
  play.scenario = from.pop();
  const count = (play.scenario.obstacles || []).length;
  if (typeof play.selected === "number" && play.selected >= count) play.selected = null;
  forgetLink();
  scenarioChanged();
}

export const undo = () => moveInHistory(play.undo, play.redo);
export const redo = () => moveInHistory(play.redo, play.undo);

// The fragment contains the scenario only until it is changed.
function forgetLink() {
  if (location.hash) history.replaceState(null, "", location.pathname);
}

export function closeLesson() {
  if (!play.lesson) return;
  play.lesson = null;
  show();
}
