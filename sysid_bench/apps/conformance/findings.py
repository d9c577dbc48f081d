"""Common parts of conformance kits: laws, the loop over them and over cases, its findings, and the
hash that detects a changed input."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Trajectory

UNCHANGED: Final = "leaves its input unchanged"
"""Name of the law that every kit has."""

C = TypeVar("C", bound="KitCase")


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


class Law:
    """Decorator of the methods of a kit that are laws: each returns a description of the violation,
    or None. `first`: the others are checked where it holds, and compute with arrays of the right
    shape. `of`: kinds of results that have to keep it; none named: all but "none"."""

    check: Callable[[Any], str | None]

    def __init__(self, name: str, first: bool = False, of: Sequence[str] = ()) -> None:
        self.name, self.first, self.of = name, first, of

    def __call__(self, check: Callable[[Any], str | None]) -> "Law":
        self.check = check
        return self


@dataclass(frozen=True, eq=False)
class KitCase:
    """Case on which a plug-in is checked."""

    name: str


@dataclass(frozen=True, eq=False)
class RobotMotion(KitCase):
    """A robot and a motion of its joints."""

    robot: RobotModel
    motion: Trajectory


class Kit(Generic[C]):
    """The laws of a kind of plug-in, and what they are checked with: a plug-in, a case, and the
    `result` that `run` gives, whose exceptions violate the law `runs`."""

    runs: ClassVar[str]
    changed: ClassVar[str] = "it changed its input"

    def __init__(self, plugin: Any, case: C) -> None:
        self.plugin, self.case = plugin, case
        self.result: Any = None

    def run(self) -> Any:
        """Result that laws look at."""
        return None

    def kind(self) -> str:
        """Kind of the result: it selects laws; there are none for "none"."""
        return ""

    def given(self) -> Any:
        """Holder of the arrays that the plug-in has to leave unchanged."""
        return ()

    def findings(self) -> list[Finding]:
        """Findings of all laws that apply."""
        before, name = data_hash(self.given()), self.case.name
        found: list[Finding] = []
        try:
            self.result = self.run()
        except Exception as error:
            found.append(finding_of_error(error, self.runs, name))
        else:
            laws = self._laws(self.kind())
            # Shapes first: the other laws would raise on a result of another shape.
            for part in (True, False):
                if not failed_checks(found):
                    found += [self._finding(law) for law in laws if law.first == part]
        if data_hash(self.given()) != before:
            found.append(Finding(UNCHANGED, name, False, self.changed))
        return found

    def _laws(self, kind: str) -> list[Law]:
        """Laws on results of a kind; those of no kind hold for all but "none"."""
        laws = [one for one in vars(type(self)).values() if isinstance(one, Law)]
        return [law for law in laws if kind in law.of or (not law.of and kind != "none")]

    def _finding(self, law: Law) -> Finding:
        """An exception that a law meets violates that law."""
        try:
            message = law.check(self)
        except Exception as error:
            message = f"it raised {reason_of(error)}"
        return Finding(law.name, self.case.name, message is None, message or "")

    @classmethod
    def check(cls, plugin: Any, cases: Iterable[C]) -> list[Finding]:
        """Findings on all cases."""
        return [finding for case in cases for finding in cls(plugin, case).findings()]


def finding_of_error(error: Exception, law: str, case: str) -> Finding:
    """Finding of an exception: writing to a read-only array violates UNCHANGED, not `law`."""
    # NumPy's words for writing into a locked array, as those of an experiment are.
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
    parts: Sequence[Any] = ()
    if isinstance(value, partial):
        parts = value.args
    elif isinstance(value, (tuple, list)):
        parts = value
    elif is_dataclass(value) and not isinstance(value, type):
        parts = [getattr(value, field.name) for field in fields(value)]
    for part in parts:
        yield from _arrays(part)


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


@cache
def robots_in_motion(*named: tuple[str, str]) -> tuple[RobotMotion, ...]:
    """Robots (name, payload), each along a motion sampled at 50 Hz; the same ones in each call."""
    robots = [(name, robot_of_kit(name, payload)) for name, payload in named]
    return tuple(RobotMotion(name, robot, motion_of_kit(robot, 50.0)) for name, robot in robots)


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
