"""`RobotModel`: the compiled MuJoCo model with its names, limits, couplings and true parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import Payload
from sysid_bench.models.tree import BALL, FREE, HINGE, SLIDE, Tree
from sysid_bench.spatial import NAMES
from sysid_bench.types import Array, Body, Trajectory

if TYPE_CHECKING:
    import mujoco

    from sysid_bench.models.pairing import Pairing

TYPE_NAMES: Final = {FREE: "free", BALL: "ball", SLIDE: "slide", HINGE: "hinge"}
SUFFIX: Final = {
    "viscous": "fv",
    "coulomb": "fc",
    "offset": "offset",
    "armature": "Ia",
    "spring": "k",
}
"""Suffix of each joint term in parameter names: `<joint>.fv` and so on."""

TERM_OF: Final = {suffix: term for term, suffix in SUFFIX.items()}


@dataclass(frozen=True)
class Joint:
    """A joint: name, kind (free ball slide hinge), addresses in q and v, names of its dofs."""

    name: str
    kind: str
    qadr: int
    vadr: int
    dofs: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class JointTerms:
    """Joint terms, the torque of each degree of freedom besides inertia and gravity, arrays (nv,):
    tau = viscous v + coulomb sign(v) + offset + armature a + spring (q - spring_reference) +
    viscous_coupling v; viscous_coupling (nv, nv) has a zero diagonal and need not be symmetric: row
    i is the friction on joint i due to the rates of others, as with tendons over several joints."""

    viscous: Array
    coulomb: Array
    offset: Array
    armature: Array
    spring: Array
    spring_reference: Array
    viscous_coupling: Array


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits per degree of freedom (nv,); a free or ball joint's positions are unlimited."""

    q_low: Array
    q_high: Array
    v: Array
    a: Array
    tau: Array


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot, with a payload mounted or not. `phi` (nb, 10) and `joint_terms` are the true
    parameters of the simulated plant; methods are given a prior drawn around them, never these."""

    name: str
    manifest: Manifest
    payload: Payload
    mj: "mujoco.MjModel"
    spec: "mujoco.MjSpec" = field(repr=False)
    tree: Tree
    body_names: tuple[str, ...]
    joints: tuple[Joint, ...]
    phi: Array
    joint_terms: JointTerms
    limits: JointLimits
    tool_body: int  # index into body_names: the body that carries payloads
    payload_body: int | None
    format: str  # "urdf" or "mjcf"
    text: bytes = field(repr=False)  # the canonical text (URDF) or the file (MJCF)
    repairs: tuple[str, ...] = ()
    coupling: Coupling | None = None
    """Coupled joints (mimics, equalities, closed chains); None where every joint is independent."""
    drive_ratio: Array | None = None
    """Displacement of each joint (nv,) per displacement that the identified model takes from its
    drive; None: they are equal. Only the plant's robot has one."""
    motors: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Motors that the file states, by joint: gear ratio, then (MJCF) the range of force."""

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the degrees of freedom (nv,)."""
        return tuple(name for joint in self.joints for name in joint.dofs)

    @property
    def _row_kinds(self) -> tuple[str, ...]:
        """Kind of each row (nv,), since only rows of one kind and unit are compared: forces of
        slides, torques of hinges and balls, force and moment on a floating base."""
        kinds = {
            "hinge": ("joint N m",),
            "slide": ("joint N",),
            "ball": ("joint N m",) * 3,
            "free": ("base N",) * 3 + ("base N m",) * 3,
        }
        return tuple(kind for joint in self.joints for kind in kinds[joint.kind])

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return self.tree.nv

    @cached_property
    def torque_dofs(self) -> Array:
        """Independent degrees of freedom (n,): the torque of coupled joints is taken on them."""
        return np.arange(self.nv) if self.coupling is None else self.coupling.independent

    @property
    def torque_rows(self) -> tuple[str, ...]:
        """Names of `torque_dofs` (n,): the rows of every problem, all of `rows` if uncoupled."""
        return tuple(self.rows[dof] for dof in self.torque_dofs)

    @property
    def torque_units(self) -> tuple[str, ...]:
        """Kinds of `torque_rows` (n,)."""
        return tuple(self._row_kinds[dof] for dof in self.torque_dofs)

    @cached_property
    def without_coupling(self) -> "RobotModel":
        """The same tree with every joint independent."""
        return self if self.coupling is None else replace(self, coupling=None)

    def reduced(self, q: Array, tau: Array) -> Array:
        """Return torques G' tau (N, n) on `torque_rows`, tau (N, nv) being forces of the tree at
        q."""
        return tau if self.coupling is None else self.coupling.reduced(q, tau)

    def completed(self, motion: Trajectory) -> Trajectory:
        """Return the motion with the dependent joints placed by the independent ones."""
        if self.coupling is None:
            return motion
        q, v, a = self.coupling.completed(motion.q, motion.v, motion.a)
        return replace(motion, q=q, v=v, a=a)

    @property
    def scalar_dofs(self) -> Array:
        """Degrees of freedom (k,) of hinges and slides, which alone have joint terms."""
        return np.array([j.vadr for j in self.joints if j.kind in ("hinge", "slide")], dtype=int)

    @property
    def floating(self) -> bool:
        """True where a body moves freely."""
        return any(joint.kind == "free" for joint in self.joints)

    @cached_property
    def inertial_columns(self) -> tuple[str, ...]:
        """`<body>.m` ... `<body>.Izz` of every body, in tree order (10 nb,)."""
        return tuple(f"{body}.{name}" for body in self.body_names for name in NAMES)

    def term_columns(self, terms: tuple[str, ...]) -> tuple[str, ...]:
        """Return the parameter names of joint terms, term after term: "viscous" is that of every
        hinge and slide, "j1.k" that of one joint, "j5.fv.j6" the friction on j5 due to j6.

        Raises UsageError for a term that the robot does not have.
        """
        columns: list[str] = []
        for term in terms:
            if term in SUFFIX:
                columns += (f"{self.rows[dof]}.{SUFFIX[term]}" for dof in self.scalar_dofs)
            else:
                self.resolve_term(term)
                columns.append(term)
        return tuple(dict.fromkeys(columns))

    def resolve_term(self, name: str) -> tuple[str, int, int | None]:
        """Return (term, degree of freedom, the one whose rate it multiplies where that is another)
        of a parameter name; raises UsageError for an unknown name."""
        if name not in self._term_names:
            joints = [self.rows[dof] for dof in self.scalar_dofs]
            known = [*SUFFIX, *(f"{joint}.{suffix}" for joint in joints for suffix in TERM_OF)]
            raise unknown_name(
                "joint term", name, known, "Viscous friction on j5 due to j6 is 'j5.fv.j6'."
            )
        return self._term_names[name]

    @property
    def term_names(self) -> frozenset[str]:
        """Names of all joint terms of single joints: "j1.fv", "j5.fv.j6"."""
        return frozenset(self._term_names)

    @cached_property
    def _term_names(self) -> dict[str, tuple[str, int, int | None]]:
        """Meaning of the name of every joint term; of joints called "a" and "a.fv" the first one in
        the tree wins."""
        joints = {self.rows[dof]: int(dof) for dof in self.scalar_dofs}
        names: dict[str, tuple[str, int, int | None]] = {}
        for joint, dof in reversed(joints.items()):
            names |= {f"{joint}.{suffix}": (term, dof, None) for suffix, term in TERM_OF.items()}
            names |= {
                f"{joint}.fv.{other}": ("viscous_coupling", dof, index)
                for other, index in joints.items()
                if index != dof
            }
        return names

    def term_values(self, terms: tuple[str, ...]) -> Array:
        """Return the true values of `term_columns(terms)`."""
        indices = [self.resolve_term(name) for name in self.term_columns(terms)]
        return np.array(
            [
                getattr(self.joint_terms, term)[dof if other is None else (dof, other)]
                for term, dof, other in indices
            ]
        )

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All bodies, each with the names of its ten columns."""
        return tuple(Body(b, tuple(f"{b}.{n}" for n in NAMES)) for b in self.body_names)

    @cached_property
    def pairing(self) -> "Pairing":
        """The same robot in Pinocchio."""
        from sysid_bench.models.pairing import pinocchio_pairing

        return pinocchio_pairing(self.mj)
