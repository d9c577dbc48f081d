"""Findings of a diagnosis: contradictions of the model or of physics, with their corrections."""

from dataclasses import dataclass
from typing import Any, Final

ERROR: Final = "error"
"""A contradiction: identification gives wrong values unless the cause is removed or accepted."""
WARNING: Final = "warning"
"""A likely mistake, or a defect that costs accuracy."""
NOTE: Final = "note"
"""An observation that helps to choose terms, motions or methods."""
SEVERITIES: Final = (ERROR, WARNING, NOTE)


@dataclass(frozen=True)
class Finding:
    """Finding about one recording.

    `explains`: share of the mean squared residual of the joints that its correction removes,
    None where nothing is fitted. `confidence`: 0 to 1. `blind`: when the test cannot see the
    mistake. `edit`: the change of the log's description, or of the model, that corrects it.
    """

    name: str
    severity: str
    message: str
    joints: tuple[str, ...] = ()
    explains: float | None = None
    confidence: float = 1.0
    blind: str = ""
    edit: str = ""

    @property
    def is_error(self) -> bool:
        """True for errors, which a user has to correct or to accept."""
        return self.severity == ERROR

    def to_json(self) -> dict[str, Any]:
        """Fields as JSON values."""
        return {**vars(self), "joints": list(self.joints)}
