"""Conformance kit of signal pipelines: `process(recording, joints)` gives ProcessedSignals.

`recording` of the result has q, v, a and tau at the rate of the input, at its times or fewer;
`rows` processes the rows W beta = b. Linear operations without phase, the same for W and b, leave
that equation as it is; the laws test these properties.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    finding_of_error,
    findings_of,
    first_error,
    shape_error,
)
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import Joint
from sysid_bench.signals.row_processing import ProcessedSignals, RowProcessing
from sysid_bench.types import Array, Recording

RATE: Final = 200.0
"""Hz, of the recordings."""

LINEAR: Final = 1e-9
"""Largest share by which linear operations may differ: rounding."""

SYMMETRIC: Final = 1e-3
"""Largest share by which signals that run backwards may differ in the middle half: what is left
of the start of a recursive filter there. A delay of one sample makes about 0.03."""


@dataclass(frozen=True, eq=False)
class _PipelineCase:
    """A recording of a robot's joints, with exact v and a."""

    name: str
    recording: Recording
    joints: tuple[Joint, ...]


Law = Callable[[Any, _PipelineCase, ProcessedSignals], str | None]
"""(pipeline, case, its result) -> description of the violation, or None."""


@cache
def pipeline_cases() -> tuple[_PipelineCase, ...]:
    """An arm that moves, with noise and with a pause, and the same arm at rest."""
    robot = loaded_robot("ur5", "none", None, None).robot
    brief = design_problem(robot, RATE)
    motion = Fourier(period=5.0, cycles=2).design(brief, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    recording = Recording(
        t=motion.t,
        q=motion.q + 1e-5 * rng.normal(size=motion.q.shape),
        tau=np.sin(motion.q) + 0.1 * motion.a + 0.01 * rng.normal(size=motion.v.shape),
        rate=RATE,
        rows=robot.torque_rows,
        v=motion.v,
        a=motion.a,
        period=motion.period,
    )
    rest = np.zeros_like(motion.v)
    still = replace(
        recording,
        q=np.tile(motion.q[0], (len(motion), 1)),
        tau=np.tile(recording.tau[0], (len(motion), 1)),
        v=rest,
        a=rest,
        period=None,
    )
    moves, stays = (
        _PipelineCase(n, r, robot.joints) for n, r in (("motion", recording), ("rest", still))
    )
    return moves, stays


def check_pipeline(pipeline: Any) -> list[Finding]:
    """Findings of all laws on an arm that moves and on one at rest."""
    findings = []
    for case in pipeline_cases():
        before = data_hash(case.recording)
        try:
            result = pipeline.process(case.recording, case.joints)
        except Exception as error:
            findings.append(finding_of_error(error, "processes a recording", case.name))
            continue
        shape = findings_of({"returns processed signals": _has_shapes}, case.name, case, result)
        findings += shape
        if shape[0].passed:  # the other laws compute with these arrays
            laws = RESTING if case.name == "rest" else MOVING
            findings += findings_of(laws, case.name, pipeline, case, result)
        if data_hash(case.recording) != before:
            findings.append(Finding(UNCHANGED, case.name, False, "it changed the recording"))
    return findings


def _has_shapes(case: _PipelineCase, result: Any) -> str | None:
    """ProcessedSignals with t, q, v, a and tau (N, ...), all finite, N at least ten."""
    if not isinstance(result, ProcessedSignals):
        return f"process returned {type(result).__name__}, not ProcessedSignals"
    given, found = case.recording, result.recording
    if found.v is None or found.a is None:
        return "its recording has no v and a"
    if not isinstance(result.rows, RowProcessing):
        return f"its rows are a {type(result.rows).__name__}, not a RowProcessing"
    N = len(found.t)
    if not 10 <= N <= len(given):
        return f"it keeps {N} of {len(given)} samples"
    n = given.tau.shape[1]
    shapes = {"t": (N,), "q": (N, given.q.shape[1]), "v": (N, n), "a": (N, n), "tau": (N, n)}
    return first_error(shape_error(x, getattr(found, x), size) for x, size in shapes.items())


def _keeps_the_times(pipeline: Any, case: _PipelineCase, result: ProcessedSignals) -> str | None:
    found, given = result.recording, case.recording
    if found.rate != given.rate or not np.isin(found.t, given.t).all():
        return "its samples are not those of the recording; decimation belongs to the rows"
    return None


def _is_reproducible(pipeline: Any, case: _PipelineCase, result: ProcessedSignals) -> str | None:
    again = pipeline.process(case.recording, case.joints).recording
    for name in ("t", "q", "v", "a", "tau"):
        if not np.array_equal(getattr(again, name), getattr(result.recording, name)):
            return f"{name} differs from one call to the next"
    return None


def _passes_constants(pipeline: Any, case: _PipelineCase, result: ProcessedSignals) -> str | None:
    """Constant positions and torques stay, their rates are zero; so do constant rows."""
    found, given, motion = result.recording, case.recording, result.recording.motion
    errors = {
        "q": np.abs(found.q - given.q[0]).max(),
        "tau": np.abs(found.tau - given.tau[0]).max(),
        # Rounding of positions, differentiated twice.
        "v": np.abs(motion.v).max() / RATE,
        "a": np.abs(motion.a).max() / RATE**2,
        "the rows": np.abs(_applied(result, np.ones((len(found), 1))) - 1.0).max(),
    }
    name = max(errors, key=lambda key: float(errors[key]))
    if errors[name] <= LINEAR:
        return None
    return f"at rest {name} changes by {errors[name]:.2g} (SI units and samples)"


def _has_no_phase(pipeline: Any, case: _PipelineCase, result: ProcessedSignals) -> str | None:
    """The recording played backwards gives the result backwards."""
    given, motion = case.recording, case.recording.motion
    turned = replace(
        given,
        q=given.q[::-1].copy(),
        tau=given.tau[::-1].copy(),
        v=-motion.v[::-1],
        a=motion.a[::-1].copy(),
    )
    back = pipeline.process(turned, case.joints)
    signs = {"q": 1.0, "v": -1.0, "a": 1.0, "tau": 1.0}
    pairs = {
        name: (getattr(result.recording, name), sign * getattr(back.recording, name)[::-1])
        for name, sign in signs.items()
    }
    x = result.recording.tau
    full = replace(result.rows, step=1)
    weights = np.ones(len(x))
    pairs["the rows"] = (
        full.apply(x, weights, given.rate), full.apply(x[::-1].copy(), weights, given.rate)[::-1]
    )  # fmt: skip
    return first_error(_asymmetry(name, *pair) for name, pair in pairs.items())


def _asymmetry(name: str, forward: Array, backward: Array) -> str | None:
    if forward.shape != backward.shape:
        return f"played backwards, {name} has another number of samples"
    middle = slice(len(forward) // 4, -(len(forward) // 4))
    size = np.maximum(np.ptp(forward[middle], axis=0), 1e-12)
    share = float((np.abs(forward - backward)[middle].max(axis=0) / size).max())
    if share <= SYMMETRIC:
        return None
    return f"played backwards, {name} differs by {100 * share:.2g} % of its range: it has a phase"


def _treats_w_and_b_alike(
    pipeline: Any, case: _PipelineCase, result: ProcessedSignals
) -> str | None:
    """Rows are processed linearly, so that W beta = b holds afterwards."""
    rng = np.random.default_rng(3)
    W, beta = rng.normal(size=(len(result.recording), 4)), rng.normal(size=(4, 1))
    error = np.abs(_applied(result, W) @ beta - _applied(result, W @ beta)).max()
    return None if error <= LINEAR * len(W) else f"its rows break W beta = b by {error:.2g}"


def _counts_what_it_leaves_out(
    pipeline: Any, case: _PipelineCase, result: ProcessedSignals
) -> str | None:
    """Rows that count with weight zero have no influence, and `count` has the number of others."""
    v, rows = result.recording.motion.v, result.rows
    pause = v.copy()
    pause[: len(v) // 4] = 0.0
    weights = rows.weights(pause)
    if weights.shape != v.shape or not ((weights >= 0) & (weights <= 1)).all():
        return f"weights has the shape {weights.shape} and values outside 0 to 1"
    first = weights[:, 0]
    ones = np.ones((len(v), 1))
    rate, left_out = case.recording.rate, (first == 0)[:, None]
    clean, marked = (rows.apply(x, first, rate) for x in (ones, np.where(left_out, 1e3, ones)))
    if not np.array_equal(clean, marked):
        return "rows with weight zero still have an influence"
    expected = np.count_nonzero(first) * len(clean) / len(v)
    if abs(rows.count(first) - expected) <= 1.0:
        return None
    return f"it counts {rows.count(first)} rows; about {expected:.0f} are not left out"


def _applied(result: ProcessedSignals, x: Array) -> Array:
    return result.rows.apply(x, np.ones(len(x)), result.recording.rate)


RESTING: Final[dict[str, Law]] = {"passes constant signals": _passes_constants}

MOVING: Final[dict[str, Law]] = {
    "keeps the times": _keeps_the_times,
    "is reproducible": _is_reproducible,
    "has no phase": _has_no_phase,
    "treats W and b alike": _treats_w_and_b_alike,
    "counts what it leaves out": _counts_what_it_leaves_out,
}
