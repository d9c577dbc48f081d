"""Confidence intervals against the values that they should hold, and prediction intervals.

Each parameter is an inertial one or one of friction, by the pivot of its combination. Inertial ones
are judged by their true values. Friction that the model does not contain has no true value in it:
its target is then the pseudo-true one, to which estimates from ever more motions converge (White
1982).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.covariance import MotionFit
from sysid_bench.evaluation.intervals import StandardError, held, interval_score
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.models.robot import SUFFIX
from sysid_bench.types import Array, Problem

INERTIAL, FRICTION = "inertial", "friction"
CLASSES: Final = (INERTIAL, FRICTION)


@dataclass(frozen=True, eq=False)
class TrueValues:
    """Values (r,) that intervals should hold, the class of each parameter, and `friction`: "true",
    or how the values of friction were found."""

    values: Array
    classes: Array
    friction: str


def true_values(problem: Problem, true: Array, pseudo_true: Array | None, how: str) -> TrueValues:
    """Return the targets (r,): true values, those of friction from `pseudo_true` unless None."""
    # The class (r,) of each base parameter: inertias of links and rotors are inertial, all other
    # terms of joints are friction
    bodies = {column for body in problem.bodies for column in body.columns}
    rotor = f".{SUFFIX['armature']}"
    names = [problem.parameters[pivot] for pivot in problem.base.pivots]
    classes = np.array([INERTIAL if n in bodies or n.endswith(rotor) else FRICTION for n in names])
    if pseudo_true is None:
        return TrueValues(true, classes, "true")
    return TrueValues(np.where(classes == FRICTION, pseudo_true, true), classes, how)


def interval_fields(
    problem: Problem, beta: Array, errors: Mapping[str, StandardError], targets: TrueValues
) -> dict[str, Any]:
    """Return `coverage_<class>`, `width_<class>` and `interval_score_<class>` by kind of interval,
    means over the parameters of a class; widths and scores as shares of the torque."""
    R = stacked_factor(problem)
    size = np.linalg.norm(R, axis=0)
    # RMS torque of a unit of each parameter over the whole one: makes widths in kg and kg m^2
    # comparable.
    shares = np.asarray(size[:-1] / size[-1]) if size[-1] > 0 else np.zeros(len(size) - 1)
    fields: dict[str, Any] = {"friction_target": targets.friction}
    for one in CLASSES:
        chosen = targets.classes == one
        if not chosen.any():
            continue
        for kind, error in errors.items():
            score = interval_score(error, beta, targets.values)
            values = {
                "coverage": held(error, beta, targets.values),
                "width": 2 * error.margins() * shares,
                "interval_score": score * shares,
            }
            for name, value in values.items():
                fields.setdefault(f"{name}_{one}", {})[kind] = float(value[chosen].mean())
    return fields


def torque_coverage(fits: MotionFit, held_out: Mapping[str, Problem]) -> Array:
    """Return the share (rows,) of held-out torques inside of their prediction interval."""
    half_width = fits.torque_margins()
    inside, samples = np.zeros(len(half_width)), 0
    for problem in held_out.values():
        for Y, b in problem.blocks():
            inside += (np.abs(b - Y @ fits.beta) <= half_width).sum(axis=0)
            samples += len(b)
    return inside / max(samples, 1)
