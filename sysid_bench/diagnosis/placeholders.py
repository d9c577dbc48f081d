"""Recognition of inertias that a model file states without having been measured or computed."""

from collections import Counter
from typing import Final

import numpy as np

from sysid_bench.spatial.inertia import mass_com_inertia
from sysid_bench.types import Array

ALIKE: Final = 3
"""Links of the same mass and inertia from which these are placeholders."""
MASSLESS: Final = 1e-5
"""kg."""
SHARE: Final = 0.5
"""Share of the links without mass above which the file states none."""


def placeholder_reason(theta: Array) -> str:
    """Return why link parameters theta (k, 10) are placeholders; empty where they are not."""
    masses = theta[:, 0]
    if (masses <= MASSLESS).mean() >= SHARE:
        return f"{int((masses <= MASSLESS).sum())} of {len(masses)} links have no mass"
    inertias = [mass_com_inertia(phi)[2] for phi in theta if phi[0] > MASSLESS]
    if any(np.allclose(inertia, np.eye(3)) for inertia in inertias):
        return "an inertia is the identity matrix"
    keys = Counter(_key(phi) for phi in theta if phi[0] > MASSLESS)
    key, count = max(keys.items(), key=lambda item: item[1], default=((0.0,), 0))
    if count >= max(ALIKE, SHARE * len(theta)):
        return f"{count} links have the same mass, {key[0]:.4g} kg, and the same inertia"
    return ""


def _key(phi: Array) -> tuple[float, ...]:
    """Mass and principal inertias, rounded: placeholders keep them whatever the frame."""
    mass, _, inertia = mass_com_inertia(phi)
    values = np.linalg.eigvalsh(inertia)
    return tuple(float(f"{x:.4g}") for x in (mass, *values))
