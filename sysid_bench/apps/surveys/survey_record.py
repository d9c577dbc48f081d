"""Results of a survey: a record for each model, made of its rows."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sysid_bench.apps.surveys.cause import cause_of
from sysid_bench.types import Row


@dataclass(frozen=True)
class SurveyRecord:
    """One model: the row of its cross-check, and the row of what the engines read of its file as it
    stands (None where it was not computed)."""

    name: str
    row: Row
    engines: Row | None

    @property
    def ok(self) -> bool:
        """True for a model that the cross-check accepts."""
        return bool(self.row["status"] == "ok")

    @property
    def cause(self) -> str:
        """Cause of the refusal, "" for none."""
        return cause_of(self.row)

    @property
    def is_loaded(self) -> bool:
        """True where an engine reads moving joints from the file as it stands."""
        read = self.engines or {}
        counts = (read.get("mujoco"), read.get("pinocchio"))
        return any(isinstance(count, int) and count > 0 for count in counts)

    @property
    def error(self) -> float:
        """Largest of gap and closure, 0 for a refused model."""
        figures = [self.row.get("gap"), self.row.get("closure"), *self._coupled()]
        return max((float(figure) for figure in figures if figure is not None), default=0.0)

    def _coupled(self) -> list[Any]:
        coupling: Mapping[str, Any] = self.row.get("coupling") or {}
        return [coupling.get("gap"), coupling.get("closure")]


def counts_by_cause(models: Iterable[SurveyRecord]) -> list[tuple[str, int]]:
    """Return the causes of refusals with their number, the most frequent first."""
    counts = Counter(model.cause for model in models if not model.ok)
    return sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))
