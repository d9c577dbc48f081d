"""Whether bodies that can exist are such as somebody would build.

Feasible is not plausible: torques hardly feel some masses, and a fit may put a tonne into a link
without breaking a law of physics.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from sysid_bench.spatial.inertia import mass_com_inertia, smallest_eigenvalue
from sysid_bench.types import Array, Extent

MAX_DENSITY: Final = 8000.0
"""kg/m^3, steel: no box around a link is filled with more."""

MASSLESS: Final = 1e-6
"""kg; a lighter body is a frame, whose centre of mass means nothing."""


def body_plausibility(phi: Array, extent: Extent | None) -> str:
    """What is odd about a body phi (10,), in words; empty where nothing is. `extent`: None where it
    is not known."""
    mass, com, _ = mass_com_inertia(phi)
    if smallest_eigenvalue(phi) < -1e-9 * float(np.abs(phi).max()):
        return "it cannot exist"
    if mass <= MASSLESS or extent is None:
        return ""
    if mass > MAX_DENSITY * extent.volume:
        return f"{mass:.4g} kg are more than steel in its {extent.volume:.2g} m^3"
    out = np.maximum(extent.low - com, com - extent.high).max()
    if out > 0:
        return f"its centre of mass lies {out:.2g} m outside of the link"
    return ""


def plausibility_findings(
    bodies: Mapping[str, Array], extents: Mapping[str, Extent]
) -> dict[str, str]:
    """{body: what is odd} of bodies {name: phi (10,)}, odd ones alone."""
    found = {name: body_plausibility(phi, extents.get(name)) for name, phi in bodies.items()}
    return {name: said for name, said in found.items() if said}
