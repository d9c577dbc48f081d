"""Errors with one root; messages name the input, the possible values and the remedy."""

import errno
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Final

SHOWN: Final = 8
"""Most names that a message lists."""
_MACHINE_ERRORS: Final = frozenset(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ENFILE, errno.ENOMEM)
)


class SysidBenchError(Exception):
    """Root of all errors of this package; `str(error)` is one readable paragraph."""


class UsageError(SysidBenchError):
    """Invalid input: an unknown name, a broken suite, a value out of range (exit code 2)."""


class ModelError(SysidBenchError):
    """A robot, payload or model file that cannot be used as it is."""


class UnsupportedError(SysidBenchError):
    """Valid input that this method or robot does not support; its cell becomes `unsupported`."""


class SimulationError(SysidBenchError):
    """A simulation without finite result (NaN, divergence, unstable controller)."""


class EstimationError(SysidBenchError):
    """An estimator without result, with the reason; its cell becomes `failed`."""


def unknown_name(kind: str, name: str, known: Iterable[str], advice: str = "") -> UsageError:
    """Return an error that names the nearest existing `kind`, and lists all of them or, where there
    are many, the SHOWN nearest."""
    names = sorted(set(known))
    near = get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    listed = f" There are: {', '.join(names)}." if names else f" There is no {kind} at all."
    if len(names) > SHOWN:
        nearest = get_close_matches(name, names, n=SHOWN, cutoff=0.0)
        listed = f" The nearest of {len(names)}: {', '.join(nearest)}."
    return UsageError(
        f"No {kind} is called {name!r}.{hint}{listed}{' ' + advice if advice else ''}"
    )


def first_names(names: Iterable[str]) -> str:
    """Return the first three of names, each once, and the number of the others."""
    unique = list(dict.fromkeys(names))
    more = "" if len(unique) < 4 else f" and {len(unique) - 3} more"
    return ", ".join(unique[:3]) + more


def status_of(error: BaseException) -> str:
    """Return the status of a cell that ends with this error.

    Storage and quotas of the machine are `lost`: they say nothing about a method.
    """
    if isinstance(error, UnsupportedError):
        return "unsupported"
    if isinstance(error, MemoryError):
        return "memory"
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRORS:
        return "lost"
    return "failed"


def reason_of(error: BaseException) -> str:
    """Return the message on one line; errors of others with their type."""
    try:
        text = " ".join(str(error).split())[:1000]
    except Exception:  # __str__ of a plug-in's error may fail
        text = ""
    if isinstance(error, SysidBenchError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
