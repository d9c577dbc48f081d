"""Judgement of an estimate on recordings: against the measured torque, since nothing else is known.

Errors are RMS over the rows used; relative ones are divided by the RMS of the measured torque of
the same rows of the same joint.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sysid_bench.identification.compressed import residual_norms
from sysid_bench.types import Array, Problem


def joint_errors(problem: Problem, beta: Array) -> dict[str, dict[str, Any]]:
    """{joint: samples, rms, rmse, relative} of one problem."""
    told = {}
    for factor, norm in zip(problem.factors, residual_norms(problem, beta), strict=True):
        size = float(np.linalg.norm(factor.R[:, -1]))
        count = max(factor.samples, 1)
        told[factor.row] = {
            "samples": factor.samples,
            "rms": size / count**0.5,
            "rmse": float(norm) / count**0.5,
            "relative": float(norm) / size if size > 0 else None,
        }
    return told


def overall(problem: Problem, beta: Array) -> float:
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
