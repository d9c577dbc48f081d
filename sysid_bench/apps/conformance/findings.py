"""Findings of a conformance kit, and the hash that detects a changed input."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import reason_of
from sysid_bench.types import Array

UNCHANGED: Final = "leaves its input unchanged"
"""Name of the law that every kit has."""


@dataclass(frozen=True)
class Finding:
    """Result of one law on one test case; `message` describes the violation where `passed` is
    False."""

    law: str
    case: str
    passed: bool
    message: str = ""


def failed_checks(findings: Sequence[Finding]) -> list[str]:
    """Violated laws, one line each."""
    return [f"{f.law} ({f.case}): {f.message}" for f in findings if not f.passed]


def findings_of(
    laws: Mapping[str, Callable[..., str | None]], case: str, *arguments: Any
) -> list[Finding]:
    """Findings of all laws on one case; each law is called with the arguments and returns a
    description of the violation or None. An exception that a law meets violates that law."""
    findings = []
    for name, law in laws.items():
        try:
            message = law(*arguments)
        except Exception as error:
            message = f"it raised {reason_of(error)}"
        findings.append(Finding(name, case, message is None, message or ""))
    return findings


def finding_of_error(error: Exception, law: str, case: str) -> Finding:
    """Finding of an exception: writing to a read-only array violates UNCHANGED, not `law`."""
    name = UNCHANGED if "read-only" in str(error) else law
    return Finding(name, case, False, f"it raised {reason_of(error)}")


def data_hash(value: Any) -> str:
    """Hash of all arrays that a value holds, through tuples, lists, partials and dataclasses."""
    total = hashlib.sha256()
    for array in _arrays(value):
        # Transposed and strided views have no bytes of their own.
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def _arrays(value: Any) -> Iterator[Array]:
    if isinstance(value, np.ndarray):
        yield value
    for part in _parts(value):
        yield from _arrays(part)


def _parts(value: Any) -> Sequence[Any]:
    """Contents of a container; nothing for other values."""
    if isinstance(value, partial):
        return value.args
    if isinstance(value, (tuple, list)):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return [getattr(value, field.name) for field in fields(value)]
    return ()


def shape_error(name: str, array: Array, shape: tuple[int, ...]) -> str | None:
    """Violation where an array has another shape, or values that are not finite."""
    if array.shape != shape:
        return f"{name} has the shape {array.shape}; expected {shape}"
    return None if np.isfinite(array).all() else f"{name} has values that are not finite"


def first_error(errors: Iterable[str | None]) -> str | None:
    """The first violation of several checks."""
    return next(filter(None, errors), None)
