"""Notation of numbers: one per column, with the same digits in every format."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

ABSENT: Final = "\N{EN DASH}"  # stands for a number that was not computed

# Beyond these a reader counts zeros instead of reading digits.
_SMALLEST, _LARGEST, _WIDEST_SPAN, _LARGEST_WHOLE = 1e-3, 1e5, 1e4, 1e9
_SHARED_SPAN: Final = 1e3  # of values with one power of ten
_TIMES = "\N{MULTIPLICATION SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Notation:
    """`digits` significant ones (0: whole numbers), never more than `decimals` after the point."""

    digits: int
    scientific: bool = False
    decimals: int = 0
    low: float = 0.0  # smallest and largest size of the values that are not zero
    high: float = 0.0

    def text(self, value: float) -> str:
        """A number in plain text: "0.0123", "3.00e-13", "0"; never "-0.00"."""
        if not math.isfinite(value):
            return str(value)
        if value == 0:
            return "0"
        if self.scientific:
            # Python pads exponents to two digits; 1e-08 and 1e-8 are one number.
            mantissa, _, exponent = f"{value:.{max(self.digits, 1) - 1}e}".partition("e")
            return f"{mantissa}e{int(exponent)}"
        text = f"{value:.{self._decimals_of(value)}f}"
        return "0" if float(text) == 0 else text

    def _decimals_of(self, value: float) -> int:
        """Digits after the point; a number that should be whole but is not (a median) has one."""
        if self.digits == 0:
            return int(value != round(value))
        wanted = self.digits - 1 - _exponent(value, self.digits)
        return min(max(wanted, 0), self.decimals)

    @property
    def scale(self) -> int | None:
        """The power of ten that all values can share; None where they need none, or differ by so
        much that the smallest would lose its digits."""
        if not self.scientific or self.high > _SHARED_SPAN * self.low:
            return None
        return _exponent(self.high, max(self.digits, 1))

    def without_scale(self) -> "Notation":
        """Notation of the same values over ten to the power that they share, in plain decimals."""
        if self.scale is None:
            return self
        low = self.low / 10.0**self.scale
        return Notation(self.digits, decimals=max(self.digits - 1 - _exponent(low, self.digits), 0))

    def html_text(self, value: float) -> str:
        """The same number for the screen, with a raised power of ten."""
        mantissa, e, exponent = self.text(value).partition("e")
        return f"{mantissa}{_TIMES}10{exponent.translate(_SUPERSCRIPTS)}" if e else mantissa


def notation(values: Iterable[float | None], digits: int) -> Notation:
    """Notation for all values of a column; scientific where they span decades."""
    # Zeros print as 0 in any notation; neither they nor missing values count.
    sizes = [abs(v) for v in filter(None, values) if math.isfinite(v)]
    if not sizes:
        return Notation(digits, decimals=max(digits - 1, 0))
    low, high = min(sizes), max(sizes)
    if digits == 0:
        return _whole(high)
    decimals = max(digits - 1 - _exponent(low, digits), 0)
    return Notation(digits, _spans_decades(low, high), decimals, low, high)


def _whole(high: float) -> Notation:
    """Notation of whole numbers up to `high`."""
    return Notation(3, True) if high >= _LARGEST_WHOLE else Notation(0)


def _spans_decades(low: float, high: float) -> bool:
    """True where plain decimals would hold too many zeros."""
    return low < _SMALLEST or high >= _LARGEST or high / low > _WIDEST_SPAN


def _exponent(value: float, digits: int) -> int:
    """The power of ten after rounding to `digits`: 9.999 is 1.00e1."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])
