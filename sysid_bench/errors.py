"""One root error. Every message says what came, what there is, and what to do."""

from collections.abc import Iterable
from difflib import get_close_matches


class SysidBenchError(Exception):
    """Anything this package refuses; `str(error)` is one readable paragraph."""


class UsageError(SysidBenchError):
    """Wrong words: an unknown name, a broken suite, a value out of range (exit code 2)."""


class ModelError(SysidBenchError):
    """A robot, payload or model file that cannot be used as it is."""


class UnsupportedError(SysidBenchError):
    """A sound request that this method or robot cannot serve; its cell becomes `unsupported`."""


class SimulationError(SysidBenchError):
    """The simulated robot left the numbers (NaN, divergence, unstable controller)."""


class EstimationError(SysidBenchError):
    """An estimator says why it could not estimate; its cell becomes `failed`."""


def unknown_name(kind: str, name: str, known: Iterable[str], advice: str = "") -> UsageError:
    """An error that names the nearest existing `kind` first and lists all of them."""
    names = sorted(set(known))
    near = get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    there = f" There are: {', '.join(names)}." if names else f" There is no {kind} at all."
    return UsageError(f"No {kind} is called {name!r}.{hint}{there}{' ' + advice if advice else ''}")


def first_names(names: Iterable[str]) -> str:
    """The first three of names, each once, and how many more there are."""
    each = list(dict.fromkeys(names))
    more = "" if len(each) < 4 else f" and {len(each) - 3} more"
    return ", ".join(each[:3]) + more


def reason_of(error: BaseException) -> str:
    """One line: our own errors speak for themselves, others with their type."""
    try:
        text = " ".join(str(error).split())[:1000]
    except Exception:  # a stranger's __str__
        text = ""
    if isinstance(error, SysidBenchError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
