"""Checks of single channels, without a model of the robot: what the reader found, constant, copied,
held and clipped channels, and spikes."""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, NOTE, WARNING, Finding
from sysid_bench.errors import count_text
from sysid_bench.signals.log_checks import check_finite
from sysid_bench.types import Array

MANY: Final = 0.02
"""Share of the samples from which a defect that the reader found is a warning; fewer are noted."""
ADVICE: Final = {
    "rate": "correct rate, or the unit of time",
    "velocity": (
        "correct the columns, the unit or the ratio of v, or of q; or leave v out: rates are then "
        "differences of q"
    ),
    "units": "correct unit, gain, ratio or offset",
    "held": "correct rate to that of the data, or record faster",
    "lost": "give time = the column of stamps",
    "non-finite": "rows = [first, last] without the damaged part",
    "time": "correct the column or the unit of time, or state rate in its place",
    "delay": "state tau.pd.delay",
    "limits": "correct q.offset, or the limits of the model",
}

LOW: Final = 0.1
HIGH: Final = 0.5
"""Shares of the RMS torque that one without sign comes down to, and rises to in between."""

TURN: Final = 2 * np.pi
JUMP: Final = 0.25
"""Least distance of a joint's other steps from a turn, as a share of it: wrapped positions jump by
a turn less the motion of one sample."""

EXACT: Final = 1e-9
"""1 - |correlation| of a copy: measurements of two things differ by more."""
REVERSALS: Final = 2
"""Changes of the sign of a velocity from which it is not correlated with its own position."""
NEAR: Final = 0.97
"""Correlation of a torque with the acceleration of its joint, found from its positions, above which
it may be that acceleration."""
LEAST: Final = 0.5
MANY_JOINTS: Final = 4
"""The least correlation where as many joints have the same factor: noise in the accelerations of
both lowers it, and equal factors are no chance."""
EQUAL: Final = 0.15
MOST_JOINTS: Final = 0.75
"""Relative difference of the factors of two joints: their inertias differ by more. Share of many
joints that have one factor: noise of encoders may hide that of some."""

NOTHING_ELSE: Final = 0.9
"""Share of a channel's squares in its spikes from which all fits are those of the spikes."""
WINDOW: Final = 5
SCALES: Final = 8.0
"""Median absolute deviations from the running median (Hampel) of a spike."""
RANGE: Final = 0.7
"""Least height of a spike in units of the channel's range between its 5 % and 95 % quantiles."""
MOST: Final = 0.02
"""Share of the samples above which they are noise, not spikes."""

SLOW: Final = 3.0
"""Median run of equal values above which a channel is held: drives update every cycle, and
quantised ones repeat a value now and then."""
LEVELS: Final = 40
"""Distinct values below which a channel is coarse rather than held."""

CLIPPED: Final = 0.01
"""Share of the samples at one extreme from which a channel is clipped."""
COARSE: Final = 20
"""Values between the extremes below which a channel is coarse rather than clipped."""


def recorded_findings(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield the findings made while the recording was read: units, rate, velocities, held, lost and
    invalid samples, limits."""
    for one in evidence.log.findings:
        few = one.name in ("limits", "held") or one.count <= MANY * evidence.log.samples
        edit = one.edit or ADVICE.get(one.name, "")
        if one.name == "lost" and evidence.log.description.time is not None:
            edit = "record at a rate that the recorder keeps; few lost samples do little harm"
        # Units are wrong in all samples: few beyond a limit are spikes, or a limit that is too low.
        is_wrong = one.contradiction and not (one.name == "units" and few)
        severity = ERROR if is_wrong else WARNING if one.contradiction or not few else NOTE
        yield Finding(one.name, severity, one.text, edit=edit)


def static_channels(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints whose torque is zero or constant, and those that never move."""
    q = evidence.log.recording.q[:, evidence.position_columns]
    still = np.ptp(q, axis=0) == 0
    dead = (np.ptp(evidence.torque_samples, axis=0) == 0) & ~still
    if dead.any():
        names = evidence.names(dead)
        text = f"the torque of {', '.join(names)} never changes: another column?"
        edit = "tau = { columns = [...] }: the columns of measured torques"
        yield Finding("zero", ERROR, text, names, edit=edit)
    if still.any():
        names = evidence.names(still)
        text = f"{', '.join(names)} never moves: its own parameters cannot be found"
        edit = "leave the joint out of joints and state it in locked"
        yield Finding("standstill", WARNING, text, names, edit=edit)


def touches(x: Array) -> int:
    """Return how often a channel (N,) of one sign comes down to zero between larger values; -1 for
    one of both signs."""
    x = x[np.isfinite(x)]
    if not len(x) or x.min() < 0 < x.max():
        return -1
    x = np.delete(x, _spike_rows(x))  # which are far above all others, and need not have their sign
    x, steps = np.abs(x), np.abs(np.diff(x))
    rms = float(np.sqrt((x**2).mean()))
    # A smooth torque that only comes near zero has hardly any slope there: one that was folded
    # reaches zero within a step.
    reach = np.maximum(np.append(steps, 0), np.append(0, steps))
    low = (x < LOW * rms) & (x <= reach) & (x < rms)
    marks = np.where(low, -1, np.where(x > HIGH * rms, 1, 0))
    marks = marks[marks != 0]
    return int(((marks[1:-1] == -1) & (marks[:-2] == 1)).sum()) if len(marks) > 2 else 0


def wrapped_channels(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield hinges whose positions jump by a turn of the joint, or of the motor before its gear."""
    q, log = evidence.raw.q[:, evidence.columns], evidence.log.description
    ratio = log.joint_values("q.ratio", log.q.ratio)[evidence.columns]
    hit = []
    for j in np.flatnonzero([kind == "hinge" for kind in evidence.kinds]):
        steps = np.abs(np.diff(q[np.isfinite(q[:, j]), j]))
        for turn in {TURN, TURN / abs(float(ratio[j]))}:
            jumps = steps > (1 - JUMP) * turn
            # Steps in between are those of other units or columns.
            least, most = steps[~jumps].max(initial=0.0), steps[jumps].max(initial=0.0)
            if 0 < most < (1 + JUMP) * turn and least < JUMP * turn:
                hit.append((int(j), int(jumps.sum())))
                break
    if hit:
        names = evidence.names(np.array([j for j, _ in hit]))
        counts = ", ".join(f"{evidence.joints[j]} {count} times" for j, count in hit)
        yield Finding(
            "wrapped", ERROR, f"positions jump by a turn: {counts}", names,
            blind="motions that move more than a quarter of a turn between samples",
            edit="q = { unwrap = true }",
        )  # fmt: skip


def copied_channels(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield torques that are multiples of a position, of a velocity or of another torque, and
    positions that are multiples of others; velocities that are positions, and torques that are
    accelerations or velocities."""
    # The samples of the file: on the uniform grid each signal has been interpolated apart.
    raw = evidence.raw.columns(evidence.columns)
    valid = ~check_finite(*raw.signals.values())
    channels = {"position": raw.q, "torque": raw.tau, "velocity": raw.v}
    unit = {kind: _unit(x[valid]) for kind, x in channels.items() if x is not None}
    found = [*_multiples(evidence, unit)]
    if "velocity" in unit:
        found += _copied_positions(evidence, unit["position"], unit["velocity"])
    yield from found or _copied_derivatives(evidence)


def _multiples(evidence: DiagnoseInput, unit: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield channels that are multiples of others, of columns (N, n) of length 1 by kind."""
    pairs = (("torque", "torque"), ("position", "position"), ("torque", "position"))
    for kind, other in (*pairs, ("torque", "velocity")):
        if other in unit:
            near = 1.0 - np.abs(unit[kind].T @ unit[other]) < EXACT
            for j, k in zip(*np.nonzero(near), strict=True):
                # Of two channels of one kind either may be the copy: both joints are named, once.
                if kind != other or j > k:
                    names = evidence.joints[j], evidence.joints[k]
                    yield Finding(
                        "copied", ERROR,
                        f"the {kind} of {names[0]} is a multiple of the {other} of {names[1]}: the "
                        "same column twice",
                        names if kind == other else names[:1],
                        edit=f"{'tau' if kind == 'torque' else 'q'} = {{ columns = [...] }}: one "
                        "column a joint",
                    )  # fmt: skip


def _copied_positions(evidence: DiagnoseInput, q: Array, v: Array) -> Iterator[Finding]:
    """Yield joints whose velocity is their position, of columns q, v (N, n) of length 1."""
    # The mean of q v is the change of q^2 / 2 over the duration: none where the joint turns back.
    reversals = (np.diff(np.sign(v), axis=0) != 0).sum(axis=0)
    same = (np.abs((q * v).sum(axis=0)) > NEAR) & (reversals >= REVERSALS)
    if same.any():
        names = evidence.names(same)
        text = f"the velocities of {', '.join(names)} are multiples of their positions"
        edit = "q = { columns = [...] }, v = { columns = [...] }: v can be left out"
        yield Finding("copied", ERROR, text, names, edit=edit)


def _copied_derivatives(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield torques that are all their joints' accelerations, or velocities, times one factor,
    unless those of the model file are nothing but accelerations, as of rotors."""
    tau, (motion, _) = evidence.torque, evidence.fit_samples
    model = evidence.regressor(motion) @ evidence.file_parameters.ravel()
    for word, x, sparse in (
        ("accelerations", evidence.motion.a, motion.a), ("velocities", evidence.motion.v, motion.v)
    ):  # fmt: skip
        moving = (np.ptp(x, axis=0) > 0) & (np.ptp(tau, axis=0) > 0)
        # A model without inertias says nothing, and neither does a single joint then.
        blind = evidence.placeholder != "" and moving.sum() == 1
        # Velocities have hardly any noise, and viscous friction may be alike in all joints.
        least = LEAST if word == "accelerations" else NEAR
        if not moving.any() or blind or not _is_common(x[:, moving], tau[:, moving], least):
            continue
        if not (_slopes(sparse[:, moving], model[:, moving])[0] > NEAR).all():
            text = f"the torques of all joints are their {word} times one factor"
            edit = "tau = { columns = [...] }: the columns of measured torques"
            yield Finding("copied", ERROR, text, evidence.names(moving), edit=edit)
            return


def _is_common(x: Array, tau: Array, least: float) -> bool:
    """True where each column of tau (N, k), or three of four, is that of x (N, k) times the same
    factor, but for an offset; `least`: correlation that is asked of many joints."""
    correlation, factor = _slopes(x, tau)
    middle = float(np.median(factor))
    least = least if len(factor) >= MANY_JOINTS else NEAR
    equal = np.abs(factor - middle) < EQUAL * abs(middle)
    share = MOST_JOINTS if len(factor) >= MANY_JOINTS else 1.0
    return bool((correlation > least).all() and equal.mean() >= share)


def _slopes(x: Array, tau: Array) -> tuple[Array, Array]:
    """Sizes (k,) of the correlations of columns x and tau (N, k), and slopes (k,) of tau on x; 0
    where either is constant."""
    x, tau = x - x.mean(axis=0), tau - tau.mean(axis=0)
    size, product = (x**2).sum(axis=0), (x * tau).sum(axis=0)
    power = size * (tau**2).sum(axis=0)
    valid = power > 0
    correlation = np.abs(product) / np.sqrt(np.where(valid, power, 1.0))
    slope = product / np.where(valid, size, 1.0)
    return np.where(valid, correlation, 0.0), np.where(valid, slope, 0.0)


def _unit(x: Array) -> Array:
    """Columns without their means, of length 1; constant ones are zero."""
    largest = np.abs(x).max(axis=0)
    moves = np.ptp(x, axis=0) > EXACT * largest
    # Squares of numbers below 1e-154 vanish: each column is scaled before its length is taken.
    x = x / np.where(moves, largest, 1.0)
    x = x - x.mean(axis=0)
    size = np.linalg.norm(x, axis=0)
    return np.where(moves, x / np.where(moves, size, 1.0), 0.0)


def spikes(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints whose torques or positions hold single samples far from their neighbours, with
    the first rows."""
    for word, x in (("torque", evidence.raw.tau), ("position", evidence.raw.q)):
        rows = [_spike_rows(x[:, c]) for c in evidence.columns]
        found = [one for one in rows if len(one)]
        if not found:
            continue
        names = evidence.names(np.array([len(one) > 0 for one in rows]))
        first = ", ".join(str(int(row) + 1) for row in found[0][:3])
        text = (
            f"{count_text(sum(map(len, found)), 'spike')} in the {word} of {', '.join(names)}, the "
            f"first in {'samples' if ',' in first else 'sample'} {first}"
        )
        edit = "remove these rows from the file, or use an estimator that is robust: huber"
        blind = "spikes of several samples"
        pairs = zip(evidence.columns, rows, strict=True)
        # Squares of numbers above 1e154 overflow.
        shares = [(x[:, c] / np.nanmax(np.abs(x[:, c])), hit) for c, hit in pairs if len(hit)]
        power = [(one[hit] ** 2).sum() / np.nansum(one**2) for one, hit in shares]
        severity = ERROR if max(power) > NOTHING_ELSE else WARNING
        yield Finding("spikes", severity, text, names, edit=edit, blind=blind)


def _spike_rows(x: Array) -> Array:
    """Return the rows of a channel (N,) that are far from the median of their neighbours."""
    valid = np.where(np.isfinite(x), x, np.nanmedian(x))
    padded = np.pad(valid, WINDOW // 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, WINDOW)
    distance = np.abs(valid - np.median(windows, axis=1))
    # 1.4826: the standard deviation of normal numbers in units of their median deviation.
    scale = SCALES * 1.4826 * float(np.median(distance))
    low, high = np.quantile(valid, [0.05, 0.95])
    height = max(scale, RANGE * float(high - low))
    # A spike is above both neighbours, or below both: steps of a steep slope are none.
    steps = np.diff(valid, prepend=valid[:1], append=valid[-1:])
    up, down = steps[:-1], -steps[1:]
    peaks = np.where((up > 0) == (down > 0), np.minimum(np.abs(up), np.abs(down)), 0.0)
    rows = np.flatnonzero((distance > height) & (peaks > height))
    return rows if high > low and len(rows) <= MOST * len(x) else rows[:0]


def held_channels(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield torques that repeat their values in long runs, updated more slowly than the
    recording."""
    runs = np.ones(evidence.count)
    for j, column in enumerate(evidence.columns):
        x = evidence.raw.tau[:, column]
        if len(np.unique(x)) >= LEVELS:
            edges = np.flatnonzero(np.diff(x) != 0)
            runs[j] = np.median(np.diff(np.concatenate([[-1], edges, [len(x) - 1]])))
    if (runs >= SLOW).any():
        names, longest = evidence.names(runs >= SLOW), runs.max()
        text = (
            f"the torque of {', '.join(names)} changes every {longest:.0f} samples only: its true "
            f"rate is about {evidence.rate / longest:.4g} Hz, and it lags by half of that"
        )
        edit = "record the torque at its own rate, or filter well below that"
        blind = "quantised torques, and joints at rest"
        yield Finding("held", WARNING, text, names, edit=edit, blind=blind)


def clipped_channels(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield joints with many torques at the same extreme: a saturated drive or converter."""
    shares = np.zeros(evidence.count)
    for j, column in enumerate(evidence.columns):
        x = evidence.raw.tau[:, column]
        extremes = [(x == x.max()).mean(), (x == x.min()).mean()]
        # The typical share of any other value: for a coarse converter that of the extremes too.
        typical = 1.0 / max(len(np.unique(x)), 1)
        shares[j] = sum(share for share in extremes if share > COARSE * typical)
    clipped = np.flatnonzero(shares > CLIPPED)
    if len(clipped):
        listed = ", ".join(f"{100 * shares[j]:.0f} % of {evidence.joints[j]}" for j in clipped)
        text, names = f"torques stay at their extreme value: {listed}", evidence.names(clipped)
        edit = "record with a wider range, or with a slower motion"
        blind = "clipping of fewer than 1 % of the samples, or before a filter"
        yield Finding("clipped", WARNING, text, names, edit=edit, blind=blind)
