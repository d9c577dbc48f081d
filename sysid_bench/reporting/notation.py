"""Notation of numbers: one per column, with the same digits in every format."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

ABSENT: Final = "\N{EN DASH}"  # stands for a number that was not computed

# Beyond these a reader counts zeros instead of reading digits.
_SMALLEST, _LARGEST, _WIDEST_SPAN = 1e-3, 1e5, 1e4
_TIMES = "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Notation:
    """`digits` significant ones (0: whole numbers), never more than `decimals` after the point."""

    digits: int
    scientific: bool = False
    decimals: int = 0

    def text(self, value: float) -> str:
        """A number in plain text: "0.0123", "3.00e-13", "0"; never "-0.00"."""
        if not math.isfinite(value):
            return str(value)
        if value == 0:
            return "0"
        if self.digits == 0 and not self.scientific:
            return _no_negative_zero(f"{value:.0f}" if value == round(value) else f"{value:.1f}")
        if self.scientific:
            mantissa, _, exponent = f"{value:.{max(self.digits, 1) - 1}e}".partition("e")
            return f"{mantissa}e{int(exponent)}"
        wanted = self.digits - 1 - _exponent(value, self.digits)
        return _no_negative_zero(f"{value:.{min(max(wanted, 0), self.decimals)}f}")

    def html_text(self, value: float) -> str:
        """The same number for the screen, with a raised power of ten."""
        mantissa, e, exponent = self.text(value).partition("e")
        return f"{mantissa}{_TIMES}10{exponent.translate(_SUPERSCRIPTS)}" if e else mantissa


def notation(values: Iterable[float | None], digits: int) -> Notation:
    """Notation for all values of a column; scientific where they span decades."""
    sizes = [abs(v) for v in values if v is not None and math.isfinite(v) and v != 0]
    if not sizes:
        return Notation(digits, decimals=max(digits - 1, 0))
    low, high = min(sizes), max(sizes)
    if digits == 0:
        return Notation(3, True) if high >= 1e9 else Notation(0)
    scientific = low < _SMALLEST or high >= _LARGEST or high / low > _WIDEST_SPAN
    return Notation(digits, scientific, max(digits - 1 - _exponent(low, digits), 0))


def _exponent(value: float, digits: int) -> int:
    """The power of ten after rounding to `digits`: 9.999 is 1.00e1."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])


def _no_negative_zero(text: str) -> str:
    return "0" if float(text) == 0 else text
