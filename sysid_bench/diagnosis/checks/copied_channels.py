"""Channels that hold the numbers of another one."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, Finding
from sysid_bench.signals.log_checks import check_finite
from sysid_bench.types import Array

EXACT: Final = 1e-9
"""1 - |correlation| of a copy: measurements of two things differ by more."""

NEAR: Final = 0.97
"""Correlation of a torque with the acceleration of its joint, found from its positions, above which
it may be that acceleration."""
EQUAL: Final = 0.15
"""Relative difference of the factors of two joints: their inertias differ by more."""


def copied_channels(evidence: DiagnoseInput) -> list[Finding]:
    """Return torques that are multiples of a position, of a velocity or of another torque, and
    positions that are multiples of others; torques that are accelerations."""
    # The samples of the file: on the uniform grid each signal has been interpolated apart.
    raw = evidence.raw.columns(evidence.columns)
    valid = ~check_finite(*raw.signals.values())
    channels = {"position": raw.q[valid], "torque": raw.tau[valid]}
    if raw.v is not None:
        channels["velocity"] = raw.v[valid]
    found = [
        _finding(evidence, pair)
        for kind, other in (("torque", "torque"), ("position", "position"))
        for pair in _copies(kind, other, channels)
    ]
    of_motion = [name for name in ("position", "velocity") if name in channels]
    found += [
        _finding(evidence, pair)
        for other in of_motion
        for pair in _copies("torque", other, channels)
    ]
    return found + _of_acceleration(evidence)


def _of_acceleration(evidence: DiagnoseInput) -> list[Finding]:
    """Return a finding where all torques are their joints' accelerations times one factor, and the
    torques of the model file are not."""
    a, tau = evidence.motion.a, evidence.torque
    moving = (np.ptp(a, axis=0) > 0) & (np.ptp(tau, axis=0) > 0)
    if not moving.any() or not _is_common(a[:, moving], tau[:, moving]):
        return []
    motion, _ = evidence.fit_samples
    model = evidence.regressor(motion) @ evidence.file_parameters.ravel()
    # A model without inertias says nothing, and neither does a single joint then.
    blind = evidence.placeholder != "" and moving.sum() == 1
    if blind or _is_common(motion.a[:, moving], model[:, moving]):
        return []
    return [
        Finding(
            name="copied",
            severity=ERROR,
            message="the torques of all joints are their accelerations times one factor",
            joints=tuple(evidence.joints[j] for j in np.flatnonzero(moving)),
            edit="tau = { columns = [...] }: the columns of measured torques",
        )
    ]


def _is_common(a: Array, tau: Array) -> bool:
    """True where each column of tau (N, k) is that of a (N, k) times the same factor, but for an
    offset."""
    a, tau = a - a.mean(axis=0), tau - tau.mean(axis=0)
    size, product = (a**2).sum(axis=0), (a * tau).sum(axis=0)
    power = size * (tau**2).sum(axis=0)
    if not (power > 0).all():
        return False
    correlation = np.abs(product) / np.sqrt(power)
    factor = product / size
    middle = float(np.median(factor))
    return bool(
        (correlation > NEAR).all() and (np.abs(factor - middle) < EQUAL * abs(middle)).all()
    )


_Pair = tuple[str, int, str, int]


def _copies(kind: str, other: str, channels: dict[str, Array]) -> Iterator[_Pair]:
    """Yield (kind, joint, other kind, other joint) of copies, of equal kinds once."""
    one, two = (_unit(channels[name]) for name in (kind, other))
    near = 1.0 - np.abs(one.T @ two) < EXACT
    for j, k in zip(*np.nonzero(near), strict=True):
        if kind != other or j > k:
            yield kind, int(j), other, int(k)


def _unit(x: Array) -> Array:
    """Columns without their means, of length 1; constant ones are zero."""
    largest = np.abs(x).max(axis=0)
    moves = np.ptp(x, axis=0) > EXACT * largest
    # Squares of numbers below 1e-154 vanish: each column is scaled before its length is taken.
    x = x / np.where(moves, largest, 1.0)
    x = x - x.mean(axis=0)
    size = np.linalg.norm(x, axis=0)
    return np.where(moves, x / np.where(moves, size, 1.0), 0.0)


def _finding(evidence: DiagnoseInput, pair: _Pair) -> Finding:
    """Of two channels of one kind either may be the copy: both joints are named."""
    kind, j, other, k = pair
    return Finding(
        name="copied",
        severity=ERROR,
        message=(
            f"the {kind} of {evidence.joints[j]} is a multiple of the {other} of "
            f"{evidence.joints[k]}: the same column twice"
        ),
        joints=(evidence.joints[j], *([evidence.joints[k]] if kind == other else [])),
        edit=f"{'tau' if kind == 'torque' else 'q'} = {{ columns = [...] }}: one column a joint",
    )
