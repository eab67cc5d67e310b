"""Neighbouring-extremal gains: feedback from a linear approximation of the costate."""

from __future__ import annotations

from typing import Any

import numpy as np

# Interval (s) around the last closest point in which the next one is searched; a path may return to the same pose.
SEARCHED_BEFORE, SEARCHED_AFTER = 0.5, 1.0


class Gains:
    """Feedback law: the minimising control for the costate lambda = lambda*(t) + P(t) (q - q*(t)).

    P is the derivative of the costate with respect to the state along an extremal, from a backward sweep of the
    transition matrices (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, ch. 6). It grows without bound
    towards a fixed final state, so it is held constant shortly before the horizon.

    Args:
        times (K,): s, evenly spaced.
        extremal (K, 2n): states and costates.
        slopes (K, n, n): P.
        control: control law, see `ProblemArrays`.
        data: constants of the control law, see `ProblemArrays`.
        n_controls: number m of controls.

    """

    def __init__(
        self,
        times: np.ndarray,
        extremal: np.ndarray,
        slopes: np.ndarray,
        control: Any,
        data: Any,
        n_controls: int,
    ) -> None:
        self.times, self.extremal, self.slopes = times, extremal, slopes
        self._n_controls = n_controls
        self._control, self._data = control, data

    def control(self, state: np.ndarray, time: float, ahead: float = 0.0) -> np.ndarray:
        """Return the controls (m,) for a state (n,).

        Args:
            state: the robot's state.
            time: s since the start of the episode.
            ahead: s by which the control lies ahead of `time`; the deviation from the extremal is kept.

        """
        k, fraction = self._locate(time)
        z = (1 - fraction) * self.extremal[k] + fraction * self.extremal[k + 1]
        n = self.slopes.shape[1]
        deviation = np.asarray(state, dtype=float) - z[:n]
        k, fraction = self._locate(time + ahead)
        z = (1 - fraction) * self.extremal[k] + fraction * self.extremal[k + 1]
        slope = (1 - fraction) * self.slopes[k] + fraction * self.slopes[k + 1]
        z[:n] += deviation
        z[n:] += slope @ deviation
        control = np.empty(self._n_controls)
        self._control(z, self._data, control)
        return control

    def closest(self, state: np.ndarray, time: float) -> float:
        """Return the time (s) of the point of the extremal that is closest to a state (n,), close to a given time.

        With a free horizon, the control depends on the state alone, and the extremal is followed by this time.
        """
        near = (self.times >= time - SEARCHED_BEFORE) & (self.times <= time + SEARCHED_AFTER)
        n = self.slopes.shape[1]
        distances = np.linalg.norm(self.extremal[near, :n] - np.asarray(state, dtype=float), axis=1)
        return float(self.times[near][distances.argmin()])

    def _locate(self, time: float) -> tuple[int, float]:
        """Index of the interval that contains a time, and the fraction of the interval before that time."""
        step = self.times[1] - self.times[0]
        position = min(max((time - self.times[0]) / step, 0.0), len(self.times) - 1.0)
        k = min(int(position), len(self.times) - 2)
        return k, position - k
