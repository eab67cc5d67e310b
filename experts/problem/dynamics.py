"""The dynamics q' = a(q) + B(q) u along a path, and the controls and costates that follow it."""

from __future__ import annotations

import numpy as np

from leapnav.envs.kernels import kernel
from leapnav.envs.kernels.types import CONSTANT, CUBE, MATRIX, NOTHING
from leapnav.experts.numerics.flow import AFFINE_FUNCTION

RELATIVE_SHIFT = 1e-12  # of the diagonal of B'B, relative to its trace


@kernel(NOTHING(AFFINE_FUNCTION, CONSTANT, MATRIX, MATRIX, CUBE))
def sample_dynamics(affine, data, states, drift, fields):
    """Evaluate a(q) into `drift` (N, n) and B(q) into `fields` (N, n, m) at states (N, n)."""
    for k in range(len(states)):
        affine(states[k], data, drift[k], fields[k])


def least_squares_controls(fields: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the controls u (N, m) for which B u is closest to given rates (N, n), with fields B (N, n, m)."""
    return _solve_gram(fields, np.einsum("kij,ki->kj", fields, rates))


def least_norm_costates(fields: np.ndarray, switching: np.ndarray) -> np.ndarray:
    """Return the costates (N, n) of least norm with given switching functions B'lambda (N, m)."""
    return np.einsum("kij,kj->ki", fields, _solve_gram(fields, switching))


def _solve_gram(fields: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve B'B x = right, where B'B is kept regular if fields are linearly dependent."""
    with np.errstate(all="ignore"):  # the dynamics may be infinite somewhere
        gram = np.einsum("kij,kil->kjl", fields, fields)
        shift = RELATIVE_SHIFT * np.einsum("kjj->k", gram) + np.finfo(float).tiny
        return np.linalg.solve(gram + shift[:, None, None] * np.eye(gram.shape[1]), right[:, :, None])[:, :, 0]
