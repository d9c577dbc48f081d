"""Judgement of an estimate on recordings: against the measured torque, since nothing else is known.

Errors are RMS over the rows used; relative ones are divided by the RMS of the measured torque of
the same rows of the same joint.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid_bench.identification.linear.normal_qr import residual_norms
from sysid_bench.spatial.inertia import smallest_eigenvalue
from sysid_bench.types import Array, Estimate, Problem, Score


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """{joint: samples, rms, rmse, relative} of one problem."""
    told = {}
    norms = residual_norms(problem, beta)
    for i, (factor, norm) in enumerate(zip(problem.factors, norms, strict=True)):
        count = max(factor.samples, 1)
        size = float(np.linalg.norm(factor.R[:, -1]))
        if problem.torque is not None:  # what is known of it included
            size = float(problem.torque[i]) * count**0.5
        told[factor.row] = {
            "samples": factor.samples,
            "rms": size / count**0.5,
            "rmse": float(norm) / count**0.5,
            "relative": float(norm) / size if size > 0 else None,
        }
    return told


def pooled_error(problem: Problem, beta: Array) -> float:
    """RMSE (N m, N) of all joints alike."""
    return float(np.sqrt(np.mean([e["rmse"] ** 2 for e in joint_errors(problem, beta).values()])))


def torque_error(tests: Mapping[str, Problem], beta: Array) -> float | None:
    """RMS of the joints' relative errors over all test recordings; None without any."""
    relative = [
        told["relative"]
        for test in tests.values()
        for told in joint_errors(test, beta).values()
        if told["relative"] is not None
    ]
    return float(np.sqrt(np.mean(np.square(relative)))) if relative else None


def score_recorded(
    estimate: Estimate,
    problem: Problem,
    tests: Mapping[str, Problem],
    about_data: Mapping[str, Any],
) -> Score:
    """The figures of one estimate that need no truth; `about_data` as `data_figures` gives it.

    Joints: rmse and relative errors of the tests (in RMS where there are several), and of training.
    """
    if estimate.status != "ok" or estimate.beta is None:
        return Score(**about_data)
    beta = estimate.beta
    held_out = [joint_errors(test, beta) for test in tests.values()]
    joints = [
        _joint(name, own, [table[name] for table in held_out])
        for name, own in joint_errors(problem, beta).items()
    ]
    worst = [joint["relative"] for joint in joints if joint["relative"] is not None]
    return Score(
        **about_data,
        **eigenvalues(estimate, problem),
        rmse_train=pooled_error(problem, beta),
        rmse_test=_rms([pooled_error(test, beta) for test in tests.values()]),
        torque_error=torque_error(tests, beta),
        torque_error_worst=max(worst, default=None) if tests else None,
        torque_error_by_motion={n: torque_error({n: test}, beta) for n, test in tests.items()},
        joints=tuple(joints),
    )


def eigenvalues(estimate: Estimate, problem: Problem) -> dict[str, Any]:
    """Whether every body can exist: {} where the method does not claim whole bodies."""
    if estimate.theta is None or not problem.bodies:
        return {}
    places = {name: i for i, name in enumerate(problem.parameters)}
    phi = np.array([[estimate.theta[places[c]] for c in body.columns] for body in problem.bodies])
    smallest = smallest_eigenvalue(phi)
    scale = np.abs(phi).max(axis=1)
    return {
        "min_eigenvalue": float(smallest.min()),
        "feasible": bool((smallest >= -1e-9 * scale).all()),
    }


def _joint(name: str, own: Mapping[str, Any], tests: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    relative = [test["relative"] for test in tests if test["relative"] is not None]
    return {
        "name": name,
        "rmse_train": own["rmse"],
        "relative_train": own["relative"],
        "rmse_test": _rms([test["rmse"] for test in tests]),
        "rms": _rms([test["rms"] for test in tests]),
        "relative": _rms(relative),
        "small": False,
    }


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
