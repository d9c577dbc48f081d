"""Scores of an estimate on recordings, where only the measured torque is known.

Errors are RMS over the samples used; relative errors are divided by the RMS measured torque of the
same joint over the same samples.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid_bench.identification.linear.normal_qr import residual_norms
from sysid_bench.spatial.inertia import smallest_eigenvalue
from sysid_bench.types import Array, Estimate, Problem, Score


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """Return {joint: {samples, rms, rmse, relative}} of one problem: RMS torque and RMS error
    (N m, N) for base parameters `beta` (r,)."""
    errors = {}
    norms = residual_norms(problem, beta)
    for i, (factor, norm) in enumerate(zip(problem.factors, norms, strict=True)):
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
    relative = [
        errors["relative"]
        for test in tests.values()
        for errors in joint_errors(test, beta).values()
        if errors["relative"] is not None
    ]
    return float(np.sqrt(np.mean(np.square(relative)))) if relative else None


def score_recorded(
    estimate: Estimate,
    problem: Problem,
    tests: Mapping[str, Problem],
    about_data: Mapping[str, Any],
) -> Score:
    """Return the scores of one estimate on recordings, without ground truth.

    `about_data` is the result of `data_figures`. Errors of joints are those of training and of the
    tests; the latter are RMS over the test recordings.
    """
    if estimate.status != "ok" or estimate.beta is None:
        return Score(**about_data)
    beta = estimate.beta
    held_out = [joint_errors(test, beta) for test in tests.values()]
    joints = [
        _joint(name, train, [table[name] for table in held_out])
        for name, train in joint_errors(problem, beta).items()
    ]
    worst = [joint["relative"] for joint in joints if joint["relative"] is not None]
    return Score(
        **about_data,
        **eigenvalues(estimate, problem),
        rmse_train=rms_error(problem, beta),
        rmse_test=_rms([rms_error(test, beta) for test in tests.values()]),
        torque_error=torque_error(tests, beta),
        torque_error_worst=max(worst, default=None) if tests else None,
        torque_error_by_motion={n: torque_error({n: test}, beta) for n, test in tests.items()},
        joints=tuple(joints),
    )


def eigenvalues(estimate: Estimate, problem: Problem) -> dict[str, Any]:
    """Return the smallest pseudo-inertia eigenvalue of all bodies and whether all are feasible; {}
    if the method does not estimate all parameters of bodies."""
    if estimate.theta is None or not problem.bodies:
        return {}
    index = {name: i for i, name in enumerate(problem.parameters)}
    phi = np.array([[estimate.theta[index[c]] for c in body.columns] for body in problem.bodies])
    smallest = smallest_eigenvalue(phi)
    scale = np.abs(phi).max(axis=1)
    return {
        "min_eigenvalue": float(smallest.min()),
        "feasible": bool((smallest >= -1e-9 * scale).all()),
    }


def _joint(
    name: str, train: Mapping[str, Any], tests: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    relative = [test["relative"] for test in tests if test["relative"] is not None]
    return {
        "name": name,
        "rmse_train": train["rmse"],
        "relative_train": train["relative"],
        "rmse_test": _rms([test["rmse"] for test in tests]),
        "rms": _rms([test["rms"] for test in tests]),
        "relative": _rms(relative),
        "small": False,
    }


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
