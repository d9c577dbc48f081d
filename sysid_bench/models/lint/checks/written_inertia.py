"""Inertias as a URDF writes them, before any repair: those that no body can have."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import numpy as np

from sysid_bench.models.lint.finding import LintFinding
from sysid_bench.models.lint.lint_input import LintInput
from sysid_bench.models.urdf.inertia_repair import element_inertia, is_feasible, nearest_feasible
from sysid_bench.spatial import inertia_matrix, matrix_of_quaternion, urdf_quaternion
from sysid_bench.types import Array

ROUNDED: Final = 1e-3
"""Share of the largest moment by which printed digits may break the triangle inequality."""

GROSS: Final = 0.1
"""Share of a joint's inertia from which on its change by the repair is an error: less is within
what the masses of a model are known to."""

SEEN: Final = 0.005
"""The same from which on it is printed."""

ZERO: Final = 1e-12
"""kg m^2; smaller moments are zeros that were computed, and the link is a point mass."""


def written_inertia(model: LintInput) -> Iterator[LintFinding]:
    """Inertias with a negative moment, or with one moment larger than the sum of the others: an
    error where the engines, which repair or take them, differ in what a joint feels."""
    for link in model.root.findall("link"):
        inertial = link.find("inertial")
        inertia = None if inertial is None else inertial.find("inertia")
        if inertial is None or inertia is None:
            continue
        name = str(link.get("name"))
        with suppress(ValueError, TypeError):  # the reader has its own words for such numbers
            six = element_inertia(inertia)
            if np.abs(six).max() > ZERO and not is_feasible(six, inertial):
                yield _finding(name, six, _effect(model, name, inertial, six))


def _effect(model: LintInput, name: str, inertial: ET.Element, six: Array) -> float:
    """Largest change of a joint's inertia by the repair of a link, over that inertia, at the
    reference position."""
    if name not in model.robot.body_names:
        return 0.0
    written, origin = inertia_matrix(six), inertial.find("origin")
    rpy = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
    R = matrix_of_quaternion(urdf_quaternion(np.array(rpy.split(), float)))
    axes = R.T @ model.joint_axes(model.robot.body_names.index(name) + 1)
    change = np.einsum("ij,ik,kj->j", axes, nearest_feasible(written) - written, axes)
    return float(np.abs(change / model.joint_inertia).max(initial=0.0))


def _finding(name: str, six: Array, effect: float) -> LintFinding:
    moments = np.linalg.eigvalsh(inertia_matrix(six))
    excess = max(moments[2] - moments[0] - moments[1], -moments[0]) / np.abs(moments).max()
    shown = ", ".join(f"{moment:.4g}" for moment in moments)
    felt = f"; its repair changes the inertia of a joint by {effect:.0%}"
    return LintFinding(
        rule="impossible-inertia",
        severity="error" if effect > GROSS else "warning",
        element=name,
        message=f"no body has the principal moments {shown} kg m^2"
        + (" (by rounding)" if excess <= ROUNDED else felt if effect > SEEN else ""),
        advice="moments are positive, and none exceeds the sum of the others",
    )
