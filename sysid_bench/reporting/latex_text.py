"""Any text as LaTeX, and names that LaTeX accepts."""

import re
import unicodedata
from typing import Final

_ESCAPES: Final = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "%": r"\%", "_": r"\_", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"{\char34}",
    "`": r"\textasciigrave{}", "[": "{[}", "]": "{]}", "*": "{*}",
    "\N{EN DASH}": r"\textendash{}", "\N{EM DASH}": r"\textemdash{}",
}  # fmt: skip
_SYMBOLS: Final = {
    "\N{DEGREE SIGN}": r"^\circ", "\N{MIDDLE DOT}": r"\cdot", "\N{PLUS-MINUS SIGN}": r"\pm",
    "\N{DOWNWARDS ARROW}": r"\downarrow", "\N{UPWARDS ARROW}": r"\uparrow",
    "\N{MULTIPLICATION SIGN}": r"\times", "\N{MINUS SIGN}": "-", "\N{MICRO SIGN}": r"\mu",
    "\N{GREEK SMALL LETTER ALPHA}": r"\alpha", "\N{GREEK SMALL LETTER BETA}": r"\beta",
    "\N{GREEK SMALL LETTER THETA}": r"\theta", "\N{GREEK SMALL LETTER MU}": r"\mu",
    "\N{GREEK SMALL LETTER SIGMA}": r"\sigma", "\N{GREEK SMALL LETTER TAU}": r"\tau",
}  # fmt: skip
# Accented Latin letters are in every T1 font; letters beyond would stop the compiler.
_ACCENTED: Final = [c for c in map(chr, range(0xC0, 0x100)) if unicodedata.decomposition(c)]
_PRINTED: Final = {
    **{c: c for c in (*map(chr, range(ord(" "), ord("~") + 1)), *_ACCENTED)},
    **{c: rf"\ensuremath{{{symbol}}}" for c, symbol in _SYMBOLS.items()},
    **_ESCAPES,
}
_DIGIT_WORDS: Final = (
    "Zero", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine",
)  # fmt: skip
_SPELLED: Final = dict(zip(map(ord, "0123456789"), _DIGIT_WORDS, strict=True))


def latex_text(text: str) -> str:
    """Any text as LaTeX that prints as it is; letters beyond Latin-1 as their code, [U+4E2D]."""
    printed = "".join(map(_escaped, " ".join(str(text).split())))
    return printed.replace("--", "-{}-")  # two hyphens would print as a dash


def _escaped(c: str) -> str:
    return _PRINTED.get(c, f"{{[}}U+{ord(c):04X}{{]}}")


def label_name(text: str) -> str:
    """Letters and hyphens of a name, with its digits spelled: LaTeX allows no others in a name."""
    return re.sub("[^A-Za-z-]", "", text.translate(_SPELLED))
