"""No filter at all: measured positions and torques, and differences."""

from dataclasses import dataclass, field

from sysid_bench.models.robot import Joint
from sysid_bench.signals.filter import NoFilter
from sysid_bench.signals.processing import Processing
from sysid_bench.signals.row_processing import ProcessedSignals, RowProcessing
from sysid_bench.types import Recording


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
        self._rows()

    def _rows(self) -> RowProcessing:
        return RowProcessing(standstill=self.standstill, weight=self.weight)

    def process(self, recording: Recording, joints: tuple[Joint, ...]) -> ProcessedSignals:
        """Return the recording with differences as v and a, two samples shorter at each end."""
        return ProcessedSignals(Processing(NoFilter(), True).apply(recording, joints), self._rows())
