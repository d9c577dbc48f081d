"""What all conformance kits share: the loop over laws and cases, its findings, and the hash that
detects a changed input."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

Laws = Mapping[str, Callable[..., str | None]]
"""Law by name: (plug-in, case, its result) -> description of the violation, or None."""

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


@dataclass(frozen=True)
class Kit:
    """How plug-ins of a kind are checked on a case, which has a `name`.

    `run(plugin, case)` gives the result that laws look at; an exception of it violates the law
    `runs`. `laws(case, result)` are tables of laws, each checked where those before hold: later
    ones compute with arrays of the right shape. `given(case)` holds the arrays that the plug-in
    has to leave as they are, or `changed` is reported.
    """

    runs: str
    run: Callable[[Any, Any], Any]
    laws: Callable[[Any, Any], Iterable[Laws]]
    given: Callable[[Any], Any]
    changed: str

    def findings(self, plugin: Any, cases: Iterable[Any]) -> list[Finding]:
        """Findings of all laws on all cases."""
        return [finding for case in cases for finding in self._findings_on(plugin, case)]

    def _findings_on(self, plugin: Any, case: Any) -> list[Finding]:
        before = data_hash(self.given(case))
        found: list[Finding] = []
        try:
            result = self.run(plugin, case)
        except Exception as error:
            found.append(finding_of_error(error, self.runs, case.name))
        else:
            for laws in self.laws(case, result):
                found += findings_of(laws, case.name, plugin, case, result)
                if failed_checks(found):
                    break
        if data_hash(self.given(case)) != before:
            found.append(Finding(UNCHANGED, case.name, False, self.changed))
        return found


def findings_of(laws: Laws, case: str, *arguments: Any) -> list[Finding]:
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


def robot_of_kit(name: str, payload: str = "none") -> RobotModel:
    """The robot of a test case."""
    return loaded_robot(name, payload, None, None).robot


def motion_of_kit(
    robot: RobotModel, rate: float, period: float = 2.0, cycles: int = 1
) -> Trajectory:
    """A Fourier series of the robot's joints, sampled at `rate` (Hz), the same in each call."""
    brief = design_problem(robot, rate)
    return Fourier(period=period, cycles=cycles).design(brief, np.random.default_rng(1))


def without_error(error: Any) -> Any:
    """Return the error with the settings that its `sizes` names at zero.

    Raises UsageError for a plug-in that is not a dataclass or declares no sizes.
    """
    sizes = getattr(error, "sizes", ())
    if not sizes or not is_dataclass(error) or isinstance(error, type):
        raise UsageError(
            "A model or sensor error is a dataclass with the class attribute "
            "`sizes = ('position', ...)`: names of the settings that are zero without it."
        )
    return replace(error, **dict.fromkeys(sizes, 0.0))
