"""Bodies without thickness: MuJoCo's own reading of their full inertia may round it to the wrong
side of what can exist, so that principal moments and their axes are written instead."""

from typing import Final

import numpy as np

from sysid_bench.types import Array

LAMINA: Final = 1e-9
"""Of the trace: below it a principal moment of the density is none."""


def is_lamina(inertia: Array) -> bool:
    """Whether an inertia (3, 3) about the centre of mass is that of a body without thickness."""
    density = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return bool(density[0] <= LAMINA * np.trace(inertia))


def principal(inertia: Array) -> tuple[Array, Array]:
    """Moments (3,) that can exist, the largest first as MuJoCo sorts them (it would round them while
    turning), and the rotation R (3, 3) of their axes into the body's."""
    moments, axes = np.linalg.eigh(inertia)
    moments, axes = np.maximum(moments[::-1], 0.0), axes[:, ::-1]
    moments[0] = min(moments[0], moments[1] + moments[2])  # a lamina lies on the border
    return moments, axes * np.sign(np.linalg.det(axes))
