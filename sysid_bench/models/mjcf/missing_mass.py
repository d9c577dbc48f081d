"""Bodies of an MJCF that move and have no mass or no inertia: given a small one, as in a URDF.

MuJoCo compiles no such file, since the mass matrix would be singular; Pinocchio reads it.
"""

import re
from collections.abc import Iterator
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.mujoco_warnings import recorded_warnings
from sysid_bench.models.urdf.inertia_repair import MASSLESS, TINY_MASS, TINY_MOMENT, point_inertia

_LIGHT: Final = re.compile(r"mjMINVAL.*?\bid (\d+)", re.DOTALL)
"""MuJoCo's error for such a body, with its number."""


def add_mass(spec: mujoco.MjSpec, name: str) -> tuple[str, ...]:
    """Give the bodies that MuJoCo refuses as too light a small mass and inertia, in place; return
    this in words.

    Raises ModelError, with the file's `name`, where no body that moves has a mass: the file
    describes no dynamics.
    """
    mended = dict(_light_bodies(spec))
    if mended and not _weighs(spec, [*mended]):
        raise ModelError(
            f"{name} is not a model of dynamics: no body that moves has a mass; use a file with "
            "<inertial> elements, or with shapes that have a density."
        )
    return tuple(mended.values())


def _light_bodies(spec: mujoco.MjSpec) -> Iterator[tuple[int, str]]:
    """Mend one body after the other until MuJoCo names no other; yield its number, and words."""
    # Before the first compilation: after one that has failed a spec does not list its shapes.
    known = {0, *(b for b, body in enumerate(spec.bodies) if not _may_be_mended(body))}
    while (b := _light_body(spec)) not in known:
        known.add(b)
        yield b, _mend(spec.bodies[b])


def _light_body(spec: mujoco.MjSpec) -> int:
    """Number of a body that is too light for MuJoCo, 0 for none."""
    try:
        with recorded_warnings():
            spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        found = _LIGHT.search(str(error))
        return int(found[1]) if found else 0  # other errors are reported by who compiles next
    return 0


def _may_be_mended(body: mujoco.MjsBody) -> bool:
    """True for a body of no mass, and for a point mass; numbers that cannot be stay as they are,
    for MuJoCo to refuse."""
    if not body.explicitinertial:
        return not any(geom.mass < 0 or geom.density < 0 for geom in body.geoms)
    moments = np.concatenate([body.inertia, body.fullinertia[~np.isnan(body.fullinertia)]])
    has_moments = bool(moments.min() < 0) or (body.mass >= MASSLESS and bool(moments.any()))
    return bool(body.mass >= 0) and not has_moments


def _mend(body: mujoco.MjsBody) -> str:
    mass = float(body.mass) if body.explicitinertial else 0.0
    label = f"{body.name!r}" if body.name else "(unnamed)"
    if mass >= MASSLESS:
        moment = point_inertia(mass)
        words = f"point mass of body {label} given the inertia {moment:.2g} kg m^2"
    else:
        mass, moment = TINY_MASS, TINY_MOMENT
        words = f"massless moving body {label} given {TINY_MASS:.0e} kg"
        body.ipos = np.zeros(3)
    body.explicitinertial, body.mass = True, mass
    body.inertia, body.fullinertia = np.full(3, moment), np.full(6, np.nan)
    return words


def _weighs(spec: mujoco.MjSpec, mended: list[int]) -> bool:
    """True where a body that moves has a mass of the file."""
    if any(spec.bodies[b].mass != TINY_MASS for b in mended):
        return True
    try:
        with recorded_warnings():
            mj = spec.compile()
    except (ValueError, mujoco.FatalError):
        return True
    masses = np.where(mj.body_weldid > 0, mj.body_mass, 0.0)
    return bool(np.delete(masses, mended).max(initial=0.0) > MASSLESS)
