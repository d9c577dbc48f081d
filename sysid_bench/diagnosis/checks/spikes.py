"""Single samples far from their neighbours."""

from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import WARNING, Finding
from sysid_bench.types import Array

WINDOW: Final = 5
SCALES: Final = 8.0
"""Median absolute deviations from the running median (Hampel)."""
RANGE: Final = 0.7
"""Least height in units of the channel's range between its 5 % and 95 % quantiles."""
MOST: Final = 0.02
"""Share of the samples above which they are noise, not spikes."""


def spikes(evidence: DiagnoseInput) -> list[Finding]:
    """Return joints whose torques or positions hold spikes, with the first rows."""
    raw = evidence.raw
    found = []
    for word, x in (("torque", raw.tau), ("position", raw.q)):
        rows = [_spike_rows(x[:, c]) for c in evidence.columns]
        hit = [j for j, spiked in enumerate(rows) if len(spiked)]
        if hit:
            found.append(_finding(evidence, word, hit, [rows[j] for j in hit]))
    return found


def _spike_rows(x: Array) -> Array:
    """Return the rows of a channel (N,) that are far from the median of their neighbours."""
    valid = np.where(np.isfinite(x), x, np.nanmedian(x))
    half = WINDOW // 2
    padded = np.pad(valid, half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, WINDOW)
    distance = np.abs(valid - np.median(windows, axis=1))
    scale = SCALES * 1.4826 * float(np.median(distance))
    low, high = np.quantile(valid, [0.05, 0.95])
    height = max(scale, RANGE * float(high - low))
    rows = np.flatnonzero((distance > height) & (_peaks(valid) > height))
    return rows if high > low and len(rows) <= MOST * len(x) else rows[:0]


def _peaks(x: Array) -> Array:
    """Height (N,) of each sample above both neighbours, or depth below both; 0 on slopes."""
    steps = np.diff(x, prepend=x[:1], append=x[-1:])
    up, down = steps[:-1], -steps[1:]
    return np.where(up * down > 0, np.minimum(np.abs(up), np.abs(down)), 0.0)


def _finding(evidence: DiagnoseInput, word: str, joints: list[int], rows: list[Array]) -> Finding:
    names = tuple(evidence.joints[j] for j in joints)
    count = sum(map(len, rows))
    first = ", ".join(str(int(row) + 1) for row in rows[0][:3])
    return Finding(
        name="spikes",
        severity=WARNING,
        message=(
            f"{count} spikes in the {word} of {', '.join(names)}, the first in samples {first}"
        ),
        joints=names,
        edit="remove these rows from the file, or use an estimator that is robust: huber",
        blind="spikes of several samples",
    )
