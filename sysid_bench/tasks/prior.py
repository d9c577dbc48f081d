"""Prior knowledge of methods: parameters drawn around the truth, by default never the truth."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.spatial.inertia import mass_com_inertia, phi_of
from sysid_bench.tasks.task import Task
from sysid_bench.types import Array, Prior

LENGTH: Final = 0.1
"""m; errors of a given centre of mass are a share of this length."""


@dataclass(frozen=True)
class PriorSpread:
    """Standard deviations of the draw: relative for mass, inertia and joint terms, in metres for
    the centre of mass."""

    mass: float = 0.2
    com: float = 0.015
    inertia: float = 0.3
    terms: float = 0.3


def prior_of(task: Task, spread: PriorSpread | None, rng: np.random.Generator) -> Prior:
    """Draw a physically feasible prior around the truth of a task; `spread` None: the truth.

    `std` (p,) are the deviations that methods are given, computed from the drawn values, because
    those of the truth would reveal it.
    """
    truth = task.truth
    theta = truth.theta.copy()
    std = np.zeros_like(theta)
    if spread is None:
        return Prior(theta, std)
    inertial = np.zeros(len(theta), dtype=bool)
    for columns in _columns_by_body(task):
        inertial[columns] = True
        theta[columns] = _drawn_body(truth.theta[columns], spread, rng)
        std[columns] = prior_std(theta[columns], spread)
    # Factors exp(s z) keep the sign: a drawn friction coefficient stays dissipative.
    draws = np.exp(spread.terms * rng.normal(size=(~inertial).sum()))
    theta[~inertial] *= draws
    std[~inertial] = spread.terms * np.abs(theta[~inertial])
    return Prior(theta, std_with_floor(std, truth.parameters))


def _columns_by_body(task: Task) -> list[list[int]]:
    """Indices of the ten parameters of each unknown body."""
    index = {name: i for i, name in enumerate(task.parameters)}
    return [[index[column] for column in body.columns] for body in task.bodies]


def with_known_errors(task: Task, share: float, rng: np.random.Generator) -> Task:
    """Return the task with errors in its given parameters, of relative standard deviation `share`;
    of centres of mass, the same share of LENGTH."""
    spread = PriorSpread(share, share * LENGTH, share, share)
    links = [_drawn_body(phi, spread, rng) for phi in task.known_links]
    terms = {
        term: values * np.exp(share * rng.normal(size=len(values)))
        for term, values in task.known_terms.items()
    }
    return replace(task, known_links=np.array(links).reshape(-1, 10), known_terms=terms)


def std_with_floor(std: Array, names: tuple[str, ...]) -> Array:
    """Raise small deviations: to 1 % of the largest among parameters of the same kind (`.m`, `.fv`,
    ...), or to 1e-3 (SI) where the kind has none. A deviation of zero would be exact knowledge."""
    floored = std.copy()
    kinds = np.array([name.rpartition(".")[2] for name in names])
    for kind in set(kinds):
        alike = kinds == kind
        floored[alike] = np.maximum(std[alike], 0.01 * std[alike].max() or 1e-3)
    return floored


def _drawn_body(phi: Array, spread: PriorSpread, rng: np.random.Generator) -> Array:
    """Draw phi (10,) of a feasible body: mass scaled, centre of mass moved, second moment of
    density stretched along the axes of the body frame.

    Scaling S to D S D with D > 0 keeps it positive definite, so that the triangle inequalities of
    the inertia hold for every draw (Wensing et al. 2018).
    """
    # Drawn for massless bodies too, so that the draws of the others do not depend on them.
    z_mass, z_com, z_axes = rng.normal(), rng.normal(size=3), rng.normal(size=3)
    mass, com, inertia = mass_com_inertia(phi)
    if mass <= 0:
        return phi.copy()
    # Log-normal: a mass is positive, whatever the spread.
    factor = np.exp(spread.mass * z_mass)
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia  # second moment about the centre
    stretch = np.diag(np.exp(0.5 * spread.inertia * z_axes))
    covariance = factor * stretch @ covariance @ stretch
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return phi_of(factor * mass, com + spread.com * z_com, inertia)


def prior_std(phi: Array, spread: PriorSpread) -> Array:
    """Return the standard deviations (10,) of phi that methods are given, from the drawn phi:
    first moments h = m c by linearisation, moments of inertia by the size of the body."""
    mass, com, inertia = mass_com_inertia(phi)
    size = float(np.trace(inertia)) / 3 + mass * float(com @ com)
    # h = m c: relative deviation of m, absolute one of c.
    h = mass * np.sqrt((spread.mass * com) ** 2 + spread.com**2)
    moments = spread.inertia * size + 2 * mass * np.linalg.norm(com) * spread.com
    return np.concatenate([[spread.mass * mass], h, np.full(6, moments)])
