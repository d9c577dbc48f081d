"""Scores of an estimate on recordings, where only the measured torque is known.

Errors are RMS over the samples used; relative errors are divided by the RMS measured torque of the
same joint over the same samples.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid_bench.evaluation.rms import known_rms
from sysid_bench.evaluation.score import RowErrors, base_parameters, feasible_figures
from sysid_bench.identification.linear.normal_qr import residual_norm
from sysid_bench.types import Array, Estimate, Problem, Score


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """Return {joint: {samples, rms, rmse, relative}} of one problem: RMS torque and RMS error
    (N m, N) for base parameters `beta` (r,)."""
    errors = {}
    norms = residual_norm(problem, beta)
    for i, (factor, norm) in enumerate(zip(problem.factors, norms, strict=True)):
        # Joints differ in their samples: those at which one stands still are left out.
        count = max(factor.samples, 1)
        size = float(np.linalg.norm(factor.R[:, -1]))
        # The factor has the torque minus known contributions; problem.torque includes them.
        if problem.torque is not None:
            size = float(problem.torque[i]) * count**0.5
        errors[factor.row] = {
            "samples": factor.samples,
            "rms": size / count**0.5,
            "rmse": float(norm) / count**0.5,
            "relative": float(norm) / size if size > 0 else None,
        }
    return errors


def rms_error(problem: Problem, beta: Array) -> float:
    """Return the RMSE (N m, N) over all joints with equal weight."""
    return float(np.sqrt(np.mean([e["rmse"] ** 2 for e in joint_errors(problem, beta).values()])))


def torque_error(tests: Mapping[str, Problem], beta: Array) -> float | None:
    """Return the RMS of the joints' relative errors over all test recordings; None without any."""
    return known_rms(
        errors["relative"]
        for test in tests.values()
        for errors in joint_errors(test, beta).values()
    )


def weighted_error(tests: Mapping[str, Problem], beta: Array) -> float | None:
    """Return the error over all test recordings with joints weighted by their RMS torque; None
    without any."""
    return RowErrors(list(tests.values()), beta).weighted if tests else None


def score_recorded(
    estimate: Estimate,
    problem: Problem,
    tests: Mapping[str, Problem],
    about_data: Mapping[str, Any],
    moving: Mapping[str, Problem] | None = None,
) -> Score:
    """Return the scores of one estimate on recordings, without ground truth.

    `about_data` is the result of `data_figures`. Errors of joints are those of training and of the
    tests; the latter are RMS over the test recordings. `moving` are the tests without rows at
    standstill (None: not scored).
    """
    beta = base_parameters(estimate)
    if beta is None:
        return Score(**about_data)
    joints = _joints(problem, tests, beta)
    return Score(
        **about_data,
        **feasible_figures(estimate.theta, problem),
        rmse_train=rms_error(problem, beta),
        rmse_test=known_rms(rms_error(test, beta) for test in tests.values()),
        torque_error=torque_error(tests, beta),
        torque_error_moving=torque_error(moving or {}, beta),
        torque_error_weighted=weighted_error(tests, beta),
        torque_error_worst=_worst(joints),
        torque_error_by_motion={n: torque_error({n: test}, beta) for n, test in tests.items()},
        joints=joints,
    )


def _joints(
    problem: Problem, tests: Mapping[str, Problem], beta: Array
) -> tuple[dict[str, Any], ...]:
    """Errors of each joint, in training and over all test recordings."""
    held_out = [joint_errors(test, beta) for test in tests.values()]
    return tuple(
        _joint(name, train, [table[name] for table in held_out])
        for name, train in joint_errors(problem, beta).items()
    )


def _joint(
    name: str, train: Mapping[str, Any], tests: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    return {
        "name": name,
        "rmse_train": train["rmse"],
        "relative_train": train["relative"],
        "rmse_test": known_rms(test["rmse"] for test in tests),
        "rms": known_rms(test["rms"] for test in tests),
        "relative": known_rms(test["relative"] for test in tests),
        "small": False,
    }


def _worst(joints: Sequence[Mapping[str, Any]]) -> float | None:
    """Largest relative error of a joint on the tests; None without tests."""
    relative = [joint["relative"] for joint in joints if joint["relative"] is not None]
    return max(relative, default=None)
