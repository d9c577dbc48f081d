"""What rankings and claims of a suite can decide with the robots that are planned."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, cast

from sysid_bench.errors import count_text
from sysid_bench.evaluation.robot_statistic import (
    ClaimInterval,
    Direction,
    robots_needed,
    units_needed,
)
from sysid_bench.harness.cell import Cell, fields
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.model import Suite
from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.words import FRAME_DEPENDENT


def _selected(cells: Iterable[Cell], condition: str | None) -> list[Cell]:
    """Cells that meet a condition on rows, as far as a plan knows: one on what only rows have
    counts as met."""
    if condition is None:
        return list(cells)
    expression = Expression.parse(condition)
    flat = [(cell, fields(cell)) for cell in cells]
    known = set[str]().union(*(one for _, one in flat))
    met = [cell for cell, one in flat if expression.holds(one)]
    return met if expression.fields <= known else [cell for cell, _ in flat]


def not_ranked(cells: Iterable[Cell]) -> set[str]:
    """Labels of the built-in methods that rankings leave out, since they depend on the frames of
    the links; plug-ins are asked in the run alone."""
    uses = {cell.labels["estimator"]: str(cell.estimator["use"]) for cell in cells}
    return {
        label
        for label, use in uses.items()
        if use in BUILTIN["estimator"]
        and getattr(resolve("estimator", use), FRAME_DEPENDENT, False)
    }


def ranking_power(suite: Suite, cells: Sequence[Cell]) -> Iterator[str]:
    """Yield how many robots the verdicts of the rankings need, corrected together, and the rankings
    that have fewer."""
    cells = [cell for cell in cells if cell.spec.repeat == 0]
    verdicts, robots, unranked = 0, dict[str, int](), not_ranked(cells)
    for entry in suite.ranking:
        groups: dict[tuple[str, ...], list[Cell]] = {}
        for cell in _selected(cells, entry.select):
            groups.setdefault(tuple(cell.labels[one] for one in entry.apart), []).append(cell)
        for key, group in groups.items():
            methods = {cell.labels["estimator"] for cell in group}
            methods &= set(entry.family or methods)
            verdicts += len(methods - unranked - {entry.against})
            robots["-".join((entry.name, *key))] = len({cell.labels["robot"] for cell in group})
    if not verdicts:
        return
    needed = robots_needed(verdicts)
    few = [f"{name} ({count})" for name, count in robots.items() if count < needed]
    yield (
        f"Rankings: {count_text(verdicts, 'verdict')}, corrected together; the first needs "
        f"{needed} robots that all agree."
        + (f" Nothing can be decided in {', '.join(few)}." if few else "")
    )


_PLANNED: Final = ("robot", "payload", "excitation", "repeat")
"""Units of claims that a plan counts; joints stand in rows alone."""


def claim_power(suite: Suite, cells: Sequence[Cell]) -> Iterator[str]:
    """Yield the claims that cannot hold with the units that are planned, and what they need."""
    few = []
    for claim in suite.claim:
        if claim.exact or claim.withdrawn or claim.missing or claim.over not in _PLANNED:
            continue
        threshold = ClaimInterval.of(cast(Direction, claim.direction), claim.threshold)
        needed = units_needed(claim.statistic, threshold)
        chosen = _selected(cells, claim.select)
        for level in claim.level or (None,):
            of = [one for one in chosen if level is None or one.labels["plant"] == level]
            units = {
                one.spec.repeat if claim.over == "repeat" else one.labels[claim.over] for one in of
            }
            if needed is None or len(units) < needed:
                text = "no number" if needed is None else str(needed)
                where = f"{claim.name}{f' at {level}' if level else ''}"
                few.append(f"{where} ({count_text(len(units), claim.over)}, needs {text})")
    if few:
        yield f"Claims that cannot hold with what is planned: {', '.join(few)}."
