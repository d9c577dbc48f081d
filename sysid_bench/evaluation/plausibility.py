"""Plausibility of identified bodies: density and centre of mass compared with their geometry.

Feasible is not plausible: some masses hardly affect the torques, and a feasible fit may give a link
a mass of a tonne.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from sysid_bench.spatial import body_mass_inertia, feasible_margins
from sysid_bench.types import Array, BodyExtents

MAX_DENSITY: Final = 8000.0
"""kg/m^3: density of steel; the bounding box of a link has no higher mean density."""

MASSLESS: Final = 1e-6
"""kg: a lighter body is a frame without mass, and its centre of mass has no meaning."""


def body_plausibility(phi: Array, extent: BodyExtents | None) -> str:
    """Return what is implausible about a body with parameters phi (10,), as text; empty if nothing.

    `extent` is its bounding box in body axes; None leaves the checks of density and centre of mass
    out.
    """
    mass, com, _ = body_mass_inertia(phi)
    # Relative to the largest entry: a point mass has eigenvalues of zero up to rounding.
    if feasible_margins(phi) < -1e-9 * float(np.abs(phi).max()):
        return "it is not physically feasible"
    if mass <= MASSLESS or extent is None:
        return ""
    if mass > MAX_DENSITY * extent.volume:
        return f"{mass:.4g} kg in its {extent.volume:.2g} m^3 is denser than steel"
    outside = np.maximum(extent.low - com, com - extent.high).max()
    if outside > 0:
        return f"its centre of mass lies {outside:.2g} m outside of the link"
    return ""


def plausibility_findings(
    bodies: Mapping[str, Array], extents: Mapping[str, BodyExtents]
) -> dict[str, str]:
    """Return {name: reason} of the implausible ones among bodies {name: phi (10,)}."""
    reasons = {name: body_plausibility(phi, extents.get(name)) for name, phi in bodies.items()}
    return {name: reason for name, reason in reasons.items() if reason}
