"""Prior knowledge of methods: parameters drawn around the truth, by default never the truth."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import SUFFIX
from sysid_bench.spatial import (
    body_mass_inertia,
    matrix_of_quaternion,
    phi_of,
    quaternion_of_rotation,
)
from sysid_bench.types import Array, Prior
from sysid_bench.words import UNKNOWN

NEARLY_ZERO: Final = 0.01
"""Deviation of a joint term that is zero, as a share of the largest of its kind."""

ALL_ZERO: Final = 1e-3
"""Deviation (SI) where all terms of a kind are zero."""

LENGTH: Final = 0.1
"""m; errors of a given centre of mass are a share of this length."""


UNKNOWN_SPREAD: Final = 1.0
"""Standard deviation of ln(friction) where it is unknown: a factor of 2.7."""

_FRICTION: Final = tuple(SUFFIX[term] for term in ("viscous", "coulomb", "offset"))
_SIGNED: Final = (SUFFIX["offset"],)
"""Terms that may be negative; the others are dissipative, or inertias and springs."""


@dataclass(frozen=True)
class PriorSpread:
    """Standard deviations of the draw: relative for mass, inertia and joint terms, in metres for
    the centre of mass, in rad for the principal axes (None: half the share of the inertia).

    `friction` is that of viscous and Coulomb friction and of offsets (None: as `terms`); "unknown"
    draws them without their own values, about those of all joints. Methods are given the deviations
    times `declared`: 5 for a prior that is declared five times too uncertain.
    """

    mass: float = 0.2
    com: float = 0.015
    inertia: float = 0.3
    terms: float = 0.3
    axes: float | None = None
    friction: float | str | None = None
    declared: float = 1.0

    @property
    def axes_std(self) -> float:
        """Standard deviation (rad) of the rotation of the principal axes about each axis."""
        return 0.5 * self.inertia if self.axes is None else self.axes

    @property
    def friction_share(self) -> float:
        """Relative standard deviation of friction."""
        if isinstance(self.friction, str):
            return UNKNOWN_SPREAD
        return self.terms if self.friction is None else self.friction


def prior_of(task: Task, spread: PriorSpread | None, rng: np.random.Generator) -> Prior:
    """Draw a physically feasible prior around the truth of a task; `spread` None: the truth.

    `std` (p,) are the deviations that methods are given, computed from the drawn values, because
    those of the truth would reveal it. True zeros of joint terms are drawn as well: a CAD model
    does not know that a joint has no friction.
    """
    truth = task.truth
    theta = truth.theta.copy()
    std = np.zeros_like(theta)
    if spread is None:
        return Prior(theta, std)
    inertial = np.zeros(len(theta), dtype=bool)
    index = {name: i for i, name in enumerate(truth.parameters)}
    for body in task.bodies:
        columns = [index[column] for column in body.columns]
        inertial[columns] = True
        theta[columns] = drawn_body(truth.theta[columns], spread, rng)
        std[columns] = prior_std(theta[columns], spread)
    kinds = np.array([name.rpartition(".")[2] for name in truth.parameters])
    for kind in dict.fromkeys(kinds[~inertial]):
        alike = ~inertial & (kinds == kind)
        theta[alike], std[alike] = drawn_terms(truth.theta[alike], kind, spread, rng)
    return Prior(theta, spread.declared * std_with_floor(std, truth.parameters))


def drawn_terms(
    truth: Array, kind: str, spread: PriorSpread, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw the terms (n,) of one kind of all joints, and their deviations."""
    z, signs = rng.normal(size=len(truth)), rng.choice([-1.0, 1.0], size=len(truth))
    share = spread.friction_share if kind in _FRICTION else spread.terms
    centre = truth
    if kind in _FRICTION and spread.friction == UNKNOWN:
        sizes = np.abs(truth[truth != 0.0])
        # The geometric mean: friction of small and large joints differs by orders of magnitude.
        typical = float(np.exp(np.log(sizes).mean())) if len(sizes) else 0.0
        centre = np.full(len(truth), typical) * (signs if kind in _SIGNED else 1.0)
    # Factors exp(s z) keep the sign: a drawn friction coefficient stays dissipative.
    drawn = centre * np.exp(share * z)
    zero = (centre == 0.0) & (share > 0.0)
    size = NEARLY_ZERO * (np.abs(truth).max(initial=0.0) or ALL_ZERO / NEARLY_ZERO)
    drawn[zero] = size * (np.abs(z) * (signs if kind in _SIGNED else 1.0))[zero]
    return drawn, np.where(zero, size, share * np.abs(drawn))


def with_known_errors(task: Task, share: float, rng: np.random.Generator) -> Task:
    """Return the task with errors in its given parameters, of relative standard deviation `share`;
    of centres of mass, the same share of LENGTH."""
    spread = PriorSpread(share, share * LENGTH, share, share)
    links = [drawn_body(phi, spread, rng) for phi in task.known_links]
    terms = {
        term: values * np.exp(share * rng.normal(size=len(values)))
        for term, values in task.known_terms.items()
    }
    return replace(task, known_links=np.array(links).reshape(-1, 10), known_terms=terms)


def std_with_floor(std: Array, names: tuple[str, ...]) -> Array:
    """Raise small deviations: to NEARLY_ZERO of the largest among parameters of the same kind
    (`.m`, `.fv`, ...), or to ALL_ZERO (SI) where the kind has none. A deviation of zero would be
    exact knowledge."""
    floored = std.copy()
    kinds = np.array([name.rpartition(".")[2] for name in names])
    for kind in set(kinds):
        alike = kinds == kind
        floored[alike] = np.maximum(std[alike], NEARLY_ZERO * std[alike].max() or ALL_ZERO)
    return floored


def drawn_body(phi: Array, spread: PriorSpread, rng: np.random.Generator) -> Array:
    """Draw phi (10,) of a feasible body: mass scaled, centre of mass moved, second moment of
    density stretched along the axes of the body frame, then turned about the centre of mass.

    Scaling S to D S D with D > 0 keeps it positive definite, and so does R S R', so that the
    triangle inequalities of the inertia hold for every draw (Wensing et al. 2018).
    """
    # Drawn for massless bodies too, so that the draws of the others do not depend on them.
    z_mass, z_com, z_axes = rng.normal(), rng.normal(size=3), rng.normal(size=3)
    R = matrix_of_quaternion(quaternion_of_rotation(spread.axes_std * rng.normal(size=3)))
    mass, com, inertia = body_mass_inertia(phi)
    if mass <= 0:
        return phi.copy()
    # Log-normal: a mass is positive, whatever the spread.
    factor = np.exp(spread.mass * z_mass)
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia  # second moment about the centre
    stretch = np.diag(np.exp(0.5 * spread.inertia * z_axes))
    covariance = factor * R @ stretch @ covariance @ stretch @ R.T
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return phi_of(factor * mass, com + spread.com * z_com, inertia)


def prior_std(phi: Array, spread: PriorSpread) -> Array:
    """Return the standard deviations (10,) of phi that methods are given, from the drawn phi:
    first moments h = m c by linearisation, moments of inertia by the size of the body."""
    mass, com, inertia = body_mass_inertia(phi)
    size = float(np.trace(inertia)) / 3 + mass * float(com @ com)
    # h = m c: relative deviation of m, absolute one of c.
    h = mass * np.sqrt((spread.mass * com) ** 2 + spread.com**2)
    moments = (
        max(spread.inertia, spread.axes_std) * size + 2 * mass * np.linalg.norm(com) * spread.com
    )
    return np.concatenate([[spread.mass * mass], h, np.full(6, moments)])
