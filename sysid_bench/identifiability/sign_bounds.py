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
from scipy import sparse

from sysid_bench.errors import EstimationError
from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array, Body

SIGNED: Final = (".fv", ".fc", ".Ia", ".k")
"""Joint terms that dissipate or store energy, which therefore cannot be negative."""

MASS_BOUND: Final = 50.0
"""kg, of any body; without a bound, masses that are not identifiable would be unbounded."""


def lower_bound(terms: Mapping[str, float], bodies: Sequence[Body]) -> float:
    """Return a lower bound of a linear combination {parameter: coefficient} over feasible robots: 0
    if it cannot be negative, else -inf."""
    rest = dict(terms)
    for body in bodies:
        Q = np.array([rest.pop(column, 0.0) for column in body.columns])
        if Q.any() and np.linalg.eigvalsh(_dual(Q))[0] < -1e-9 * np.abs(Q).max():
            return -np.inf
    nonnegative = all(_signed(name) and value >= 0 for name, value in rest.items())
    return 0.0 if nonnegative else -np.inf


def infeasible_signs(
    terms: Mapping[str, float], value: float, bodies: Sequence[Body]
) -> str | None:
    """Return the reason if the value of a linear combination is infeasible by itself, else None."""
    if value < 0 and lower_bound(terms, bodies) == 0.0:
        return "cannot be negative"
    opposite = {name: -coefficient for name, coefficient in terms.items()}
    if value > 0 and lower_bound(opposite, bodies) == 0.0:
        return "cannot be positive"
    return None


def smallest_feasible_change(
    K: Array, values: Array, parameters: Sequence[str], bodies: Sequence[Body]
) -> float:
    """Return the smallest t such that a feasible theta has |K theta - values| <= t (r,).

    The semidefinite program minimises t over theta with J_b >= 0, joint terms >= 0 and masses up to
    MASS_BOUND. Zero: the values are feasible together. Raises EstimationError if the solver fails.
    """
    r, p = K.shape
    index = {name: i for i, name in enumerate(parameters)}
    q = np.zeros(p + 1)
    q[p] = 1.0
    one = np.ones((r, 1))
    above = np.hstack([K, -one])
    below = np.hstack([-K, -one])
    blocks, right, cones = [np.vstack([above, below])], [np.append(values, -values)], []
    signed = [i for name, i in index.items() if _not_negative(name, bodies)]
    masses = [index[body.columns[0]] for body in bodies if body.columns[0] in index]
    rows = np.zeros((len(signed) + len(masses), p + 1))
    rows[np.arange(len(signed)), signed] = -1.0
    rows[len(signed) + np.arange(len(masses)), masses] = 1.0
    blocks.append(rows)
    right.append(np.append(np.zeros(len(signed)), np.full(len(masses), MASS_BOUND)))
    cones.append(clarabel.NonnegativeConeT(2 * r + len(rows)))
    for body in bodies:
        blocks.append(-_semidefinite_rows(body, index, p + 1))
        right.append(np.zeros(10))
        cones.append(clarabel.PSDTriangleConeT(4))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((p + 1, p + 1)), q, sparse.csc_matrix(np.vstack(blocks)),
        np.concatenate(right), cones, settings,
    )  # fmt: skip
    solution = solver.solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise EstimationError(
            f"The feasibility of the values was not decided; solver status: {solution.status}."
        )
    return max(float(solution.x[p]), 0.0)


def _not_negative(name: str, bodies: Sequence[Body]) -> bool:
    inertial = {column for body in bodies for column in body.columns}
    return name not in inertial and _signed(name)


def _signed(name: str) -> bool:
    """True for a joint term that cannot be negative; friction between two joints can be."""
    return name.endswith(SIGNED) and ".fv." not in name


def _dual(coefficients: Array) -> Array:
    """Matrix Q (4, 4) with coefficients . phi = tr(Q J(phi)) for all phi (10,)."""
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = coefficients
    return np.array(
        [
            [yy + zz, -xy / 2, -xz / 2, hx / 2],
            [-xy / 2, xx + zz, -yz / 2, hy / 2],
            [-xz / 2, -yz / 2, xx + yy, hz / 2],
            [hx / 2, hy / 2, hz / 2, m],
        ]
    )


def _semidefinite_rows(body: Body, index: Mapping[str, int], width: int) -> Array:
    """Rows (10, width) that map the unknowns to J in Clarabel's triangle format: the upper triangle
    by columns, off-diagonals times sqrt(2). Parameters that are not unknowns are zero."""
    basis = pseudo_inertia(np.eye(10))
    rows = np.zeros((10, width))
    for k, column in enumerate(body.columns):
        if column in index:
            J = basis[k]
            rows[:, index[column]] = [
                J[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)
            ]
    return rows
