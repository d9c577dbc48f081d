"""A load at the tool that the model lacks."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.diagnosis.finding import WARNING
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.evaluation.intervals import coverage_factor, level_text
from sysid_bench.models.model_checks import length
from sysid_bench.types import Array

LEAST: Final = 0.5
"""Least share of the cost that a load removes: ten more unknowns explain a part of any residual."""
FARTHEST: Final = 0.5
"""Distance of a load's centre of mass from the body that carries it, and radius of gyration, as
shares of the robot's length, above which it is none."""
BLIND: Final = "a last link much heavier than in the model file looks alike"


def tool_load(before: Hypothesis) -> Iterator[Candidate]:
    """Yield the candidate with ten unknown inertial parameters at the tool, where these are those
    of a body: of positive mass, and not far larger than the robot."""
    e = before.evidence
    if e.loaded or e.placeholder or e.robot.tree.carrier[e.robot.tool_body] < 0:
        return
    loaded = replace(before, evidence=replace(e, loaded=True), given=None)
    phi = loaded.fit.links[-10:]
    explains = 1.0 - loaded.fit.cost / before.fit.cost
    if explains < LEAST or not _is_body(phi, FARTHEST * length(e.robot)):
        return
    mass = float(phi[0])
    deviation = loaded.model.deviation(loaded.mixing, len(loaded.fit.links) - 10)
    half = round(coverage_factor(np.inf), 2) * deviation
    body = e.robot.body_names[e.robot.tool_body]
    yield Candidate(
        name="load",
        joints=tuple(range(e.count)),
        hypothesis=loaded,
        message=f"a load at {body} that the model lacks explains the torque: {mass:.3g} kg "
        f"({level_text()} in [{max(mass - half, 0.0):.3g}, {mass + half:.3g}], as far as the "
        "masses of the links are known)",
        edit=f"payload = {{ mass = {mass:.3g} }}, with its com and inertia, if that was mounted; "
        "identify finds it with the task payload",
        blind=BLIND,
        most=WARNING,
    )


def _is_body(phi: Array, size: float) -> bool:
    """True for parameters (10,) of a positive mass whose centre and extent lie within a size (m):
    inertias that the motion hardly excites may have any sign."""
    mass = phi[0]
    turning = 0.5 * abs(phi[4] + phi[7] + phi[9])
    return bool(mass > 0 and np.linalg.norm(phi[1:4]) <= size * mass and turning <= size**2 * mass)
