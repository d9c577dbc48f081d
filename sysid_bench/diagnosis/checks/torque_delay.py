"""Torque channels that are late or early against the positions."""

from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, NOTE, Finding
from sysid_bench.diagnosis.joint_rows import JointRows
from sysid_bench.regressors.joint_features import Play
from sysid_bench.types import Array

LONGEST: Final = 0.15
"""s."""
LAGS: Final = 25
"""Steps to either side."""
SURE: Final = 0.5
"""Share of the mean squared residual that a shift has to remove: friction that is not modelled also
looks like a shift, of a smaller share."""
LONG: Final = 0.045
SHORTEST: Final = 0.022
"""s, of an error and of a note; short shifts are those of filters and drives, and cost little."""
SMOOTH: Final = (0.03, 0.1, 0.3, 1.0)
"""Widths, relative to the RMS rate, over which friction may change its sign."""
WIDTHS: Final = (0.003, 0.01, 0.03)
"""Widths of play as shares of the joint's range."""
GOOD: Final = 0.5
"""Relative residual above which a joint is not explained well enough to be timed."""
BLIND: Final = "all channels late alike, q and v included; joints that friction alone loads"


def torque_delay(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints whose torque fits their own motion better at another time: in both halves of
    the recording alike."""
    own = JointRows(evidence)
    step = max(1, round(LONGEST / LAGS * evidence.rate))
    most = min(LAGS, max(1, round(LONGEST * evidence.rate / step)))
    lags = step * np.arange(-most, most + 1)
    found = [_of_joint(own, j, lags) for j in range(evidence.count) if evidence.rms[j] > 0]
    return [finding for finding in found if finding is not None]


def _of_joint(own: JointRows, j: int, lags: Array) -> Finding | None:
    shifted, rows = own.evidence.torque_with_delay(j, lags, own.rows)
    # Play and smooth friction lag the sign of v: without their columns they would be delays.
    residual = _residuals(np.column_stack([own.columns(j), _friction(own, j)])[rows], shifted)
    whole = residual.sum(axis=0)
    best = int(np.argmin(whole))
    zero = len(lags) // 2
    explains = 1.0 - float(whole[best] / whole[zero]) if whole[zero] > 0 else 0.0
    delay = float(lags[best]) / own.evidence.rate
    size = float((shifted[:, zero] ** 2).sum())
    interior = 0 < best < len(lags) - 1
    good = size > 0 and np.sqrt(whole[best] / size) < GOOD
    halves = [int(np.argmin(part.sum(axis=0))) for part in np.array_split(residual, 2)]
    agree = max(abs(half - best) for half in halves) <= 1 + abs(best - zero) // 3
    if explains < SURE or abs(delay) < SHORTEST or not (interior and good and agree):
        return None
    return _finding(own.evidence, j, delay, explains)


def _friction(own: JointRows, j: int) -> Array:
    """Columns (N, k) of friction that changes its sign smoothly, or late."""
    q, v = own.motion.q[:, j], own.motion.v[:, j]
    scale = float(np.sqrt((v**2).mean())) or 1.0
    reach = (float(q.min()), float(q.max()))
    smooth = [np.tanh(v / (width * scale)) for width in SMOOTH]
    return np.column_stack([*smooth, *(Play(width).values(q, v, reach) for width in WIDTHS)])


def _residuals(X: Array, Y: Array) -> Array:
    """Squared residuals (N, k) of the columns Y (N, k) after a fit by X."""
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    H = X.T @ X + 1e-9 * np.eye(X.shape[1])
    return np.asarray((Y - X @ np.linalg.solve(H, X.T @ Y)) ** 2)


def _finding(evidence: DiagnoseInput, j: int, delay: float, explains: float) -> Finding:
    word = "late" if delay > 0 else "early"
    return Finding(
        name="delay",
        severity=_severity(delay),
        message=(
            f"the torque of {evidence.joints[j]} is {1e3 * abs(delay):.0f} ms {word}: a shift "
            f"explains {100 * explains:.0f} % of its residual"
        ),
        joints=(evidence.joints[j],),
        explains=round(explains, 3),
        confidence=round(explains, 2),
        blind=BLIND,
        edit=f"shift the torque of {evidence.joints[j]} by {-1e3 * delay:.0f} ms in the file",
    )


def _severity(delay: float) -> str:
    """Grade of a shift: torques come late from buses and filters, and early from friction alone."""
    return ERROR if delay >= LONG else NOTE
