// Drawing of what the page shows: the plane, and the plots below it.

import { byId, durationOf, play, shownTime } from "./state.js";
import {
  alternativeColor, canvas, drawLine, drawPoints, drawPoses, drawRobot, drawScenario, fitView, poseAt, prepareCanvas,
  unit, updateUnit,
} from "./canvas.js";
import { drawPlots, shownPath } from "./plots.js";
import { drawLesson, drawLessonPlots } from "./lessons.js";

function drawSolution(solution) {
  const colors = play.colors, isOutdated = play.error !== null || !solution.success;
  solution.alternatives.forEach((other, i) => {
    const isShown = play.highlighted === i + 1;
    drawLine(other.states, alternativeColor(i), isShown ? 3 : 1.4, isShown ? [] : [5, 4]);
  });
  if (play.sweeps && play.sweeps.length) {
    const sweep = play.sweeps[byId("sweep-slider").value];
    drawLine(sweep.states, colors.sweep, 2);
    drawPoints(sweep.nodes, colors.sweep, 3);
  }
  drawLine(solution.path.states, colors.optimum + (isOutdated ? "77" : ""), play.highlighted === 0 ? 3 : 2);
}

function drawPlane(width, height) {
  const { scenario, solution, episode, driving } = play, colors = play.colors;
  fitView(width, height);
  if (play.lesson && play.lesson.content) {
    drawLesson();
    return;
  }
  drawScenario(scenario, driving ? null : play.selected, shownTime());
  if (solution && solution.path && (!driving || byId("show-optimum").checked)) drawSolution(solution);
  const episodeColor = episode && (episode.success ? colors.policy : colors.failure);
  if (episode) drawLine(episode.states, episodeColor, 2.2);
  drawPoses(scenario, driving ? null : play.selected);
  if (driving) {
    drawLine(driving.states, colors.policy, 2.2);
    drawRobot(driving.states[driving.states.length - 1], colors.policy, false);
  }
  if (shownTime() === 0 || driving) return;
  if (solution && solution.path) {
    drawRobot(poseAt(solution.path.states, shownTime(), durationOf(solution.path)), colors.optimum, false);
  }
  if (episode) {
    const duration = episode.period * (episode.states.length - 1);
    drawRobot(poseAt(episode.states, shownTime(), Math.min(duration, scenario.horizon ?? duration)), episodeColor, false);
  }
}

const PLOT_INTERVAL = 100; // ms between two drawings of the plots during a drag, which leaves more time for the plane
let plotted = []; // what the plots show
let plotTime = 0; // ms, of their last drawing

export function draw() {
  const [width, height] = prepareCanvas(canvas);
  if (!play.scenario || !play.colors) return;
  drawPlane(width, height);
  const { lesson, driving, searched, highlighted } = play, time = shownTime(), plots = byId("plots");
  const shown = [shownPath(), lesson && lesson.content, lesson && lesson.step, driving !== null, time, searched,
    highlighted, byId("show-optimum").checked, unit, plots.clientWidth, plots.clientHeight, window.devicePixelRatio];
  if (shown.length === plotted.length && shown.every((value, i) => value === plotted[i])) return;
  if (play.drag !== null && performance.now() - plotTime < PLOT_INTERVAL) return;
  plotted = shown;
  plotTime = performance.now();
  (lesson && lesson.content ? drawLessonPlots : drawPlots)(...prepareCanvas(plots));
}

export function resize() {
  updateUnit();
  draw();
}
