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


def copied_channels(evidence: DiagnoseInput) -> list[Finding]:
    """Return torques that are multiples of a position, of a velocity or of another torque, and
    positions that are multiples of others."""
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
    return found


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
    moves = np.ptp(x, axis=0) > EXACT * np.abs(x).max(axis=0)
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
