"""Conformance kit of signal pipelines: `process(recording, joints)` gives ProcessedSignals.

`recording` of the result has q, v, a and tau at the rate of the input, at its times or fewer;
`rows` processes the rows W beta = b. Linear operations without phase, the same for W and b, leave
that equation as it is; the laws test these properties.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    Finding,
    Kit,
    KitCase,
    Law,
    first_error,
    motion_of_kit,
    robot_of_kit,
    shape_error,
)
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
class _PipelineCase(KitCase):
    """A recording of a robot's joints, with exact v and a."""

    recording: Recording
    joints: tuple[Joint, ...]


@cache
def pipeline_cases() -> tuple[_PipelineCase, ...]:
    """An arm that moves, with noise and with a pause, and the same arm at rest."""
    robot = robot_of_kit("ur5")
    motion = motion_of_kit(robot, RATE, period=5.0, cycles=2)
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
    return (
        _PipelineCase("motion", recording, robot.joints),
        _PipelineCase("rest", still, robot.joints),
    )


def check_pipeline(pipeline: Any) -> list[Finding]:
    """Findings of all laws on an arm that moves and on one at rest."""
    return _PipelineKit.check(pipeline, pipeline_cases())


class _PipelineKit(Kit[_PipelineCase]):
    runs = "processes a recording"
    changed = "it changed the recording"

    def run(self) -> Any:
        return self.plugin.process(self.case.recording, self.case.joints)

    def kind(self) -> str:
        return self.case.name

    def given(self) -> Any:
        return self.case.recording

    def _applied(self, x: Array) -> Array:
        recording = self.result.recording
        return np.asarray(self.result.rows.apply(x, np.ones(len(x)), recording.rate))

    @Law("returns processed signals", first=True)
    def signals(self) -> str | None:
        """ProcessedSignals with t, q, v, a and tau (N, ...), all finite, N at least ten."""
        if not isinstance(self.result, ProcessedSignals):
            return f"process returned {type(self.result).__name__}, not ProcessedSignals"
        given, found = self.case.recording, self.result.recording
        if found.v is None or found.a is None:
            return "its recording has no v and a"
        if not isinstance(self.result.rows, RowProcessing):
            return f"its rows are a {type(self.result.rows).__name__}, not a RowProcessing"
        N = len(found.t)
        if not 10 <= N <= len(given):
            return f"it keeps {N} of {len(given)} samples"
        n = given.tau.shape[1]
        shapes = {"t": (N,), "q": (N, given.q.shape[1]), "v": (N, n), "a": (N, n), "tau": (N, n)}
        return first_error(shape_error(x, getattr(found, x), size) for x, size in shapes.items())

    @Law("passes constant signals", of=("rest",))
    def constants(self) -> str | None:
        """Constant positions and torques stay, their rates are zero; so do constant rows."""
        found, given = self.result.recording, self.case.recording
        errors = {
            "q": np.abs(found.q - given.q[0]).max(),
            "tau": np.abs(found.tau - given.tau[0]).max(),
            # Rounding of positions, differentiated twice.
            "v": np.abs(found.motion.v).max() / RATE,
            "a": np.abs(found.motion.a).max() / RATE**2,
            "the rows": np.abs(self._applied(np.ones((len(found), 1))) - 1.0).max(),
        }
        name = max(errors, key=lambda key: float(errors[key]))
        if errors[name] <= LINEAR:
            return None
        return f"at rest {name} changes by {errors[name]:.2g} (SI units and samples)"

    @Law("keeps the times", of=("motion",))
    def times(self) -> str | None:
        found, given = self.result.recording, self.case.recording
        if found.rate != given.rate or not np.isin(found.t, given.t).all():
            return "its samples are not those of the recording; decimation belongs to the rows"
        return None

    @Law("is reproducible", of=("motion",))
    def repeats(self) -> str | None:
        again = self.run().recording
        for name in ("t", "q", "v", "a", "tau"):
            if not np.array_equal(getattr(again, name), getattr(self.result.recording, name)):
                return f"{name} differs from one call to the next"
        return None

    @Law("has no phase", of=("motion",))
    def phase(self) -> str | None:
        """The recording played backwards gives the result backwards."""
        given, motion = self.case.recording, self.case.recording.motion
        turned = replace(
            given,
            q=given.q[::-1].copy(),
            tau=given.tau[::-1].copy(),
            v=-motion.v[::-1],
            a=motion.a[::-1].copy(),
        )
        back = self.plugin.process(turned, self.case.joints).recording
        signs = {"q": 1.0, "v": -1.0, "a": 1.0, "tau": 1.0}
        pairs = {
            name: (getattr(self.result.recording, name), sign * getattr(back, name)[::-1])
            for name, sign in signs.items()
        }
        # Without decimation, whose first row is another one when time runs backwards.
        x, full = self.result.recording.tau, replace(self.result.rows, step=1)
        rows = [full.apply(x, np.ones(len(x)), given.rate) for x in (x, x[::-1].copy())]
        pairs["the rows"] = (rows[0], rows[1][::-1])
        return first_error(_asymmetry(name, *pair) for name, pair in pairs.items())

    @Law("treats W and b alike", of=("motion",))
    def linear(self) -> str | None:
        """Rows are processed linearly, so that W beta = b holds afterwards."""
        rng = np.random.default_rng(3)
        W, beta = rng.normal(size=(len(self.result.recording), 4)), rng.normal(size=(4, 1))
        error = np.abs(self._applied(W) @ beta - self._applied(W @ beta)).max()
        return None if error <= LINEAR * len(W) else f"its rows break W beta = b by {error:.2g}"

    @Law("counts what it leaves out", of=("motion",))
    def counts(self) -> str | None:
        """Rows that count with weight zero have no influence, and `count` has the number of
        others."""
        v, rows = self.result.recording.motion.v, self.result.rows
        pause = v.copy()
        pause[: len(v) // 4] = 0.0
        weights = rows.weights(pause)
        if weights.shape != v.shape or not ((weights >= 0) & (weights <= 1)).all():
            return f"weights has the shape {weights.shape} and values outside 0 to 1"
        first = weights[:, 0]
        ones = np.ones((len(v), 1))
        rate, left_out = self.case.recording.rate, (first == 0)[:, None]
        clean, marked = (rows.apply(x, first, rate) for x in (ones, np.where(left_out, 1e3, ones)))
        if not np.array_equal(clean, marked):
            return "rows with weight zero still have an influence"
        expected = np.count_nonzero(first) * len(clean) / len(v)
        if abs(rows.count(first) - expected) <= 1.0:
            return None
        return f"it counts {rows.count(first)} rows; about {expected:.0f} are not left out"


def _asymmetry(name: str, forward: Array, backward: Array) -> str | None:
    if forward.shape != backward.shape:
        return f"played backwards, {name} has another number of samples"
    middle = slice(len(forward) // 4, -(len(forward) // 4))
    size = np.maximum(np.ptp(forward[middle], axis=0), 1e-12)
    share = float((np.abs(forward - backward)[middle].max(axis=0) / size).max())
    if share <= SYMMETRIC:
        return None
    return f"played backwards, {name} differs by {100 * share:.2g} % of its range: it has a phase"
