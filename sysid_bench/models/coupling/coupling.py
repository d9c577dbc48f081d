"""Coupled joints of a robot: q, v, a of the whole tree from those of the independent joints, and
torques of the tree reduced to them, tau_ind = G(q)^T tau_tree."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.coupling.coordinates import Coordinates
from sysid_bench.models.coupling.group import Group, times
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Coupling:
    """The couplings of a robot with `nv` degrees of freedom, `independent` (n,) and `dependent`
    (m,).

    Arrays (n,): within `low` and `high` all positions close; `slower` is the share of its velocity
    limit that an independent joint may use so that its followers keep theirs. `bounds` (4, m):
    lowest and highest position, velocity and acceleration stated for dependent joints, infinite
    where none is. `qadr` and `q0` (nv,): address in q and reference of hinges and slides (-1, 0
    elsewhere); `coordinates` (nv,): those of all degrees of freedom, limits of ball and free joints
    being displacements in them. `repairs`: ignored limits, in words.
    """

    nv: int
    names: tuple[str, ...]
    groups: tuple[Group, ...]
    independent: Array
    dependent: Array
    qadr: Array
    q0: Array
    coordinates: Coordinates
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

    @cached_property
    def free_dofs(self) -> Array:
        """Degrees of freedom (k,) of ball and free joints in closed chains: the chain moves them,
        and they have no limits of their own."""
        coupled = np.concatenate([group.dofs for group in self.groups])
        return np.sort(coupled[self.qadr[coupled] < 0])

    @cached_property
    def bounded_dofs(self) -> Array:
        """Degrees of freedom (k,) with coordinates that limits hold: all but those of a floating
        base and of ball joints outside of closed chains."""
        return np.union1d(np.flatnonzero(self.qadr >= 0), self.free_dofs)

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
            coordinates = self._coordinates(group)
            x = coordinates.read(q)
            F = group.follow(x)
            if coordinates.rotations:
                # Velocities of a rotation are not derivatives of its coordinates: v_dep = V_dep u
                # and v_ind = V_ind u, so that F = V_dep V_ind^-1.
                L = np.zeros((len(x), len(group.dofs), len(group.independent)))
                L[:, group.independent, np.arange(len(group.independent))] = 1.0
                L[:, group.dependent] = F
                V = coordinates.rate_columns(x, L).swapaxes(1, 2)
                solved = np.linalg.solve(V[:, :, group.independent], V[:, :, group.dependent])
                F = solved.swapaxes(1, 2)
            out[:, rows[:, None], columns] = F
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
            coordinates = self._coordinates(group)
            asked = coordinates.read(q)
            dx, ddx = coordinates.rates(asked, v[:, group.dofs], a[:, group.dofs])
            given, following = asked[:, group.independent], group.dependent
            # A loop can close in several ways: `near` and the reference select the branch.
            start = None if near is None else coordinates.read(near)
            x, good = group.motion_closure(given, start)
            if not good.all():
                lost = given[int(np.argmin(good))]
                least = float(group.condition(group.follow_closure(lost[None])[0])[0])
                moving = group.dofs[group.independent]
                pairs = zip(moving, lost + self.q0[moving], strict=True)
                posture = ", ".join(f"{self.names[dof]} = {value:.4g}" for dof, value in pairs)
                raise ModelError(
                    f"The coupling of {names_of(self.names, group.dofs)} cannot be closed, or is "
                    f"singular, at {posture} (smallest singular value {least:.2g} on the way "
                    "there); keep the motion nearer to the reference posture, by limits in the "
                    "manifest."
                )
            coordinates.write(x, q)
            F = group.follow(x)
            dx[:, following] = times(F, dx[:, group.independent])
            ddx[:, following] = times(F, ddx[:, group.independent]) + group.drift(x, dx)
            v[:, group.dofs], a[:, group.dofs] = coordinates.velocity(x, dx, ddx)
        return q, v, a

    def with_positions(self, q: Array, values: Array) -> Array:
        """Return q (N, nq) with the independent coordinates (N, n) of `placeable` at these values,
        positions of hinges and slides and displacements of other joints; the dependent ones do not
        follow, and the rest stays."""
        q, dofs = q.copy(), self.bounded_dofs
        coordinates = self.coordinates.of(dofs)
        x = coordinates.read(q)
        asked = np.isin(self.independent, dofs)
        columns = np.searchsorted(dofs, self.independent[asked])
        x[:, columns] = (values - self.q0[self.independent])[:, asked]
        coordinates.write(x, q)
        return q

    def spread(self, values: Array) -> Array:
        """Return values (N, n) of the independent dofs among all dofs (N, nv), zero elsewhere."""
        out = np.zeros((len(values), self.nv))
        out[:, self.independent] = values
        return out

    def default_closure(self, q: Array) -> Array:
        """Return q (nq,) with the coupled joints at their closed reference posture."""
        closed = q[None].copy()
        for group in self.groups:
            self._coordinates(group).write(group.reference[None], closed)
        return np.asarray(closed[0])

    def closure_error(self, q: Array) -> float:
        """Return the largest relative error of closed positions q (N, nq) because redundant rows of
        a file contradict each other; rounding where they do not."""
        errors = [group.closure_error(self._coordinates(group).read(q)) for group in self.groups]
        return max((float(error.max(initial=0.0)) for error in errors), default=0.0)

    def _coordinates(self, group: Group) -> Coordinates:
        return self.coordinates.of(group.dofs)


def names_of(names: tuple[str, ...], dofs: Array) -> str:
    """Return "a, b, c" for degrees of freedom by their indices."""
    return ", ".join(names[dof] for dof in dofs)
