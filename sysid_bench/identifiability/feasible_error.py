"""Sign constraints on base parameters that follow from physical feasibility.

A body is feasible iff its pseudo-inertia J (4, 4) is positive semidefinite (Wensing, Kim and
Slotine 2018). A linear combination of inertial parameters is sum_b tr(Q_b J_b); it is never
negative if every Q_b is positive semidefinite and the remaining joint terms cannot be negative. A
negative value of such a combination is infeasible.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import clarabel
import numpy as np
import scipy

from sysid_bench.errors import EstimationError
from sysid_bench.spatial import pseudo_inertia
from sysid_bench.types import Array, Body

SIGNED: Final = (".fv", ".fc", ".Ia", ".k")
"""Joint terms that dissipate or store energy, which therefore cannot be negative."""

MASS_BOUND: Final = 50.0
"""kg, of any body; without a bound, masses that are not identifiable would be unbounded."""


def bound_of(terms: Mapping[str, float], bodies: Sequence[Body]) -> float:
    """Return a lower bound of a linear combination {parameter: coefficient} over feasible robots: 0
    if it cannot be negative, else -inf."""
    rest = dict(terms)
    inertial = [np.array([rest.pop(c, 0.0) for c in body.columns]) for body in bodies]
    nonnegative = all(_signed(name) and value >= 0 for name, value in rest.items())
    return 0.0 if nonnegative and all(map(_semidefinite, inertial)) else -np.inf


def _semidefinite(coefficients: Array) -> bool:
    """True if coefficients . phi (10,) cannot be negative for a feasible body, up to rounding."""
    # coefficients . phi = tr(Q J(phi)), and the cone of semidefinite matrices is self-dual:
    # tr(Q J) >= 0 for all J >= 0 iff Q >= 0.
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = coefficients
    Q = [
        [yy + zz, -xy / 2, -xz / 2, hx / 2],
        [-xy / 2, xx + zz, -yz / 2, hy / 2],
        [-xz / 2, -yz / 2, xx + yy, hz / 2],
        [hx / 2, hy / 2, hz / 2, m],
    ]
    smallest = np.linalg.eigvalsh(np.array(Q))[0]
    return bool(smallest >= -1e-9 * np.abs(coefficients).max())


def check_bound(terms: Mapping[str, float], value: float, bodies: Sequence[Body]) -> str | None:
    """Return the reason if the value of a linear combination is infeasible by itself, else None."""
    if not abs(value) > 0:
        return None
    sign, text = (1.0, "negative") if value < 0 else (-1.0, "positive")
    turned = {name: sign * coefficient for name, coefficient in terms.items()}
    return f"cannot be {text}" if bound_of(turned, bodies) == 0.0 else None


def feasible_error(
    K: Array, values: Array, parameters: Sequence[str], bodies: Sequence[Body]
) -> float:
    """Return the smallest t such that a feasible theta has |K theta - values| <= t (r,).

    The semidefinite program minimises t over theta with J_b >= 0, joint terms >= 0 and masses up to
    MASS_BOUND. Zero: the values are feasible together. Raises EstimationError if the solver fails.
    """
    p = K.shape[1]
    index = {name: i for i, name in enumerate(parameters)}
    one = np.ones((len(K), 1))
    # A theta <= b: joint terms are not negative, masses are bounded.
    inertial = {column for body in bodies for column in body.columns}
    signed = [i for name, i in index.items() if name not in inertial and _signed(name)]
    masses = [index[body.columns[0]] for body in bodies if body.columns[0] in index]
    A = np.vstack([-np.eye(p)[signed], np.eye(p)[masses]])
    b = np.append(np.zeros(len(signed)), np.full(len(masses), MASS_BOUND))
    bounded = np.hstack([A, np.zeros((len(A), 1))])
    # G [theta; t] <= h: |K theta - values| <= t as two inequalities, then the bounds.
    G = np.vstack([np.hstack([K, -one]), np.hstack([-K, -one]), bounded])
    h = np.concatenate([values, -values, b])
    blocks = [G, *(-_semidefinite_rows(body, index, p + 1) for body in bodies)]
    # Minimise t; the variables of the program are (theta, t).
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix((p + 1, p + 1)),
        np.append(np.zeros(p), 1.0),
        scipy.sparse.csc_matrix(np.vstack(blocks)),
        np.append(h, np.zeros(10 * len(bodies))),
        [clarabel.NonnegativeConeT(len(h)), *[clarabel.PSDTriangleConeT(4)] * len(bodies)],
        settings,
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise EstimationError(
            f"The feasibility of the values was not decided; solver status: {solution.status}."
        )
    return max(float(solution.x[p]), 0.0)


def _signed(name: str) -> bool:
    """True for a joint term that cannot be negative; friction between two joints can be."""
    return name.endswith(SIGNED) and ".fv." not in name


def _semidefinite_rows(body: Body, index: Mapping[str, int], width: int) -> Array:
    """Rows (10, width) that map the unknowns to J in Clarabel's triangle format: the upper triangle
    by columns, off-diagonals times sqrt(2). Parameters that are not unknowns are zero."""
    i, j = np.array([(i, j) for j in range(4) for i in range(j + 1)]).T
    # Off-diagonals count twice in tr(Q J) and once in the triangle: hence sqrt(2) on each side.
    triangles = pseudo_inertia(np.eye(10))[:, i, j] * np.where(i == j, 1.0, np.sqrt(2.0))
    rows = np.zeros((10, width))
    for column, triangle in zip(body.columns, triangles, strict=True):
        if column in index:
            rows[:, index[column]] = triangle
    return rows
