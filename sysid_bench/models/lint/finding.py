"""Finding of a check of a model file."""

from dataclasses import dataclass
from typing import Final, Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")


@dataclass(frozen=True)
class LintFinding:
    """What is wrong with an element of a model: `rule` names the check, `element` the body or joint
    ("" for the whole model), `advice` says what to do, `line` where it is in the file."""

    rule: str
    severity: Severity
    element: str
    message: str
    advice: str
    file: str = ""
    line: int | None = None

    @property
    def text(self) -> str:
        """file:line: severity rule: message; advice."""
        place = f"{self.file}:{self.line}" if self.line else self.file
        where = f"{self.element}: " if self.element else ""
        return f"{place}: {self.severity} {self.rule}: {where}{self.message}; {self.advice}"
