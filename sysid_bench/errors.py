"""Errors with one root; messages name the input, the possible values and the remedy."""

import errno
import re
from collections.abc import Iterable, Mapping, Sequence
from textwrap import shorten
from typing import Any, Final

SHOWN: Final = 8
"""Most names that a message lists."""
FAILURES: Final = ("failed", "timeout", "crash", "memory", "lost")
"""Statuses of failures; `unsupported` and `skipped` are valid results. `lost` is the machine's: the
process was killed from outside, or storage failed."""
_MACHINE_ERRORS: Final = frozenset(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ENFILE, errno.ENOMEM)
)

_LONGEST_LINE: Final = 1500
"""Letters of one line of a message."""

NEAR: Final = 0.5
"""Least similarity (difflib: 2 x common letters / all letters) of a name that is suggested."""

RESEMBLING: Final = 0.4
"""Least similarity of the best name with which the nearest names are listed."""

_KINDS: Final = (
    *("robot", "payload", "task", "excitation", "estimator", "simulation", "plant", "metric"),
    *("pipeline", "log-reader", "suite", "dataset", "collection", "term", "filter", "executor"),
)
LISTINGS: Final = {
    **{kind: f" (all: sysid-bench list {kind}s)" for kind in _KINDS},
    "name": " (all: sysid-bench list KIND, with KIND one of "
    + ", ".join(f"{kind}s" for kind in _KINDS)
    + ")",
}
"""Command that lists the names of a kind, as an addition to a message."""

_WORDS: Final = {
    "lmi": "sdp semidefinite feasible cvxpy",
    "ols": "ls lsq lstsq least-squares idim-ls",
    "wls": "weighted-least-squares gls idim-wls",
    "min-norm": "pinv pseudo-inverse svd",
    "a-priori": "map bayes",
    "ridge": "tikhonov",
    "file-friction": "null nominal friction",
    "prior": "cad file model",
    "ml": "mle maximum-likelihood",
    "cloe": "oe output-error",
    "entropic": "bregman geometric",
    "tukey": "bisquare",
    "kalman": "kf",
    "huber": "m-estimator",
}
MEANT: Final = {
    "estimator": {word: name for name, words in _WORDS.items() for word in words.split()}
}
"""Words of the literature and the names that they mean here, which spelling does not lead to."""

_TOML_TYPES: Final = {
    **dict.fromkeys(("dict_type", "model_type"), "a table"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    "string_type": "a text",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
}
"""Type of a value by pydantic's name of the mistake."""
_UNION_TYPE: Final = re.compile(r"str|int|float|(dict|tuple)\[.*\]")


class SysidBenchError(Exception):
    """Root of all errors of this package; `str(error)` is one readable paragraph.

    Lines that quote too much of a file are shortened, and letters that a terminal would obey are
    escaped.
    """

    def __str__(self) -> str:
        return "\n".join(map(_readable, super().__str__().split("\n")))


class UsageError(SysidBenchError):
    """Invalid input: an unknown name, a broken suite, a value out of range (exit code 2)."""


class ModelError(SysidBenchError):
    """A robot, payload or model file that cannot be used as it is."""


class StaticModelError(ModelError):
    """A model file in which nothing moves, as that of a table."""


class WriteError(ModelError):
    """A model file that was asked for and not written; `result` holds what was identified."""

    def __init__(self, message: str, result: object = None) -> None:
        super().__init__(message)
        self.result = result


class UnsupportedError(SysidBenchError):
    """Valid input that this method or robot does not support; its cell becomes `unsupported`."""


class SimulationError(SysidBenchError):
    """A simulation without finite result (NaN, divergence, unstable controller)."""


class EstimationError(SysidBenchError):
    """An estimator without result, with the reason; its cell becomes `failed`."""


def _readable(line: str) -> str:
    if len(line) > _LONGEST_LINE:
        kept = _LONGEST_LINE // 2
        line = f"{line[:kept]} ... {line[-kept:]}"
    if line.isprintable():
        return line
    # A name in a file may hold escape codes, by which it could rewrite the screen.
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def unknown_name(kind: str, name: str, known: Iterable[str], advice: str = "") -> UsageError:
    """Return an error that names the nearest existing `kind` and lists the others.

    Of more than SHOWN names it lists the nearest ones; where none is near the first ones, with the
    command that lists all.
    """
    from difflib import get_close_matches  # 1.5 ms that --help would wait for

    names = sorted(set(known))
    plain = name.lower().replace("_", "-")
    meant = MEANT.get(kind, {}).get(plain)
    # Capitals and underscores are no other name.
    word = next((one for one in names if one.lower().replace("_", "-") == plain), name)
    first = [meant] if meant in names else []
    near = first or get_close_matches(word, names, n=1, cutoff=NEAR)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    # Where no name resembles it, their order by similarity is noise.
    resembling = first or get_close_matches(word, names, n=1, cutoff=RESEMBLING)
    others = [one for one in names if one not in first]
    nearest = get_close_matches(word, others, n=SHOWN - len(first), cutoff=0.0)
    nearest = first + nearest if resembling else []
    listed = _listed(kind, names, nearest)
    return UsageError(
        f"No {kind} is called {name!r}.{hint} {listed}{' ' + advice if advice else ''}"
    )


def _listed(kind: str, names: Sequence[str], nearest: Sequence[str]) -> str:
    if not names:
        return f"There is no {kind} at all."
    if len(names) <= SHOWN:
        return f"There are: {', '.join(names)}."
    if nearest:
        return f"The nearest of {len(names)}: {', '.join(nearest)}."
    return f"There are {first_names(names, SHOWN)}{LISTINGS.get(kind, '')}."


def value_errors(problems: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Say in words of TOML what is wrong with values of a file, by key: "must be a text or a table;
    got 0.9". `problems`: pydantic's; where a key may be of several types, each is one."""
    found: dict[str, str] = {}
    kinds: dict[str, list[str]] = {}
    for problem in problems:
        kind = _TOML_TYPES.get(problem["type"])
        # A type of a union stands behind the key.
        key = ".".join(part for part in map(str, problem["loc"]) if not _UNION_TYPE.fullmatch(part))
        if kind is None:
            found.setdefault(key, problem["msg"].removeprefix("Value error, "))
            continue
        kinds.setdefault(key, []).append(kind)
        value = shorten(repr(problem["input"]), 60)
        found[key] = f"must be {' or '.join(dict.fromkeys(kinds[key]))}; got {value}"
    return found


def count_text(count: int, word: str) -> str:
    """Return a count with its noun: "1 model", "2 models"."""
    return f"{count} {word}{'' if count == 1 else 's'}"


def first_names(names: Iterable[str], count: int = 3) -> str:
    """Return the first `count` of names, each once, and the number of the others."""
    unique = list(dict.fromkeys(names))
    more = f" and {len(unique) - count} more" if len(unique) > count else ""
    return ", ".join(unique[:count]) + more


def status_of(error: BaseException) -> str:
    """Return the status of a cell that ends with this error.

    Storage and quotas of the machine are `lost`: they say nothing about a method.
    """
    if isinstance(error, UnsupportedError):
        return "unsupported"
    if isinstance(error, MemoryError):
        return "memory"
    # Not a failure of the method: a quota made 224 of 240 rows final failures, once.
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRORS:
        return "lost"
    return "failed"


LONGEST_TEXT: Final = 1000
"""Characters of a reason that a row keeps: texts of plug-ins may hold whole arrays."""


def reason_of(error: BaseException) -> str:
    """Return the message on one line; errors of others with their type."""
    try:
        text = " ".join(str(error).split())[:LONGEST_TEXT]
    except Exception:  # __str__ of a plug-in's error may fail
        text = ""
    if isinstance(error, SysidBenchError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
