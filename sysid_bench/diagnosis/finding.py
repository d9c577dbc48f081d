"""Findings of a diagnosis: contradictions of the model or of physics, with their corrections."""

from dataclasses import dataclass
from typing import Any, Final

from sysid_bench.errors import first_names

ERROR: Final = "error"
"""A contradiction: identification gives wrong values unless the cause is removed or accepted."""
WARNING: Final = "warning"
"""A likely mistake, or a defect that costs accuracy."""
NOTE: Final = "note"
"""An observation that helps to choose terms, motions or methods."""
SEVERITIES: Final = (ERROR, WARNING, NOTE)


@dataclass(frozen=True)
class Alternative:
    """Explanation of a contradiction: `estimate` with its unit and its 95 % `interval`, both empty
    for explanations without a number. `explains`: share of the squared residual that it removes;
    `evidence`: twice the logarithm of the odds that it gains, numbers that it fits counted against
    it; the larger the better. `edit`: what would correct it."""

    name: str
    joints: tuple[str, ...]
    estimate: str
    interval: tuple[float, float] | None
    explains: float
    evidence: float
    message: str
    edit: str

    def __str__(self) -> str:
        """The explanation in a few words, with the share that it explains."""
        where = f" of {first_names(self.joints)}" if self.joints else ""
        number = f": {self.estimate}" if self.estimate else ""
        if self.interval is not None:
            number += " in [{:.3g}, {:.3g}]".format(*self.interval)
        return f"{self.name}{where}{number}, {100 * self.explains:.0f} %"


@dataclass(frozen=True)
class Finding:
    """Finding about one recording.

    `explains`: share of the mean squared residual of the joints that its correction removes,
    None where nothing is fitted. `confidence`: 0 to 1. `blind`: when the test cannot see the
    mistake. `edit`: the change of the log's description, or of the model, that corrects it.
    `alternatives`: all explanations that gain anything, the best of each kind, the best first;
    `as_likely`: names of those that explain as much as the first.
    """

    name: str
    severity: str
    message: str
    joints: tuple[str, ...] = ()
    explains: float | None = None
    confidence: float = 1.0
    blind: str = ""
    edit: str = ""
    alternatives: tuple[Alternative, ...] = ()
    as_likely: tuple[str, ...] = ()

    @property
    def is_error(self) -> bool:
        """True for errors, which a user has to correct or to accept."""
        return self.severity == ERROR

    def to_json(self) -> dict[str, Any]:
        """Fields as JSON values."""
        rows = [
            {**vars(one), "joints": list(one.joints), "text": str(one)} for one in self.alternatives
        ]
        lists = {"joints": list(self.joints), "as_likely": list(self.as_likely)}
        return {**vars(self), **lists, "alternatives": rows}
