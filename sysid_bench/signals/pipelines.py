"""Signal pipelines, from recorded signals to the rows W beta = b of a fit: `parallel` (rows of W
and the torque through the same low-pass, then decimated), `plain` and `raw`."""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import Joint
from sysid_bench.signals.filter import Butterworth, Filter, NoFilter
from sysid_bench.signals.processing import Processing, processing_of
from sysid_bench.signals.row_processing import STANDSTILL, ProcessedSignals, RowProcessing
from sysid_bench.signals.spectrum import bandwidth
from sysid_bench.types import Recording

CUTOFF: Final = 10.0
"""Default cut-off in units of the motion's bandwidth. Measured on eight arms in closed loop: 5 to
16 give the same median within a tenth, 3 loses directions."""

MOTION_CUTOFF: Final = 2.0
"""Cut-off of the positions in units of that of the rows: it bounds the noise of the second
derivative, and hardly changes what the rows keep."""

ACCURACY: Final = 4
"""Order of the differences. Those of order 2, applied twice, understate an acceleration of the
angular frequency w by the share (w T)^2 / 3, sampled every T, and the fit overstates inertias by as
much: 0.4 % at 100 Hz for a motion of up to 1.7 Hz. All motions share this bias, so that it is in no
interval: those of the scara's inertias, 0.05 % wide, held the truth in 10 of 100. Order 4 leaves
(w T)^4 / 15, here 8e-6, and order 6 only adds noise."""

PASS: Final = 0.8
"""Share of the decimated band that the filter passes, as customary for decimation."""

HIGHEST: Final = 0.4
"""Highest cut-off as a share of the rate; a filter above it would remove nothing."""


@dataclass(frozen=True)
class Parallel:
    """v and a from lightly filtered positions; then every column of W, sign(v) included, and tau
    through one zero-phase Butterworth low-pass, decimated to about its cut-off (Gautier 1997;
    Gautier, Janot, Vandanjon 2013, section IV).

    Filtering tau alone rounds the steps of Coulomb friction that sign(v) keeps; filtering both
    leaves W beta = tau as it is. Rows of a joint slower than `standstill` times its RMS rate are
    left out before the filter, or count with `weight`. `derivatives` "from v" takes the rates of
    the drives; in logs it is the default where every log has them. A torque that a declared
    controller holds over its period belongs to the middle of the period, and is shifted there.

    Where no `cutoff` (Hz) is given it is 10 times the bandwidth of the recorded motion: the
    frequency below which a coordinate has 99 % of the power of its rate, measured where the log has
    it, in the median; the highest harmonic of a Fourier motion. Positions are filtered at twice the
    cut-off. Above 0.4 times the rate there is no filter. Every `step`-th row is kept, step the
    integer nearest below 0.4 rate / cutoff that divides the period of a periodic motion.
    """

    cutoff: float | None = field(default=None, metadata={"unit": "Hz"})
    order: int = 4
    derivatives: str = "from q"
    standstill: float = field(default=STANDSTILL, metadata={"unit": "1"})
    weight: float = field(default=0.0, metadata={"unit": "1"})
    ideal_rates = False

    def __post_init__(self) -> None:
        """Raise UsageError for impossible numbers, and for rates of ideal sensors."""
        if self.derivatives not in ("from q", "from v"):
            raise UsageError(f"derivatives = {self.derivatives!r}: write 'from q' or 'from v'.")
        RowProcessing(standstill=self.standstill, weight=self.weight)
        if self.order < 1 or (self.cutoff is not None and not self.cutoff > 0):
            raise UsageError(
                f"A low-pass needs a positive order and cut-off; got the order {self.order} and "
                f"{self.cutoff} Hz."
            )

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals:
        """Return the motion at its own rate with the measured torque, and the row filter."""
        rate, cutoff = recording.rate, self._cutoff_of(recording)
        recording = _centred(recording)
        light = processing_of({"derivatives": self.derivatives, "torque": "raw"})
        low_pass = _low_pass(self.order, MOTION_CUTOFF * cutoff, rate)
        light = replace(light, filter=low_pass, accuracy=ACCURACY)
        processed, filter = light.apply(recording, joints), _low_pass(self.order, cutoff, rate)
        step = 1 if isinstance(filter, NoFilter) else _step(processed, cutoff)
        rows = RowProcessing(filter, step, self.standstill, self.weight)
        return ProcessedSignals(processed, rows, light.edge(recording))

    def _cutoff_of(self, recording: Recording) -> float:
        """Return the cut-off (Hz) for a recording."""
        if self.cutoff is not None:
            return self.cutoff
        found = CUTOFF * bandwidth(recording.q, recording.rate, recording.v)
        return found if found > 0 else recording.rate


def _centred(recording: Recording) -> Recording:
    """A recording whose torque, held from each sample on for a control period, is that of half a
    period before: the mean torque around each sample, to first order."""
    controller = recording.controller
    if controller is None or not controller.held:
        return recording
    share = 0.5 * recording.rate / controller.rate
    before = np.concatenate([recording.tau[:1], recording.tau[:-1]])
    return replace(recording, tau=recording.tau + share * (before - recording.tau))


def _low_pass(order: int, cutoff: float, rate: float) -> Filter:
    return Butterworth(order, cutoff) if cutoff < HIGHEST * rate else NoFilter()


def _step(recording: Recording, cutoff: float) -> int:
    """Step of the decimation: the largest that aliases nothing and divides the period, unless that
    keeps more than twice the rows."""
    largest = max(1, int(PASS * recording.rate / (2 * cutoff)))
    period = recording.motion.period_samples
    dividing = [step for step in range(1, largest + 1) if period and period % step == 0]
    best = max(dividing, default=1)
    return best if 2 * best >= largest else largest


@dataclass(frozen=True)
class Plain:
    """q and tau through `filter`, v and a from q, v or ideal sensors (`derivatives`), and W from
    these, which is not filtered; `filter`, `derivatives` and `torque` are those of the table
    `signals` unless given.

    tau then lacks the steps of Coulomb friction that sign(v) in W still has. With `standstill`
    (share of the joint's RMS rate) slower rows are left out of the fit, or count with `weight`.
    """

    filter: str = "none"
    derivatives: str = "exact"
    torque: str = "filtered"
    standstill: float = field(default=0.0, metadata={"unit": "1"})
    weight: float = field(default=0.0, metadata={"unit": "1"})

    def __post_init__(self) -> None:
        """Raise UsageError for unknown words and impossible numbers."""
        self._processing()
        RowProcessing(standstill=self.standstill, weight=self.weight)

    @property
    def ideal_rates(self) -> bool:
        """True for v and a of ideal sensors."""
        return not self._processing().differentiate

    def _processing(self) -> Processing:
        return processing_of(
            {"filter": self.filter, "derivatives": self.derivatives, "torque": self.torque}
        )

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals:
        """Return the filtered recording without its spoilt edges; raises UsageError where it is
        too short or lacks signals."""
        rows = RowProcessing(standstill=self.standstill, weight=self.weight)
        return ProcessedSignals(self._processing().apply(recording, joints), rows)


@dataclass(frozen=True)
class Raw:
    """v and a by central differences of the measured q, every sample, nothing filtered.

    Noise of W biases least squares towards zero (errors in variables); `standstill` and `weight`
    are those of the pipeline `plain`.
    """

    standstill: float = field(default=0.0, metadata={"unit": "1"})
    weight: float = field(default=0.0, metadata={"unit": "1"})
    ideal_rates = False

    def __post_init__(self) -> None:
        """Raise UsageError for impossible numbers."""
        RowProcessing(standstill=self.standstill, weight=self.weight)

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals:
        """Return the recording with differences as v and a, two samples shorter at each end."""
        rows = RowProcessing(standstill=self.standstill, weight=self.weight)
        return ProcessedSignals(Processing(NoFilter(), True).apply(recording, joints), rows)
