"""Checked updates of a model: unidentified parameters and impossible bodies are refused by name.

A model file carries no verdicts, so that its readers would rely on every number in it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import ModelError, UsageError, first_names, unknown_name
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial import feasible_margins, inertia_matrix, phi_of
from sysid_bench.types import Array

JOINT_KEYS: Final = ("damping", "frictionloss", "armature", "stiffness", "springref")
"""Joint terms in MuJoCo's words: N m s/rad, N m, kg m^2, N m/rad, rad (or N s/m, N, kg, N/m, m)."""

POSSIBLE: Final = 1e-12
"""Share of the largest number of a body; rounding may take a pseudo-inertia this far below zero."""

BodyValue = Array | Sequence[Any]
Bodies = Mapping[str, BodyValue]
Joints = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, eq=False)
class Update:
    """A model and its new values: `phi` (10,) by body name, terms by joint name."""

    robot: RobotModel
    phi: dict[str, Array]
    joints: dict[str, dict[str, float]]


def update_of(
    path: Path, bodies: Bodies, joints: Joints, verdicts: Mapping[str, str] | None
) -> Update:
    """Return the checked update of a model file; raises UsageError for unknown names and invalid
    numbers, ModelError for impossible bodies and parameters that were not identified.

    A body is phi (10,) or (m, com (3,), inertia about it (3, 3) or six numbers).
    """
    _refuse_unidentified(verdicts or {})
    robot = load_robot(Manifest(path.stem, path, couplings=False))
    _check_names("body", bodies, robot.body_names, path)
    _check_names("joint", joints, _scalar_joints(robot), path)
    phi = {name: _phi(name, value) for name, value in bodies.items()}
    terms = {name: _terms(name, values) for name, values in joints.items()}
    _refuse_infeasible(phi)
    return Update(robot, phi, terms)


def _scalar_joints(robot: RobotModel) -> list[str]:
    return [joint.name for joint in robot.joints if joint.kind in ("hinge", "slide")]


def _check_names(kind: str, wanted: Iterable[str], known: Sequence[str], path: Path) -> None:
    for name in wanted:
        if name not in known:
            raise unknown_name(kind, name, known, f"({path.name})")


def _refuse_unidentified(verdicts: Mapping[str, str]) -> None:
    """Raise ModelError, with the first names, for parameters whose verdict is not
    "identifiable"."""
    unidentified = [name for name, verdict in verdicts.items() if verdict != "identifiable"]
    if unidentified:
        raise ModelError(
            f"Not written: {len(unidentified)} of {len(verdicts)} parameters were not identified: "
            f"{first_names(unidentified)}. Use a task that identifies them (link: all joint "
            "torques), or --complete entropic, which takes what the data do not determine from the "
            "bodies nearest to the prior."
        )


def _refuse_infeasible(phi: Mapping[str, Array]) -> None:
    """Raise ModelError, with their names, for bodies whose pseudo-inertia is not positive
    semidefinite."""
    impossible = []
    for name, values in phi.items():
        smallest = float(feasible_margins(values))
        # Negated, so that NaN is refused as well.
        if not smallest >= -POSSIBLE * float(np.abs(values).max()):
            impossible.append(f"{name} (m = {values[0]:.4g} kg, {smallest:.2g})")
    if impossible:
        raise ModelError(
            f"Not written: no body can have the parameters of {', '.join(impossible)}; the "
            "pseudo-inertia must be positive semidefinite: use an estimator with that constraint."
        )


def _phi(name: str, value: BodyValue) -> Array:
    phi = _parsed_phi(value)
    if phi.shape != (10,) or not np.isfinite(phi).all():
        raise UsageError(
            f"The body {name!r} cannot have {value!r}; it needs ten finite numbers "
            "m hx hy hz Ixx Ixy Ixz Iyy Iyz Izz, or (m, com, inertia about it as six numbers or "
            "(3, 3))."
        )
    return phi


def _parsed_phi(value: BodyValue) -> Array:
    """phi (10,) of a value in either form; another shape where it is neither."""
    try:
        return _phi_of_three(*value) if len(value) == 3 else np.array(value, dtype=float)
    except (TypeError, ValueError):
        return np.zeros(0)


def _phi_of_three(mass: float, com: Sequence[float], inertia: Any) -> Array:
    moments, centre = np.asarray(inertia, dtype=float), np.asarray(com, dtype=float)
    if centre.shape != (3,) or moments.shape not in ((6,), (3, 3)):
        raise ValueError("other shapes")
    return phi_of(float(mass), centre, inertia_matrix(moments) if moments.ndim == 1 else moments)


def _terms(name: str, values: Mapping[str, float]) -> dict[str, float]:
    for key, value in values.items():
        _check_term(name, key, value)
    return {key: float(value) for key, value in values.items()}


def _check_term(name: str, key: str, value: float) -> None:
    if key not in JOINT_KEYS:
        raise unknown_name("term of a joint in a file", key, JOINT_KEYS)
    if not np.isfinite(value):
        raise UsageError(f"{key} of the joint {name!r} is {value!r}; it must be finite.")
    if value < 0 and key != "springref":  # the other terms would supply energy
        raise ModelError(
            f"Not written: {key} of the joint {name!r} is {value:.4g}; it must not be negative."
        )
