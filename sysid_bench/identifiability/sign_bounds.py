"""Which values of base parameters no physical robot has.

A body can exist iff its pseudo-inertia J is positive semidefinite. A sum of parameters is tr(Q J)
over the bodies; it can never be negative if every Q is positive semidefinite and what is left are
parameters that are not negative themselves. Such a sum with a negative value is an impossible row.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array, Body

SIGNED: Final = (".fv", ".fc", ".Ia", ".k")
"""Joint terms that take energy or store it: negative ones would give it away."""

MASS_BOUND: Final = 50.0
"""kg; without any bound, masses that nothing tells would run away."""


def lower_bound(terms: Mapping[str, float], bodies: Sequence[Body]) -> float:
    """0 where the sum cannot be negative, whatever the robot weighs; -inf where it can."""
    rest = dict(terms)
    for body in bodies:
        Q = np.array([rest.pop(column, 0.0) for column in body.columns])
        if Q.any() and np.linalg.eigvalsh(_dual(Q))[0] < -1e-9 * np.abs(Q).max():
            return -np.inf
    fine = all(_signed(name) and value >= 0 for name, value in rest.items())
    return 0.0 if fine else -np.inf


def infeasible_signs(
    terms: Mapping[str, float], value: float, bodies: Sequence[Body]
) -> str | None:
    """Why a printed value cannot come from a physical robot; None where it can, by itself."""
    if value < 0 and lower_bound(terms, bodies) == 0.0:
        return "cannot be negative"
    opposite = {name: -coefficient for name, coefficient in terms.items()}
    if value > 0 and lower_bound(opposite, bodies) == 0.0:
        return "cannot be positive"
    return None


def smallest_feasible_change(
    K: Array, values: Array, parameters: Sequence[str], bodies: Sequence[Body]
) -> float:
    """The smallest number by which all values (r,) of K theta may have to be changed, at most, so
    that a physical robot has them; masses up to HEAVIEST. 0: they are possible as they are."""
    import clarabel
    from scipy import sparse

    r, p = K.shape
    places = {name: i for i, name in enumerate(parameters)}
    q = np.zeros(p + 1)
    q[p] = 1.0
    one = np.ones((r, 1))
    above = np.hstack([K, -one])
    below = np.hstack([-K, -one])
    blocks, right, cones = [np.vstack([above, below])], [np.append(values, -values)], []
    signed = [i for name, i in places.items() if _not_negative(name, bodies)]
    masses = [places[body.columns[0]] for body in bodies if body.columns[0] in places]
    rows = np.zeros((len(signed) + len(masses), p + 1))
    rows[np.arange(len(signed)), signed] = -1.0
    rows[len(signed) + np.arange(len(masses)), masses] = 1.0
    blocks.append(rows)
    right.append(np.append(np.zeros(len(signed)), np.full(len(masses), MASS_BOUND)))
    cones.append(clarabel.NonnegativeConeT(2 * r + len(rows)))
    for body in bodies:
        blocks.append(-_semidefinite_rows(body, places, p + 1))
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
            f"Whether the values are possible was not decided: {solution.status}."
        )
    return max(float(solution.x[p]), 0.0)


def _not_negative(name: str, bodies: Sequence[Body]) -> bool:
    inertial = {column for body in bodies for column in body.columns}
    return name not in inertial and _signed(name)


def _signed(name: str) -> bool:
    """Whether a joint term cannot be negative; friction between joints can, one by one."""
    return name.endswith(SIGNED) and ".fv." not in name


def _dual(coefficients: Array) -> Array:
    """Q (4, 4) with coefficients . phi = tr(Q J(phi)) for all phi (10,)."""
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = coefficients
    return np.array(
        [
            [yy + zz, -xy / 2, -xz / 2, hx / 2],
            [-xy / 2, xx + zz, -yz / 2, hy / 2],
            [-xz / 2, -yz / 2, xx + yy, hz / 2],
            [hx / 2, hy / 2, hz / 2, m],
        ]
    )


def _semidefinite_rows(body: Body, places: Mapping[str, int], width: int) -> Array:
    """(10, width): the upper triangle of J, column after column, off-diagonals times sqrt(2), of
    the unknowns; a parameter that is none is zero."""
    basis = pseudo_inertia(np.eye(10))
    rows = np.zeros((10, width))
    for k, column in enumerate(body.columns):
        if column in places:
            J = basis[k]
            rows[:, places[column]] = [
                J[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)
            ]
    return rows
