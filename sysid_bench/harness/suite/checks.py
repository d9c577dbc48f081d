"""Validators of the values of a suite file: units, words, names, conditions, sweeps."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    PlainValidator,
    StringConstraints,
    ValidationInfo,
)

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.names import Names, name_error
from sysid_bench.metrics import METRICS, ROW_FIELDS
from sysid_bench.types import Metric
from sysid_bench.units import quantity
from sysid_bench.words import CELL_FIELDS

Value = TypeVar("Value")


class SuiteTable(BaseModel):
    """A table of the suite file."""

    # Keys are documented where they stand: the comment behind a field and the text below it are its
    # meaning in the reference (reference/keys.py).
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class CheckInput:
    """Names, folder and fields that validators look up; one per reading of a suite."""

    def __init__(self, names: Names, folder: Path | None, settings: frozenset[str]) -> None:
        self.names, self.folder = names, folder
        self.cell_fields = CELL_FIELDS | settings
        self.row_fields = ROW_FIELDS | settings
        self.metrics: dict[str, Metric] = {}  # of [[metric]], read before anything names them

    def add_metric(self, metric: Metric) -> Metric:
        """Make a plug-in's metric known to tables, rankings and conditions on rows."""
        if metric.name in self.row_fields or metric.name in self.metrics:
            raise UsageError(f"The metric name {metric.name!r} is used already; choose another.")
        self.metrics[metric.name] = metric
        # Before the tables and conditions that name it: pydantic checks keys in the order of Suite.
        self.row_fields |= {metric.name}
        return metric


def check_input(info: ValidationInfo) -> CheckInput:
    return cast(CheckInput, info.context)


def value_of(check: Callable[[], Value]) -> Value:
    """Return the value of a check. Whatever it or a plug-in raises becomes a ValueError, because
    pydantic collects those alone."""
    try:
        return check()
    except (Exception, SystemExit) as error:  # the file of a plug-in may call sys.exit()
        raise ValueError(name_error(error)) from error


@dataclass(frozen=True)
class Quantity:
    """Check of a quantity with its unit: 0 or more, `positive`, and `below` a number."""

    unit: str
    positive: bool = False
    below: float = math.inf

    def __call__(self, value: Any) -> Any:
        """Return the value as written."""
        # Checked here and kept as written: a frozen suite and its labels show what the user wrote.
        number = value_of(partial(quantity, value, self.unit))
        if number < 0 or (self.positive and number == 0):
            least = "positive" if self.positive else "0 or more"
            raise ValueError(f"must be {least}; got {value!r}.")
        # Not `number >= below`: NaN is refused, too.
        if not number < self.below:
            raise ValueError(f"must be below {self.below:g}; got {value!r}.")
        return value

    @property
    def words(self) -> str:
        """Description for the reference."""
        units = " or ".join(self.unit.split("|"))
        kind = "number" if self.unit == "1" else f"quantity in {units}"
        return f"{kind}, {'positive' if self.positive else '0 or more'}"


@dataclass(frozen=True)
class Choice:
    """Check of one of a few words; `kind` names what they are."""

    kind: str
    words: tuple[str, ...]

    def __call__(self, value: Any) -> Any:
        """Return the word."""
        if value not in self.words:
            raise ValueError(str(unknown_name(self.kind, str(value), self.words)))
        return value


@dataclass(frozen=True)
class MetricChoice:
    """Check of metric names: built-in ones and those of [[metric]] that `accepts` takes."""

    kind: str
    accepts: Callable[[Metric], bool]

    def __call__(self, value: Any, info: ValidationInfo) -> Any:
        """Return the name."""
        there = (*METRICS.values(), *check_input(info).metrics.values())
        words = [metric.name for metric in there if self.accepts(metric)]
        if value not in words:
            raise ValueError(str(unknown_name(self.kind, str(value), words)))
        return value


def quantity_of(unit: str, positive: bool = False, below: float = math.inf) -> PlainValidator:
    return PlainValidator(Quantity(unit, positive, below))


def choice_of(kind: str, words: tuple[str, ...]) -> BeforeValidator:
    return BeforeValidator(Choice(kind, words))


def list_of(value: Any) -> Any:
    """Return a sweep: a list as it is, anything else as a sweep of one value."""
    # One value needs no brackets in a suite, and is a sweep nevertheless.
    values = list_values(value)
    if not values:
        raise ValueError("an empty sweep leaves nothing to run; give a value or drop the key.")
    return values


def list_values(value: Any) -> Any:
    """Return a tuple of one value or of a list, which may be empty."""
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


def key_list(value: Any) -> Any:
    """Return a sweep of values that are lists themselves: a list of lists is a sweep."""
    lists = (list, tuple)
    is_sweep = isinstance(value, lists) and value
    if is_sweep and all(one is None or isinstance(one, lists) for one in value):
        return tuple(None if one is None else tuple(one) for one in value)
    return (tuple(value) if isinstance(value, lists) else value,)


def plugin_kind(value: Any) -> str:
    return "table" if isinstance(value, (dict, BaseModel)) else "word"


def condition(row: bool, text: Any, info: ValidationInfo) -> str:
    context = check_input(info)
    if not isinstance(text, str):
        raise ValueError(f"a condition is a string; got {text!r}.")
    value_of(lambda: Expression.parse(text, context.row_fields if row else context.cell_fields))
    return text


Sweep = Annotated[tuple[Value, ...], BeforeValidator(list_of)]
ListSweep = Annotated[tuple[Value, ...], BeforeValidator(key_list)]
"""Sweep of values that are lists themselves."""
ListOf = Annotated[tuple[Value, ...], BeforeValidator(list_values)]
RowCondition = Annotated[str, PlainValidator(partial(condition, True))]
Folder = Annotated[str, StringConstraints(strict=True, pattern=r"^[A-Za-z0-9_][A-Za-z0-9._-]*$")]
