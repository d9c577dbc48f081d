"""Least squares near the model file: the torque that a robot much like the model could give.

Free are offset, armature and friction of each joint, the last two not negative; the inertial
parameters of the links stay within stated spreads of the file's. Sign, gain, order of columns and
gravity, to which a free fit is blind, remain in the residual of this one.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.spatial import body_mass_inertia, gyration
from sysid_bench.types import Array

TERMS: Final = ("viscous", "coulomb", "armature", "offset")
SIGNED: Final = 3
"""The first terms cannot be negative: friction dissipates, and rotors have inertia."""

PENALTY: Final = 0.05
"""Residual, relative to a joint's RMS torque, that outweighs one standard deviation of the prior:
of the size of what rigid bodies and simple friction leave on recorded arms."""

FLOOR: Final = 0.015
"""Least residual of a joint, relative to its RMS torque, that the fit believes in."""

PARTS: Final = 4.0
"""Independent numbers that the residual of a joint counts as, one a second at most: what bodies and
friction leave repeats with the motion, and more samples of it do not say more."""

REWEIGHTED: Final = 4
SETTLED: Final = 0.02
"""Fits with the joints' weights, each from the residuals of the one before, and the change of the
weights that ends them."""

MASS: Final = 0.4
CENTRE: Final = 0.4
INERTIA: Final = 0.8
"""Spreads of mass, of the centre of mass (in units of its distance and of the radius of gyration)
and of inertia of a link: model files differ from their robots by this much."""

FREE: Final = 30.0
"""Factor on the spreads where the file's inertias are placeholders."""

ROUNDS: Final = 6


def std_of(theta: Array) -> Array:
    """Standard deviations (10 n,) of link parameters theta (n, 10)."""
    sizes = [_spread(phi) for phi in theta]
    floor = 1e-3 * np.max(sizes, axis=0, initial=0.0)
    return np.asarray(np.maximum(sizes, np.maximum(floor, 1e-9))).ravel()


def load_std(theta: Array) -> Array:
    """Standard deviations (10,) of a load at the tool, of which nothing is known but that it hardly
    outweighs the links theta (n, 10) together."""
    size = np.sum([_spread(phi) for phi in theta], axis=0)
    return np.asarray(np.maximum(size, 1e-9) / MASS)


def _spread(phi: Array) -> Array:
    mass, com, _ = body_mass_inertia(phi)
    if mass <= 0:
        return np.zeros(10)
    distance = float(com @ com) + gyration(phi) ** 2
    return np.concatenate(
        [[MASS * mass], np.full(3, CENTRE * mass * np.sqrt(distance)),
         np.full(6, INERTIA * mass * distance)]
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class NearModelFit:
    """Fit near the model. `cost`: sum of the squared relative residuals of all joints and of the
    penalty; `score`: -2 log of the posterior density, but for a constant. `residual` (n,): RMS
    residual of each joint over its RMS torque; `links` (p,) and `terms` (n, 4): estimates, relative
    torques in SI."""

    cost: float
    score: float
    residual: Array
    links: Array
    terms: Array


@dataclass(frozen=True, eq=False)
class NearModel:
    """Normal equations of a motion. Columns of joint j: r links in coordinates of the prior, 4
    terms, the torque predicted by the file, and k torques that were recorded; `products` (n, c, c)
    are their mean products, `basis` (p, r) the links' directions, `scale` (p,) their spreads."""

    products: Array
    basis: Array
    scale: Array
    known: Array  # (p,) of the file
    information: Array  # (r,) mean squared relative torque of one spread along each direction
    parts: float = PARTS

    @property
    def rank(self) -> int:
        """Number r of directions of the links."""
        return int(self.basis.shape[1])

    def fit(self, mixing: Array) -> NearModelFit:
        """Fit of the torques T @ mixing, T the recorded ones (N, k) and mixing (k, n)."""
        r, n, m = self.rank, len(self.products), len(TERMS)
        known = r + m
        select, scale = self._torques(mixing)
        select[:, known, 0] = -1.0
        rhs = (self.products @ select)[:, :, 0]  # products of all columns with tau - tau_file
        left = (select.transpose(0, 2, 1) @ self.products @ select)[:, 0, 0]
        signed = np.add.outer(r + m * np.flatnonzero(scale > 0), range(SIGNED)).ravel()
        P, weight = self.products[:, :known, :known], np.ones(n)
        for _ in range(REWEIGHTED):
            H, b = self._system(scale * weight, rhs)
            x = _bounded(H, b, signed)
            links, terms = x[:r], x[r:].reshape(n, -1)
            # Residuals from the products alone: |y - X x|^2 = y'y - 2 x'X'y + x'X'X x.
            full = np.concatenate([np.tile(links, (n, 1)), terms], axis=1)
            rss = left - 2 * (full * rhs[:, :known]).sum(axis=1)
            rss += np.einsum("ni,nij,nj->n", full, P, full)
            square = np.maximum(rss, 0.0) * scale
            old, weight = weight, _weights(square)
            if np.abs(weight - old).max() < SETTLED:
                break
        prior = float((links**2).sum())
        # A joint's own misfit is its noise: one that nothing explains decides nothing.
        score = self.parts * float(np.log1p(square / FLOOR**2).sum()) + prior
        cost = float(square.sum()) + PENALTY**2 * prior
        links = self.known + self.scale * (self.basis @ links)
        return NearModelFit(cost, score, np.sqrt(square), links, terms)

    def variances(self, mixing: Array) -> Array:
        """Variances (p,) of the link parameters in the fit of T @ mixing, over those of the
        prior."""
        scale, no_sides = self._torques(mixing)[1], np.zeros((len(self.products), self.rank + 4))
        weight = _weights(self.fit(mixing).residual ** 2)
        H, _ = self._system(scale * weight, no_sides)
        H[np.diag_indices_from(H)] += 1e-12 * H.diagonal().max()
        known = FLOOR**2 * np.linalg.inv(H)[: self.rank, : self.rank]
        # Directions without any effect on the torque keep the spread of the prior.
        unknown = np.maximum(1.0 - (self.basis**2).sum(axis=1), 0.0)
        return np.asarray(np.einsum("pi,ij,pj->p", self.basis, known, self.basis) + unknown)

    def _torques(self, mixing: Array) -> tuple[Array, Array]:
        """Weights (n, c, 1) of the columns in the torques T @ mixing, and the reciprocals (n,) of
        their mean squares, 0 of one that is zero."""
        select = np.zeros((len(self.products), self.products.shape[1], 1))
        select[:, self.rank + len(TERMS) + 1 :, 0] = mixing.T
        size = (select.transpose(0, 2, 1) @ self.products @ select)[:, 0, 0]
        return select, np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)

    def _system(self, scale: Array, rhs: Array) -> tuple[Array, Array]:
        """Normal matrix and right side of [links, terms of all joints]."""
        r, n, m = self.rank, len(self.products), len(TERMS)
        scale = self.parts * scale
        H = np.zeros((r + n * m, r + n * m))
        H[:r, :r] = np.tensordot(scale, self.products[:, :r, :r], axes=1)
        H[:r, :r] += FLOOR**2 * np.eye(r)
        b = np.zeros(r + n * m)
        b[:r] = scale @ rhs[:, :r]
        for j in range(n):
            part = slice(r + j * m, r + (j + 1) * m)
            H[:r, part] = scale[j] * self.products[j, :r, r : r + m]
            H[part, :r] = H[:r, part].T
            H[part, part] = scale[j] * self.products[j, r : r + m, r : r + m]
            b[part] = scale[j] * rhs[j, r : r + m]
        return H, b


def _weights(square: Array) -> Array:
    """Weights (n,) of joints in the fit that minimises the score, from their relative squares."""
    return np.asarray(FLOOR**2 / (FLOOR**2 + square))


def _bounded(H: Array, b: Array, signed: Array) -> Array:
    """Minimum of x' H x / 2 - b' x with x >= 0 for the indices `signed`, by an active set."""
    # Columns in SI differ by decades: with a unit diagonal one small number regularises all.
    D = np.sqrt(np.maximum(np.diag(H), 1e-300))
    Hs = H / np.outer(D, D)
    Hs[np.diag_indices_from(Hs)] += 1e-9
    free = np.diag(H) > 0
    x = np.zeros(len(b))
    for _ in range(ROUNDS):
        index = np.flatnonzero(free)
        x[:] = 0.0
        x[index] = np.linalg.solve(Hs[np.ix_(index, index)], b[index] / D[index])
        # Unknowns that turn negative are held at zero, and never set free again.
        wrong = signed[x[signed] < 0]
        if len(wrong) == 0:
            break
        free[wrong] = False
    x[~free] = 0.0
    x[signed] = np.maximum(x[signed], 0.0)
    return np.asarray(x / D)


def near_model(
    W: Array, F: Array, T: Array, known: Array, scale: Array, seconds: float
) -> NearModel:
    """Normal equations of the link columns W (N, n, p), the terms F (N, n, 4) and the torques
    T (N, n, k), of which the first n are the recorded ones, with the file's parameters `known` (p,)
    and their spreads `scale` (p,); the recording lasts some `seconds`."""
    n = W.shape[1]
    rms = np.sqrt((T[:, 0, :n] ** 2).mean(axis=0))
    weight = np.where(rms > 0, 1.0 / np.where(rms > 0, rms, 1.0), 0.0)
    Ws = W * scale
    # Directions without effect on any torque are dropped: the prior alone decides them.
    gram = np.einsum("j,jik->ik", weight**2, _grams(Ws))
    values, vectors = np.linalg.eigh(gram)
    kept = values > 1e-9 * max(float(values[-1]), 1e-300)
    basis = vectors[:, kept]
    file = W @ known
    columns = np.concatenate([Ws @ basis, F, file[:, :, None], T], axis=2)
    parts = min(PARTS, seconds)
    return NearModel(_grams(columns), basis, scale, known, values[kept], parts)


def _grams(X: Array) -> Array:
    """Mean products (n, c, c) of columns X (N, n, c), joint by joint."""
    by_joint = np.ascontiguousarray(X.transpose(1, 0, 2))
    return np.asarray(by_joint.transpose(0, 2, 1) @ by_joint / len(X))
