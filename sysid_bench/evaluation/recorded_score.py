"""Scores of an estimate on recordings, where only the measured torque is known.

The errors are those of simulated experiments (torque_errors.py), over the samples used.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from sysid_bench.evaluation.score import base_parameters, feasible_figures
from sysid_bench.evaluation.torque_errors import (
    RowErrors,
    joint_figures,
    torque_figures,
)
from sysid_bench.types import Array, Estimate, Problem, Score


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """Return {joint: {samples, rms, rmse, relative}} of one problem: RMS torque and RMS error
    (N m, N) for base parameters `beta` (r,)."""
    errors = RowErrors([problem], beta)
    return {
        factor.row: {
            "samples": factor.samples,
            "rms": float(errors.rms[i]),
            "rmse": float(errors.errors[i]),
            "relative": errors.relative_of(i),
        }
        for i, factor in enumerate(problem.factors)
    }


def score_recorded(
    estimate: Estimate,
    problem: Problem,
    tests: Mapping[str, Problem],
    about_data: Mapping[str, Any],
    moving: Mapping[str, Problem] | None = None,
) -> Score:
    """Return the scores of one estimate on recordings, without ground truth.

    `about_data` is the result of `data_figures`. Errors of joints are those of training and of the
    tests; the latter are RMS over all samples of the test recordings. `moving` are the tests
    without rows at standstill (None: not scored).
    """
    beta = base_parameters(estimate)
    if beta is None:
        return Score(**about_data)
    return Score(
        **about_data,
        **feasible_figures(estimate.theta, problem),
        rmse_train=RowErrors([problem], beta).rms_error,
        **torque_figures(tests, moving or {}, beta),
        joints=tuple(_joints(problem, tests, beta)),
    )


def _joints(
    problem: Problem, tests: Mapping[str, Problem], beta: Array
) -> Iterator[dict[str, Any]]:
    """Errors of each joint, relative ones in training too."""
    train = RowErrors([problem], beta)
    for i, joint in enumerate(joint_figures(problem, tests, beta)):
        yield {**joint, "relative_train": train.relative_of(i)}
