"""Tolerances between two values of a metric, and the verdict on a change."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from sysid_bench.errors import UsageError
from sysid_bench.types import Better, Metric

Kind = Literal["exact", "absolute", "ratio"]
Verdict = Literal["same", "better", "worse", "changed"]
Value = float | None

ROUNDING: Final = 1e-11
"""Errors below this are rounding: 1e-15 of a double times the condition number of a regressor."""


@dataclass(frozen=True)
class Tolerance:
    """Largest change that does not count.

    "exact": none. "absolute": a difference of `size`. "ratio": a factor of `size` (> 1) between two
    values, each at least `floor`.
    """

    kind: Kind
    size: float = 0.0
    floor: float = 0.0

    def __post_init__(self) -> None:
        least = 1.0 if self.kind == "ratio" else 0.0
        are_in_range = least <= self.size < math.inf and 0.0 <= self.floor < math.inf
        if self.kind not in get_args(Kind) or not are_in_range:
            raise UsageError(
                f"{self.to_json()} is not a tolerance: {{'exact': 0}}, {{'absolute': x}} with "
                "x >= 0, or {'ratio': r} with r >= 1 and a floor >= 0."
            )

    def holds(self, before: float, after: float) -> bool:
        """True where the change from `before` to `after` does not count."""
        if before == after:
            return True
        if self.kind == "exact" or not (math.isfinite(before) and math.isfinite(after)):
            return False
        if self.kind == "absolute":
            return abs(after - before) <= self.size
        return self._is_within_factor(before, after)

    def _is_within_factor(self, before: float, after: float) -> bool:
        low, high = sorted((max(abs(before), self.floor), max(abs(after), self.floor)))
        return (before * after >= 0 and high <= self.size * low) or high <= self.floor

    def stored_value(self, value: float) -> float:
        """`value`, or 0 where it is below what the tolerance can see: files stay short and do not
        change with rounding."""
        smallest = {"exact": 0.0, "absolute": self.size, "ratio": self.floor}[self.kind]
        return 0.0 if abs(value) <= smallest else value

    def to_json(self) -> dict[str, float]:
        """{"ratio": 1.01, "floor": 1e-11}."""
        return {self.kind: self.size} | ({"floor": self.floor} if self.floor else {})

    @classmethod
    def from_json(cls, values: Any) -> "Tolerance":
        """The tolerance of `to_json`; raises UsageError for anything else."""
        if not _is_tolerance(values):
            raise UsageError(
                f"{values!r} is not a tolerance: {{'exact': 0}}, {{'absolute': x}} or "
                "{'ratio': r, 'floor': x}."
            )
        (kind,) = _kinds(values)
        return cls(kind, float(values[kind]), float(values.get("floor", 0.0)))

    def __str__(self) -> str:
        return "exact" if self.kind == "exact" else f"{self.kind} {self.size:g}"


def _is_tolerance(values: Any) -> bool:
    """True for the size of one kind, with or without a floor."""
    if not isinstance(values, Mapping) or len(_kinds(values)) != 1:
        return False
    are_numbers = all(isinstance(size, (int, float)) for size in values.values())
    return are_numbers and values.keys() <= {*_kinds(values), "floor"}


def _kinds(values: Mapping[str, Any]) -> list[Kind]:
    return [kind for kind in get_args(Kind) if kind in values]


_RATIO: Final = Tolerance("ratio", 1.01, ROUNDING)
_GAPS: Final = Tolerance("absolute", 1e-12)
DEFAULTS: Final[Mapping[str, Tolerance]] = MappingProxyType(
    {
        **dict.fromkeys(("gap", "closure", "native_gap"), _GAPS),
        # Smallest kept over largest dropped singular value: the latter is rounding.
        "rank_gap": Tolerance("ratio", 1e3),
        "min_eigenvalue": Tolerance("ratio", 1.01, 1e-9),
    }
)
"""Tolerances of single metrics; `tolerance_of` has the rule for all others."""


def tolerance_of(metric: Metric) -> Tolerance:
    """Default tolerance of a metric: exact for numbers of things and shares of yes and no, absolute
    for gaps between engines, and a factor of 1.01 for everything that is computed with noise."""
    if metric.name in DEFAULTS:
        return DEFAULTS[metric.name]
    counted = metric.digits == 0 or metric.name in ("feasible", "plausible", "converged")
    return Tolerance("exact") if counted else _RATIO


def verdict_of(better: Better | None, tolerance: Tolerance, before: Value, after: Value) -> Verdict:
    """Verdict on the change of a value; a value that is gone is worse, a new one is a change."""
    if after is None:
        return "same" if before is None else "worse"
    if before is None:
        return "changed"
    if tolerance.holds(before, after):
        return "same"
    if better is None or math.isnan(before) or math.isnan(after):
        return "changed"
    return "better" if (after < before) == (better == "lower") else "worse"
