"""Least squares near the model file: the torque that a robot much like the model could give.

Free are offset, armature and friction of each joint, the last two not negative; the inertial
parameters of the links stay within stated spreads of the file's. Sign, gain, order of columns and
gravity, to which a free fit is blind, remain in the residual of this one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.spatial import body_mass_inertia, gyration
from sysid_bench.types import Array

TERMS: Final = ("viscous", "coulomb", "armature", "offset")
SIGNED: Final = 3
"""The first terms cannot be negative: friction dissipates, and rotors have inertia."""

PASSIVE: Final = np.array([1.0, 1.0, 0.0, 1.0])
BITS: Final = 1 << np.arange(SIGNED)
BOUND: Final = np.array([0.0] * SIGNED + [-np.inf])

PENALTY: Final = 0.05
"""Residual, relative to a joint's RMS torque, that outweighs one standard deviation of the prior:
of the size of what rigid bodies and simple friction leave on recorded arms."""

FLOOR: Final = 0.015
"""Least residual of a joint, relative to its RMS torque, that the fit believes in."""

PARTS: Final = 4.0
"""Independent numbers that the residual of a joint counts as, one a second at most: what bodies and
friction leave repeats with the motion, and more samples of it do not say more."""

HEAVY: Final = float(np.log(4.0))
"""Friction and offset of a joint beyond the torque that holds its links and a load: one standard
deviation, in the logarithm. Measured drives: 0.01 to 1, small geared wrists up to 7."""

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

    @property
    def penalty(self) -> float:
        """Part of the cost that is the distance of the links from the model file."""
        return self.cost - float((self.residual**2).sum())


@dataclass(frozen=True, eq=False)
class NearModel:
    """Normal equations of a motion. Columns of joint j: r links in coordinates of the prior, the
    torque predicted by the file, k torques that were recorded, and 4 terms; `products` (n, c, c)
    are their mean products, `basis` (p, r) the links' directions, `scale` (p,) their spreads."""

    products: Array
    basis: Array
    scale: Array
    known: Array  # (p,) of the file
    holding: Array  # (n,) torques that the drives are built to hold; infinite where none is known
    parts: float = PARTS
    is_limb: bool = False
    _held: dict[tuple[int, int], tuple[Array, Array]] = field(default_factory=dict)
    _fits: dict[bytes, NearModelFit] = field(default_factory=dict)

    @property
    def rank(self) -> int:
        """Number r of directions of the links."""
        return int(self.basis.shape[1])

    @property
    def information(self) -> Array:
        """Mean squared relative torques (r,) of one spread along independent directions, the first
        n torques being those of the joints."""
        r, n = self.rank, len(self.products)
        weight = self.torque_scale(np.eye(self.products.shape[1] - r - 1 - len(TERMS), n))
        return np.linalg.eigvalsh(np.tensordot(weight, self.products[:, :r, :r], axes=1))

    @cached_property
    def without_terms(self) -> tuple[Array, Array]:
        """Mean products (n, c - 4, c - 4) of the links, file and torques of all joints after their
        terms are fitted to each, and the terms (n, 4, c - 4) of these fits."""
        every = np.arange(len(self.products))
        return self._fitted_terms(every, 0 * every)

    def _with_held(self, keys: Sequence[tuple[int, int]]) -> Iterator[tuple[Array, Array]]:
        """Yield the same of single joints; the bits of the second number are terms at zero."""
        if new := [key for key in keys if key not in self._held]:
            found = zip(*self._fitted_terms(*np.array(new).T), strict=True)
            self._held.update(zip(new, found, strict=True))
        return (self._held[key] for key in keys)

    def _fitted_terms(self, joints: Array, held: Array) -> tuple[Array, Array]:
        P, m = self.products[joints], len(TERMS)
        own, sides, power = P[:, -m:, -m:], P[:, -m:, :-m], np.diagonal(P, axis1=1, axis2=2)[:, -m:]
        free = (power > 0) & (held[:, None] & np.append(BITS, 0) == 0)
        # Columns in SI differ by decades: with a unit diagonal one small number regularises.
        D = np.where(free, np.sqrt(np.where(free, power, 1.0)), np.inf)
        own = own / (D[:, :, None] * D[:, None, :])
        own[:, range(m), range(m)] = 1.0 + 1e-9
        fitted = np.linalg.solve(own, sides / D[:, :, None]) / D[:, :, None]
        return P[:, :-m, :-m] - P[:, :-m, -m:] @ fitted, fitted

    def fit(self, mixing: Array) -> NearModelFit:
        """Fit of the torques T @ mixing, T the recorded ones (N, k) and mixing (k, n)."""
        key = mixing.tobytes()
        if key not in self._fits:  # several checks ask for the same one
            self._fits[key] = self._fit(mixing)
        return self._fits[key]

    @cached_property
    def _limbs(self) -> list[tuple[Array, "NearModel"]]:
        """Limbs with their joints, where there are several: their fits are independent."""
        r, P = self.rank, self.products
        touched = np.diagonal(P, axis1=1, axis2=2)[:, :r] > 0
        limbs = [] if self.is_limb else connected(touched)
        used = [np.append(touched[own].any(axis=0), [True] * (len(P[0]) - r)) for own in limbs]
        return [
            (own, replace(
                self, products=P[own][:, some][:, :, some], basis=self.basis[:, some[:r]],
                holding=self.holding[own], is_limb=True, _held={}, _fits={},
            ))
            for own, some in zip(limbs, used, strict=True)
            if len(limbs) > 1
        ]  # fmt: skip

    def _fit(self, mixing: Array) -> NearModelFit:
        if self._limbs:
            parts = [(own, limb.fit(mixing[:, own])) for own, limb in self._limbs]
            residual, terms = np.zeros(len(mixing[0])), np.zeros((len(mixing[0]), len(TERMS)))
            for own, fit in parts:
                residual[own], terms[own] = fit.residual, fit.terms
            links = self.known + sum(fit.links - self.known for _, fit in parts)
            cost, score = (
                sum(part) for part in zip(*((f.cost, f.score) for _, f in parts), strict=True)
            )
            return NearModelFit(cost, score, residual, links, terms)
        n, scale = len(self.products), self.torque_scale(mixing)
        sides = np.concatenate([-np.ones((1, n)), mixing]).T  # of the torque less that of the file
        weight = np.ones(n)
        for _ in range(REWEIGHTED):
            links, terms, rss = self._bounded(scale * weight, sides)
            square = np.maximum(rss, 0.0) * scale
            old, weight = weight, _weights(square)
            if np.abs(weight - old).max() < SETTLED:
                break
        terms[scale == 0] = 0.0
        prior = float((links**2).sum())
        # A joint's own misfit is its noise: one that nothing explains decides nothing.
        score = self.parts * float(np.log1p(square / FLOOR**2).sum()) + prior
        passive = terms * PASSIVE
        power = np.einsum("ni,nij,nj->n", passive, self.products[:, -4:, -4:], passive)
        beyond = 0.5 * np.log(np.maximum(power / self.holding**2, 1.0))
        score += float(((beyond / HEAVY) ** 2).sum())
        cost = float(square.sum()) + PENALTY**2 * prior
        links = self.known + self.scale * (self.basis @ links)
        return NearModelFit(cost, score, np.sqrt(square), links, terms)

    def variances(self, mixing: Array) -> Array:
        """Variances (p,) of the link parameters in the fit of T @ mixing, over those of the
        prior."""
        r, weight = self.rank, _weights(self.fit(mixing).residual ** 2) * self.torque_scale(mixing)
        P = self.without_terms[0][:, :r, :r]
        H = FLOOR**2 * np.eye(r) + self.parts * np.tensordot(weight, P, axes=1)
        # Directions without any effect on the torque keep the spread of the prior.
        unknown = np.maximum(1.0 - (self.basis**2).sum(axis=1), 0.0)
        known = FLOOR**2 * np.linalg.inv(H)
        return np.asarray(np.einsum("pi,ij,pj->p", self.basis, known, self.basis) + unknown)

    def torque_scale(self, mixing: Array) -> Array:
        """Reciprocals (n,) of the mean squares of the torques T @ mixing, 0 of one that is zero."""
        torques = slice(self.rank + 1, self.rank + 1 + len(mixing))
        size = (mixing * (self.products[0, torques, torques] @ mixing)).sum(axis=0)
        return np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)

    def _bounded(self, scale: Array, sides: Array) -> tuple[Array, Array, Array]:
        """Links (r,) and terms (n, 4) that minimise the residuals of the torques `sides`
        (n, k + 1), by their scales, with no negative friction or armature, by an active set; and
        the squares (n,) of the residuals."""
        r, n = self.rank, len(sides)
        held, weight = np.zeros(n, dtype=int), self.parts * scale
        P, fitted = self.without_terms
        full = np.empty((n, P.shape[1]))
        full[:, r:] = sides
        for turn in range(ROUNDS):
            H = (weight @ P.reshape(n, -1)).reshape(P.shape[1:])[:r, :r]
            # Beyond sixteen digits, as of positions in another unit, the prior would be lost.
            H[range(r), range(r)] += FLOOR**2 + 1e-14 * H.diagonal().max(initial=0.0)
            b = weight @ (P[:, :r, r:] @ sides[:, :, None])[:, :, 0]
            # Residuals from the products alone: those of the combination torque - links.
            full[:, :r] = -np.linalg.solve(H, b)
            terms = (fitted @ full[:, :, None])[:, :, 0]
            # Terms that turn negative are held at zero, and never set free again.
            wrong = (terms[:, :SIGNED] < 0) & (scale > 0)[:, None]
            if not wrong.any():
                break
            P, fitted = (P, fitted) if turn else (P.copy(), fitted.copy())
            held += wrong @ BITS
            keys = [(j, int(held[j])) for j in np.flatnonzero(wrong.any(axis=1)).tolist()]
            for (j, _), found in zip(keys, self._with_held(keys), strict=True):
                P[j], fitted[j] = found
        rss = ((full[:, None] @ P)[:, 0] * full).sum(axis=1)
        return -full[0, :r], np.maximum(terms, BOUND), rss


def _weights(square: Array) -> Array:
    """Weights (n,) of joints in the fit that minimises the score, from their relative squares."""
    return np.asarray(FLOOR**2 / (FLOOR**2 + square))


def connected(touched: Array) -> list[Array]:
    """Joints of each limb, from what each joint touches (n, p): legs on a base at rest, or fingers,
    have no link in common."""
    together = touched.astype(float) @ touched.T > 0
    for _ in touched:
        together = together @ together
    return [np.flatnonzero(row) for row in np.unique(together, axis=0)]


def independent_directions(W: Array, links: Sequence[Array]) -> Array:
    """Orthonormal directions (p, r) of the columns W (N, n, p) that have an effect on a torque,
    those of each joint by its own size, limb by limb: the prior alone decides the others. `links`:
    for each joint the columns that are not zero."""
    power = (W**2).sum(axis=(0, 2))
    W = W / np.sqrt(np.where(power > 0, power, 1.0))[:, None]
    touched = np.stack([np.isin(np.arange(W.shape[2]), own) for own in links])
    found = []
    for joints in connected(touched):
        own = np.flatnonzero(touched[joints].any(axis=0))
        A = W[:, joints][:, :, own].reshape(-1, len(own))
        values, vectors = np.linalg.eigh(A.T @ A)
        kept = values > 1e-12 * max(float(values.max(initial=0.0)), 1e-300)
        found.append(np.zeros((W.shape[2], int(kept.sum()))))
        found[-1][own] = vectors[:, kept]
    return np.concatenate(found, axis=1)


def near_model(
    W: Array, F: Array, T: Array, *, links: Sequence[Array], basis: Array, known: Array,
    scale: Array, holding: Array, seconds: float,
) -> NearModel:  # fmt: skip
    """Normal equations of the link columns W (N, n, p), the terms F (N, n, 4) and the torques
    T (N, n, k), of which the first n are the recorded ones, with the file's parameters `known` (p,)
    and their spreads `scale` (p,), and the torques (n,) that the drives are built to hold; the
    recording lasts some `seconds`. `links`: for each joint the columns of W that are not zero;
    `basis` (p, r): directions of the scaled columns."""
    r, more = basis.shape[1], T.shape[2] + F.shape[2]
    products = np.empty((W.shape[1], r + 1 + more, r + 1 + more))
    for j, own in enumerate(links):
        A = np.concatenate([W[:, j, own] * scale[own], T[:, j], F[:, j]], axis=1)
        B = np.zeros((A.shape[1], r + 1 + more))
        B[: len(own), :r], B[: len(own), r] = basis[own], known[own] / scale[own]
        B[len(own) :, r + 1 :] = np.eye(more)
        products[j] = B.T @ (A.T @ A / len(A)) @ B
    return NearModel(products, basis, scale, known, holding, min(PARTS, seconds))
