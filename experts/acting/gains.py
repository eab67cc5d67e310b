"""Neighbouring-extremal gains: feedback from a linear approximation of the costate."""

from __future__ import annotations

from typing import Any

import numpy as np


class Gains:
    """Feedback law: the minimising control for the costate lambda = lambda*(t) + P(t) (q - q*(t)).

    P is the derivative of the costate with respect to the state along an extremal, from a backward sweep of the
    transition matrices (A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, ch. 6). It grows without bound
    towards a fixed final state, so it is held constant shortly before the horizon.

    Args:
        times (K,): s, evenly spaced.
        extremal (K, 6): states and costates.
        slopes (K, 3, 3): P.
        control: control law, see `ProblemArrays`.
        data: constants of the control law, see `ProblemArrays`.

    """

    def __init__(self, times: np.ndarray, extremal: np.ndarray, slopes: np.ndarray, control: Any, data: Any) -> None:
        self.times, self.extremal, self.slopes = times, extremal, slopes
        self._control, self._data = control, data

    def control(self, state: np.ndarray, time: float, ahead: float = 0.0) -> np.ndarray:
        """Return speed (m/s) and turn rate (rad/s) for a state (3,).

        Args:
            state: x, y (m), heading (rad).
            time: s since the start of the episode.
            ahead: s by which the control lies ahead of `time`; the deviation from the extremal is kept.

        """
        k, fraction = self._locate(time)
        z = (1 - fraction) * self.extremal[k] + fraction * self.extremal[k + 1]
        deviation = np.asarray(state, dtype=float) - z[:3]
        k, fraction = self._locate(time + ahead)
        z = (1 - fraction) * self.extremal[k] + fraction * self.extremal[k + 1]
        slope = (1 - fraction) * self.slopes[k] + fraction * self.slopes[k + 1]
        z[:3] += deviation
        z[3:] += slope @ deviation
        control = np.empty(2)
        self._control(z, self._data, control)
        return control

    def _locate(self, time: float) -> tuple[int, float]:
        """Index of the interval that contains a time, and the fraction of the interval before that time."""
        step = self.times[1] - self.times[0]
        position = min(max((time - self.times[0]) / step, 0.0), len(self.times) - 1.0)
        k = min(int(position), len(self.times) - 2)
        return k, position - k
