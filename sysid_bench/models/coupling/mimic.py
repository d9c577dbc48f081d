"""Mimic joints of a URDF as joint equalities, which are then read like those of an MJCF."""

from collections.abc import Iterator, Sequence

import mujoco

from sysid_bench.models.tree import HINGE, SLIDE
from sysid_bench.models.urdf.canonical_urdf import Mimic


def mimic_equalities(spec: mujoco.MjSpec, mimics: Sequence[Mimic]) -> Iterator[str]:
    """Add an equality for each mimic joint q = multiplier * q_driver + offset; yield, in words,
    those whose driver does not move."""
    moving = {joint.name for joint in spec.joints if int(joint.type) in (HINGE, SLIDE)}
    for mimic in (mimic for mimic in mimics if mimic.joint in moving):
        if mimic.driver in moving - {mimic.joint}:
            _add_equality(spec, mimic)
        else:
            yield (
                f"joint {mimic.joint!r} treated as independent: it mimics {mimic.driver!r}, which "
                "is not another hinge or slide of the robot"
            )


def _add_equality(spec: mujoco.MjSpec, mimic: Mimic) -> None:
    equality = spec.add_equality(name=f"mimic of {mimic.joint}")
    equality.type = mujoco.mjtEq.mjEQ_JOINT
    equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equality.name1, equality.name2 = mimic.joint, mimic.driver
    # Coefficients of the driver's position in ascending order, up to the fourth power.
    equality.data[:5] = [mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]
