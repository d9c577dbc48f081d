"""Plain filtering: the same filter on every signal, then differences; W is not filtered."""

from dataclasses import dataclass, field

from sysid_bench.models.robot import Joint
from sysid_bench.signals.processing import Processing, processing_of
from sysid_bench.signals.row_processing import ProcessedSignals, RowProcessing
from sysid_bench.types import Recording


@dataclass(frozen=True)
class Plain:
    """q and tau through `filter`, v and a from q, v or ideal sensors (`derivatives`), and W from
    these; `filter`, `derivatives` and `torque` are those of the table `signals` unless given.

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
        self._rows()

    @property
    def ideal_rates(self) -> bool:
        """True for v and a of ideal sensors."""
        return not self._processing().differentiate

    def _processing(self) -> Processing:
        return processing_of(
            {"filter": self.filter, "derivatives": self.derivatives, "torque": self.torque}
        )

    def _rows(self) -> RowProcessing:
        return RowProcessing(standstill=self.standstill, weight=self.weight)

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals:
        """Return the filtered recording without its spoilt edges; raises UsageError where it is
        too short or lacks signals."""
        return ProcessedSignals(self._processing().apply(recording, joints), self._rows())
