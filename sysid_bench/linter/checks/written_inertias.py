"""Inertias as a URDF writes them, before any repair: those that no body can have."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import numpy as np

from sysid_bench.linter.finding import LintFinding
from sysid_bench.linter.inspected import Inspected
from sysid_bench.models.urdf.inertia_repair import is_possible, six_of
from sysid_bench.spatial.inertia import inertia_matrix
from sysid_bench.types import Array

ROUNDED: Final = 1e-3
"""Share of the largest moment by which printed digits may break the triangle inequality."""

GROSS: Final = 0.05
"""The same from which on an inertia is an error, on a link that weighs."""

LIGHT: Final = 0.01
"""Share of the moving mass below which a link weighs nothing to speak of."""

ZERO: Final = 1e-12
"""kg m^2; smaller moments are zeros that were computed, and the link is a point mass."""


def written_inertias(model: Inspected) -> Iterator[LintFinding]:
    """Inertias with a negative moment, or with one moment larger than the sum of the others: an
    error where that is gross and on a moving link that weighs, since the engines repair, or take,
    what differs little."""
    whole = sum(model.bodies[i].mass for i in model.moving)
    heavy = {model.bodies[i].name for i in model.moving if model.bodies[i].mass >= LIGHT * whole}
    for link in model.root.findall("link"):
        inertial = link.find("inertial")
        inertia = None if inertial is None else inertial.find("inertia")
        if inertial is None or inertia is None:
            continue
        name = str(link.get("name"))
        with suppress(ValueError, TypeError):  # the reader has its own words for such numbers
            six = six_of(inertia)
            if np.abs(six).max() > ZERO and not is_possible(six, inertial):
                yield _finding(name, six, name in heavy)


def _finding(name: str, six: Array, is_heavy: bool) -> LintFinding:
    moments = np.linalg.eigvalsh(inertia_matrix(six))
    excess = max(moments[2] - moments[0] - moments[1], -moments[0]) / np.abs(moments).max()
    shown = ", ".join(f"{moment:.4g}" for moment in moments)
    return LintFinding(
        rule="impossible-inertia",
        severity="error" if excess > GROSS and is_heavy else "warning",
        element=name,
        message=f"no body has the principal moments {shown} kg m^2"
        + (" (by rounding)" if excess <= ROUNDED else ""),
        advice="moments are positive, and none exceeds the sum of the others",
    )
