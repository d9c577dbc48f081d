"""Finite checks of a compiled model: MuJoCo accepts NaN, infinities and absurd sizes silently."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.errors import ModelError

if TYPE_CHECKING:
    import mujoco

LARGEST: Final = 1e9
"""SI units. No robot is heavier or larger; squares and products of it stay far from overflow."""

LARGEST_TREE: Final = 100_000
"""Bodies times degrees of freedom; Y of 50 states then takes 400 MB."""

LARGEST_TERM: Final = 1e13
"""N m s/rad and the like: public models hold joints still with a damping of 1e11."""

_OF_BODIES: Final = (
    "body_pos", "body_quat", "body_mass", "body_ipos", "body_iquat", "body_inertia"
)  # fmt: skip
_OF_JOINTS: Final = ("jnt_pos", "jnt_axis")
_OF_THE_MODEL: Final = {
    "qpos0": LARGEST, "qpos_spring": LARGEST, "dof_armature": LARGEST, "dof_damping": LARGEST_TERM,
    "dof_frictionloss": LARGEST_TERM, "jnt_stiffness": LARGEST_TERM,
}  # fmt: skip


def check_finite_model(mj: "mujoco.MjModel", name: str) -> None:
    """Raise ModelError, naming the first body or joint, for numbers that are not finite, beyond
    `LARGEST`, or negative where that is impossible."""
    for key in _OF_BODIES:
        _check_bodies(mj, key, _wrong(getattr(mj, key)), name)
    for key in _OF_JOINTS:
        _check_joints(mj, key, name)
    for key in ("body_quat", "body_iquat"):
        _check_unit_length(mj, key, name)
    for key, largest in _OF_THE_MODEL.items():
        _check_largest(mj, key, largest, name)
    for key in ("dof_armature", "dof_damping", "dof_frictionloss"):
        _check_not_negative(mj, key, name)
    if _wrong(mj.opt.gravity[None]):
        raise _error(name, "the model", "gravity", mj.opt.gravity)


def _check_joints(mj: "mujoco.MjModel", key: str, name: str) -> None:
    for j in _wrong(getattr(mj, key)):
        raise _error(name, f"joint {mj.joint(j).name or j!r}", key, getattr(mj, key)[j])


def _check_bodies(mj: "mujoco.MjModel", key: str, wrong: Iterable[int], name: str) -> None:
    """Raise ModelError for the first body of those with a wrong value."""
    for b in map(int, wrong):
        raise _error(name, f"body {mj.body(b).name or b!r}", key, getattr(mj, key)[b])


def _check_unit_length(mj: "mujoco.MjModel", key: str, name: str) -> None:
    # A quaternion that overflows when MuJoCo normalises it becomes zero.
    lengths = np.linalg.norm(getattr(mj, key), axis=1)
    _check_bodies(mj, key, np.flatnonzero(np.abs(lengths - 1) > 1e-6), name)


def _check_largest(mj: "mujoco.MjModel", key: str, largest: float, name: str) -> None:
    for i in _wrong(getattr(mj, key), largest):
        raise _error(name, "the model", f"{key}[{i}]", getattr(mj, key)[i], largest)


def _check_not_negative(mj: "mujoco.MjModel", key: str, name: str) -> None:
    values = np.ravel(getattr(mj, key))
    for i in np.flatnonzero(values < 0).tolist():
        joint = mj.joint(int(mj.dof_jntid[i % mj.nv])).name
        raise ModelError(
            f"{name}: {key.removeprefix('dof_')} of joint {joint!r} is {values[i]:.3g}; it must "
            "not be negative: correct the file."
        )


def _wrong(values: np.ndarray, largest: float = LARGEST) -> list[int]:
    """Indices of rows with a number that is not finite or too large; NaN compares false."""
    good = np.abs(values.reshape(len(values), -1)) <= largest
    return [int(i) for i in np.flatnonzero(~good.all(axis=1))]


def _error(
    name: str, element: str, key: str, value: np.ndarray, largest: float = LARGEST
) -> ModelError:
    return ModelError(
        f"{name}: {key} of {element} is {np.ravel(value).tolist()}; numbers must be finite and at "
        f"most {largest:.0e} in SI units: correct the file."
    )
