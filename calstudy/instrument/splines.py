"""Bicubic splines on grids of directions, with many values in each direction."""

from __future__ import annotations

import numba
import numpy as np


def bspline_coefficients(count: int) -> np.ndarray:
    """Return the matrix from equally spaced samples to the coefficients of their cubic spline, (count + 2, count).

    The spline has no knots at the second and the last but one sample, and is in the basis of uniform cubic B-splines;
    coefficient i belongs to the B-spline centred on sample i - 1.
    """
    conditions = np.zeros((count + 2, count + 2))
    for sample in range(count):
        conditions[sample, sample : sample + 3] = 1 / 6, 4 / 6, 1 / 6
    # No jump of the third derivative at a sample: the fourth difference of the coefficients around it vanishes.
    conditions[count, :5] = conditions[count + 1, -5:] = 1, -4, 6, -4, 1
    return np.linalg.solve(conditions, np.eye(count + 2)[:, :count])


def cells(values: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first B-spline, (N,) int, and four weights, (N, 4), of each value, clamped to an equally spaced grid.

    B-splines are numbered as in `bspline_coefficients`.
    """
    position = np.clip((values - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    cell = np.minimum(position.astype(np.intp), len(grid) - 2)
    x = position - cell
    weights = np.empty((len(values), 4))
    weights[:, 0] = (1 - x) ** 3 / 6
    weights[:, 1] = (4 - 6 * x**2 + 3 * x**3) / 6
    weights[:, 2] = (1 + 3 * x + 3 * x**2 - 3 * x**3) / 6
    weights[:, 3] = x**3 / 6
    return cell, weights


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _add_row(total: np.ndarray, taps: np.ndarray, weights: np.ndarray, factor: float) -> None:
    first, second, third, fourth = taps[0], taps[1], taps[2], taps[3]
    a, b, c, d = factor * weights[0], factor * weights[1], factor * weights[2], factor * weights[3]
    for i in range(total.size):
        total[i] += a * first[i] + b * second[i] + c * third[i] + d * fourth[i]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def spline_fields(
    table: np.ndarray,
    rows: np.ndarray,
    row_weights: np.ndarray,
    columns: np.ndarray,
    column_weights: np.ndarray,
    fields: np.ndarray,
) -> None:
    """Fill `fields` (Ndirections, Nvalues) from a table (Nrows + 2, Ncolumns + 2, Nvalues) of coefficients.

    `rows`, `columns` and their weights are from `cells`.
    """
    for source in range(len(fields)):
        field = fields[source]
        field[:] = 0.0
        for tap in range(4):
            taps = table[rows[source] + tap, columns[source] : columns[source] + 4]
            _add_row(field, taps, column_weights[source], row_weights[source, tap])
