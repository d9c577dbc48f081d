"""What methods are told beforehand: drawn around the truth, never the truth by default."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.spatial.inertia import mass_com_inertia, phi_of
from sysid_bench.tasks.task import Task
from sysid_bench.types import Array, Prior

LENGTH: Final = 0.1
"""m; a known centre of mass is told with an error of a share of this."""


@dataclass(frozen=True)
class PriorSpread:
    """Standard deviations of the draw: relative for mass, inertia and joint terms, metres for the
    centre of mass."""

    mass: float = 0.2
    com: float = 0.015
    inertia: float = 0.3
    terms: float = 0.3


def prior_of(task: Task, spread: PriorSpread | None, rng: np.random.Generator) -> Prior:
    """A physically possible prior around a task's truth; None tells the truth itself."""
    truth = task.truth
    places = {name: i for i, name in enumerate(truth.parameters)}
    theta = truth.theta.copy()
    std = np.zeros_like(theta)
    inertial = np.zeros(len(theta), dtype=bool)
    for body in task.bodies:
        at = [places[column] for column in body.columns]
        inertial[at] = True
        if spread is not None:
            theta[at] = _drawn(truth.theta[at], spread, rng)
            std[at] = _declared(theta[at], spread)
    if spread is not None:
        draws = np.exp(spread.terms * rng.normal(size=(~inertial).sum()))
        theta[~inertial] *= draws
        std[~inertial] = spread.terms * np.abs(theta[~inertial])
        std = _floored(std, truth.parameters)
    return Prior(theta, std)


def with_known_errors(task: Task, share: float, rng: np.random.Generator) -> Task:
    """The task with its known parts told with errors: masses, inertias and joint terms of this
    share (standard deviation), centres of mass of the same share of LENGTH."""
    spread = PriorSpread(share, share * LENGTH, share, share)
    links = [_drawn(phi, spread, rng) for phi in task.known_links]
    terms = {
        term: values * np.exp(share * rng.normal(size=len(values)))
        for term, values in task.known_terms.items()
    }
    return replace(task, known_links=np.array(links).reshape(-1, 10), known_terms=terms)


def _floored(std: Array, names: tuple[str, ...]) -> Array:
    """Nobody knows a parameter to be exactly zero: at least 1 % of the largest deviation among
    parameters of the same kind (`.m`, `.fv`, ...), or a thousandth where the kind has none."""
    out = std.copy()
    kinds = np.array([name.rpartition(".")[2] for name in names])
    for kind in set(kinds):
        like = kinds == kind
        out[like] = np.maximum(out[like], 0.01 * std[like].max() or 1e-3)
    return out


def _drawn(phi: Array, spread: PriorSpread, rng: np.random.Generator) -> Array:
    """Mass scaled, centre of mass moved, density covariance stretched along drawn axes: every draw
    is a body that can exist."""
    z_mass, z_com, z_axes = rng.normal(), rng.normal(size=3), rng.normal(size=3)
    mass, com, inertia = mass_com_inertia(phi)
    if mass <= 0:
        return phi.copy()
    factor = np.exp(spread.mass * z_mass)
    covariance = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    stretch = np.diag(np.exp(0.5 * spread.inertia * z_axes))
    covariance = factor * stretch @ covariance @ stretch
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return phi_of(factor * mass, com + spread.com * z_com, inertia)


def _declared(phi: Array, spread: PriorSpread) -> Array:
    """What the method is told of the spread, from the prior itself: (10,)."""
    mass, com, inertia = mass_com_inertia(phi)
    size = float(np.trace(inertia)) / 3 + mass * float(com @ com)
    h = mass * np.sqrt((spread.mass * com) ** 2 + spread.com**2)
    moments = spread.inertia * size + 2 * mass * np.linalg.norm(com) * spread.com
    return np.concatenate([[spread.mass * mass], h, np.full(6, moments)])
