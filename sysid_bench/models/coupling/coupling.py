"""Coupled joints of a robot: q, v, a of the whole tree from those of the independent joints, and
torques of the tree reduced to them, tau_ind = G(q)^T tau_tree."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.coupling.group import Group
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Coupling:
    """The couplings of a robot with `nv` degrees of freedom, `independent` (n,) and `dependent`
    (m,).

    Arrays (n,): within `low` and `high` all positions close; `slower` is the share of its velocity
    limit that an independent joint may use so that its followers keep theirs. `bounds` (4, m):
    lowest and highest position, velocity and acceleration stated for dependent joints, infinite
    where none is. `qadr` and `q0` (nv,): address in q and reference of hinges and slides (-1, 0
    elsewhere). `repairs`: ignored limits, in words.
    """

    nv: int
    names: tuple[str, ...]
    groups: tuple[Group, ...]
    independent: Array
    dependent: Array
    qadr: Array
    q0: Array
    low: Array
    high: Array
    slower: Array
    bounds: Array
    repairs: tuple[str, ...] = ()

    @cached_property
    def _columns(self) -> tuple[tuple[Group, Array, Array], ...]:
        """Each group with the indices of its dependent and independent dofs among all of them."""
        return tuple(
            (
                group,
                np.searchsorted(self.dependent, group.dofs[group.dependent]),
                np.searchsorted(self.independent, group.dofs[group.independent]),
            )
            for group in self.groups
        )

    @property
    def linear(self) -> bool:
        """True where G is constant."""
        return all(group.linear for group in self.groups)

    @cached_property
    def is_coupled(self) -> Array:
        """Matrix (m, n), True where a dependent dof follows an independent one."""
        out = np.zeros((len(self.dependent), len(self.independent)), dtype=bool)
        for group, rows, columns in self._columns:
            if group.linear:
                F = group.follow(group.reference[None])[0]
                out[np.ix_(rows, columns)] = F != 0.0
            else:
                out[np.ix_(rows, columns)] = True
        return out

    def independent_of(self, dof: int) -> Array:
        """Return the independent dofs that a dependent one follows, in tree order."""
        row = int(np.searchsorted(self.dependent, dof))
        followed: Array = self.independent[self.is_coupled[row]]
        return followed

    def follow(self, q: Array) -> Array:
        """Return F (N, m, n) with v_dep = F v_ind at closed q (N, nq)."""
        out = np.zeros((len(q), len(self.dependent), len(self.independent)))
        for group, rows, columns in self._columns:
            out[:, rows[:, None], columns] = group.follow(self._displacement(group, q))
        return out

    def G(self, q: Array) -> Array:
        """Return G (N, nv, n) with v = G v_ind at closed q (N, nq)."""
        out = np.zeros((len(q), self.nv, len(self.independent)))
        out[:, self.independent, np.arange(len(self.independent))] = 1.0
        out[:, self.dependent] = self.follow(q)
        return out

    def reduced(self, q: Array, tau: Array) -> Array:
        """Return G^T tau (N, n) of generalised forces tau (N, nv) of the tree (d'Alembert)."""
        # G stacks the identity (independent) and F (dependent): G' tau = tau_ind + F' tau_dep.
        followed = np.einsum("nij,ni->nj", self.follow(q), tau[:, self.dependent])
        total: Array = tau[:, self.independent] + followed
        return total

    def completed(
        self, q: Array, v: Array, a: Array, near: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return q (N, nq), v, a (N, nv) of the whole tree, with the values of dependent joints
        replaced. `near` (N, nq), closed postures not far away, saves time.

        Raises ModelError, with the configuration, where the closure is lost or singular.
        """
        q, v, a = q.copy(), v.copy(), a.copy()
        for group in self.groups:
            moving, following = group.dofs[group.independent], group.dofs[group.dependent]
            given = self._displacement(group, q)[:, group.independent]
            # A loop can close in several ways: `near` and the reference select the branch.
            start = None if near is None else self._displacement(group, near)
            x, good = group.motion_closure(given, start)
            if not good.all():
                raise self._lost_closure(group, given[int(np.argmin(good))])
            q[:, self.qadr[group.dofs]] = x + self.q0[group.dofs]
            F = group.follow(x)
            v[:, following] = _times(F, v[:, moving])
            a[:, following] = _times(F, a[:, moving]) + group.drift(x, v[:, group.dofs])
        return q, v, a

    def spread(self, values: Array) -> Array:
        """Return values (N, n) of the independent dofs among all dofs (N, nv), zero elsewhere."""
        out = np.zeros((len(values), self.nv))
        out[:, self.independent] = values
        return out

    def reference(self, q: Array) -> Array:
        """Return q (nq,) with the coupled joints at their closed reference posture."""
        q = q.copy()
        for group in self.groups:
            q[self.qadr[group.dofs]] = group.reference + self.q0[group.dofs]
        return q

    def inconsistency(self, q: Array) -> float:
        """Return the largest relative error of closed positions q (N, nq) because redundant rows of
        a file contradict each other; rounding where they do not."""
        errors = [group.inconsistency(self._displacement(group, q)) for group in self.groups]
        return max((float(error.max(initial=0.0)) for error in errors), default=0.0)

    def _displacement(self, group: Group, q: Array) -> Array:
        x: Array = q[:, self.qadr[group.dofs]] - self.q0[group.dofs]
        return x

    def _lost_closure(self, group: Group, given: Array) -> ModelError:
        x, _ = group.track_closure(given[None])
        value = float(group.condition(x)[0])
        return ModelError(
            f"The coupling of {names_of(self.names, group.dofs)} cannot be closed, or is singular, "
            f"at {_configuration_text(self, group, given)} (smallest singular value {value:.2g} on "
            "the way there); keep the motion nearer to the reference posture, by limits in the "
            "manifest."
        )


def _configuration_text(coupling: Coupling, group: Group, given: Array) -> str:
    """Return "crank = 0.31, lift = -0.2" for the independent joints of a group."""
    moving = group.dofs[group.independent]
    values = given + coupling.q0[moving]
    return ", ".join(
        f"{coupling.names[dof]} = {value:.4g}" for dof, value in zip(moving, values, strict=True)
    )


def names_of(names: tuple[str, ...], dofs: Array) -> str:
    """Return "a, b, c" for degrees of freedom by their indices."""
    return ", ".join(names[dof] for dof in dofs)


def _times(F: Array, v: Array) -> Array:
    """F v (N, r) for F (N or 1, r, c) and v (N, c)."""
    product: Array = np.matmul(F, v[:, :, None])[:, :, 0]
    return product
