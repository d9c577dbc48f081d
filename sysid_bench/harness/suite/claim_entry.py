"""A [[claim]] of a suite: a published statement that rows can support or contradict."""

import math
from functools import partial
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainValidator, StrictBool, StrictStr, ValidationInfo
from pydantic import model_validator as checks

from sysid_bench.errors import unknown_name
from sysid_bench.harness.suite.checks import check_input, choice_of, list_values, value_of
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.report_entries import Folder, SuiteTable
from sysid_bench.metrics import METRICS
from sysid_bench.words import (
    CLAIM_LEVELS,
    CLAIM_STATISTICS,
    CLAIM_UNITS,
    DIRECTIONS,
    JOINT,
    LEFT_OUT,
    PAIRED,
    STD_FROM,
)

_CLAIMED = ("cell", "joint", "interval")  # levels of metrics


def _condition(rows: bool, text: Any, info: ValidationInfo) -> str:
    """A condition on lines: of cells, or of their joints and kinds of intervals."""
    if not isinstance(text, str):
        raise ValueError(f"a condition is a string; got {text!r}.")
    fields = check_input(info).row_fields | {JOINT, STD_FROM}
    fields |= set(METRICS) if rows else set()
    value_of(lambda: Expression.parse(text, fields))
    return text


def _metric(value: Any, info: ValidationInfo) -> str:
    known = {**METRICS, **check_input(info).metrics}
    words = [name for name, metric in known.items() if metric.level in _CLAIMED and not metric.text]
    if value not in words and not str(value).startswith("stats."):
        advice = "Or a number that a method returns: stats.NAME, as stats.duality_gap of lmi."
        raise ValueError(str(unknown_name("metric of a claim", str(value), words, advice)))
    return str(value)


def _limits(value: Any) -> tuple[float, ...]:
    limits = value if isinstance(value, (list, tuple)) else (value,)
    numbers = [x for x in limits if isinstance(x, (int, float)) and not isinstance(x, bool)]
    if len(numbers) != len(limits) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"a threshold is a number, or [low, high]; got {value!r}.")
    return tuple(map(float, numbers))


_Rows = Annotated[str, PlainValidator(partial(_condition, False))]
_Line = Annotated[str, PlainValidator(partial(_condition, True))]


class Claim(SuiteTable):
    """A claim, tested once for each of its levels, on rows of that plant.

    `ratio` and `difference` pair the rows of `select` with those of `against` that have the same
    labels but for what the two selections compare; `rank` ranks the method of `select` among those
    of `against`; `median` and `coverage` are of a metric, `share` is of the rows that meet `meets`,
    `left-out` of the values of parameters that the 90 % range of all other units holds.
    `over` is what is counted and drawn again: robots, or repeats of a claim on a single robot. Over
    cells there is no interval, and the claim stays open. A `gate` fails unless the claim holds.
    """

    name: Folder  # name in tables
    statement: StrictStr  # the statement in one sentence
    source: StrictStr  # publication
    select: _Rows | None = None  # condition on the rows that it is about
    against: _Rows | None = None  # condition on the rows compared with them
    statistic: Annotated[str, choice_of("statistic of a claim", CLAIM_STATISTICS)] = "ratio"
    """Number that is compared with the threshold."""
    metric: Annotated[str, PlainValidator(_metric)] | None = None
    """Metric, or a number that the method counts, as `stats.iterations`."""
    meets: _Line | None = None  # condition whose share is counted
    direction: Annotated[str, choice_of("direction", DIRECTIONS)] = "at most"
    """Side of the threshold on which it holds."""
    threshold: Annotated[tuple[float, ...], PlainValidator(_limits)] = ()
    """A number; two for `within`."""
    level: Annotated[
        tuple[Annotated[str, choice_of("level", CLAIM_LEVELS)], ...],
        BeforeValidator(list_values),
    ] = ()
    """Plants that it is tested on, one by one; default: all rows together."""
    over: Annotated[str, choice_of("unit of replication", CLAIM_UNITS)] = "robot"
    gate: StrictBool = False  # `run --gate` ends with code 1 where it fails
    missing: StrictStr | None = None
    """What the test needs and nothing here has: the claim is not testable."""

    @checks(mode="after")
    def _is_complete(self) -> "Claim":
        if self.missing is not None:
            if self.gate:
                raise ValueError("a claim that is not testable cannot be a gate.")
            return self
        needed = {
            "select": True,
            "against": self.statistic in PAIRED,
            "metric": self.statistic not in ("share", LEFT_OUT),
            "meets": self.statistic == "share",
        }
        for key, is_needed in needed.items():
            if (getattr(self, key) is not None) != is_needed:
                verb = "needs" if is_needed else "does not use"
                raise ValueError(f"the statistic {self.statistic!r} {verb} {key!r}.")
        self._check_threshold()
        return self

    def _check_threshold(self) -> None:
        count = 2 if self.direction == "within" else 1
        if len(self.threshold) != count or list(self.threshold) != sorted(self.threshold):
            raise ValueError(
                f"the direction {self.direction!r} needs a threshold of {count} "
                f"number{'s, the lower first' if count > 1 else ''}; got {list(self.threshold)}."
            )
