"""Grammar of --select, `[[exclude]] when` and `[record] when`.

`robot == "panda" and noise.tau < 0.01`, `estimator in ["ols", "wls"]`, `not robot.free_base`.
Python's parser reads the text; this module interprets the tree, without eval.
"""

import ast
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.units import parse_quantity, quantity

_WORDS: Final = {"true": True, "false": False, "none": None}
_ORDER: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], bool]]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_KNOWN: Final[tuple[type[ast.cmpop], ...]] = (ast.Eq, ast.NotEq, ast.In, ast.NotIn, *_ORDER)
_GRAMMAR: Final = (
    "Write comparisons (== != < <= > >= in, not in) of fields with strings, numbers, true, false, "
    "none or lists, joined by and, or, not and parentheses."
)


@dataclass(frozen=True)
class Expression:
    """A condition on a cell. `fields` are the names it reads."""

    text: str
    fields: frozenset[str]
    _tree: ast.expr = field(repr=False, compare=False)

    @classmethod
    def parse(cls, text: str, known: Iterable[str] | None = None) -> "Expression":
        """Read a condition; raises UsageError outside the grammar or for fields not in `known`."""
        tree = _read(text)
        fields: set[str] = set()
        try:
            _check(tree, text, fields)
            _holds(tree, {})
        except RecursionError as error:
            raise UsageError(f"A condition of {len(text)} letters is nested too deeply.") from error
        if known is not None:
            names = sorted(set(known))
            for name in sorted(fields.difference(names)):
                advice = "A string needs quotes." if "." not in name else ""
                raise unknown_name(f"field in {text!r}", name, names, advice)
        return cls(text, frozenset(fields), tree)

    @property
    def text_values(self) -> list[tuple[str, str]]:
        """Return (field, text) of every comparison for equality with a string."""
        found = []
        for node in ast.walk(self._tree):
            if not isinstance(node, ast.Compare):
                continue
            sides = [node.left, *node.comparators]
            for op, left, right in zip(node.ops, sides, sides[1:], strict=False):
                if isinstance(op, (ast.Eq, ast.In)):
                    field, value = (right, left) if _is_literal(left) else (left, right)
                    literal = _literal(value)
                    texts = literal if isinstance(literal, list) else [literal]
                    found += [(_name(field, ""), text) for text in texts if isinstance(text, str)]
        return found

    def holds(self, cell: Mapping[str, Any]) -> bool:
        """Return whether a cell, a flat mapping with dotted keys, meets the condition.

        An absent field or None meets `== none` alone. A tuple holds alternative names: one that
        meets the condition suffices.
        """
        return _holds(self._tree, cell)


def _read(text: str) -> ast.expr:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python warns of escapes in strings
            return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UsageError(f"{text!r} cannot be read as a condition. {_GRAMMAR}") from error


def _check(node: ast.expr, text: str, fields: set[str]) -> None:
    match node:
        case ast.BoolOp(values=parts):
            for part in parts:
                _check(part, text, fields)
        case ast.UnaryOp(op=ast.Not(), operand=part):
            _check(part, text, fields)
        case ast.Compare(left=left, ops=ops, comparators=rights):
            _check_comparison([left, *rights], ops, text, fields)
        case ast.Name() | ast.Attribute() if not _is_literal(node):
            fields.add(_name(node, text))
        case ast.Constant(value=bool()) | ast.Name():
            pass
        case _:
            raise UsageError(f"{_source(node)!r} in {text!r} is not a condition. {_GRAMMAR}")


def _check_comparison(
    sides: list[ast.expr], ops: list[ast.cmpop], text: str, fields: set[str]
) -> None:
    for op, left, right in zip(ops, sides, sides[1:], strict=False):
        if not isinstance(op, _KNOWN):
            raise UsageError(f"{text!r} has an unknown comparison. {_GRAMMAR}")
        named = [side for side in (left, right) if not _is_literal(side)]
        if len(named) != 1:
            raise UsageError(
                f"{_source(left)!r} and {_source(right)!r} in {text!r}: a comparison needs one "
                "field and one value; a string needs quotes."
            )
        fields.add(_name(named[0], text))
        if isinstance(op, (ast.In, ast.NotIn)) and (
            named[0] is right or not isinstance(right, (ast.List, ast.Tuple))
        ):
            raise UsageError(f"'in' in {text!r} needs a list on its right: [1, 2].")


def _is_literal(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value=value):
            return value is None or isinstance(value, (bool, int, float, str))
        case ast.Name(id=word):
            return word in _WORDS
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float())):
            return True
        case ast.List(elts=parts) | ast.Tuple(elts=parts):
            return all(_is_literal(part) for part in parts)
    return False


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=value):
            return value
        case ast.Name(id=word):
            return _WORDS[word]
        case ast.UnaryOp(operand=ast.Constant(value=int() | float() as number)):
            return -number
        case ast.List(elts=parts) | ast.Tuple(elts=parts):
            return [_literal(part) for part in parts]
    raise AssertionError(node)  # refused by _check before


def _name(node: ast.expr, text: str) -> str:
    match node:
        case ast.Name(id=word):
            return word
        case ast.Attribute(value=inner, attr=word):
            return f"{_name(inner, text)}.{word}"
    raise UsageError(f"{_source(node)!r} in {text!r} is neither a field nor a value. {_GRAMMAR}")


def _source(node: ast.expr) -> str:
    return ast.unparse(node)


def _holds(node: ast.expr, cell: Mapping[str, Any]) -> bool:
    match node:
        case ast.BoolOp(op=ast.And(), values=parts):
            return all(_holds(part, cell) for part in parts)
        case ast.BoolOp(values=parts):
            return any(_holds(part, cell) for part in parts)
        case ast.UnaryOp(operand=part):
            return not _holds(part, cell)
        case ast.Compare(left=left, ops=ops, comparators=rights):
            sides = [left, *rights]
            pairs = zip(ops, sides, sides[1:], strict=False)
            return all(_compare(op, a, b, cell) for op, a, b in pairs)
    return bool(_literal(node) if _is_literal(node) else cell.get(_name(node, "")))


def _compare(op: ast.cmpop, left: ast.expr, right: ast.expr, cell: Mapping[str, Any]) -> bool:
    if _is_literal(left):
        literal, value = _literal(left), cell.get(_name(right, ""))
    else:
        literal, value = _literal(right), cell.get(_name(left, ""))
    if literal is None:
        return isinstance(op, (ast.Eq, ast.NotEq)) and (value is None) == isinstance(op, ast.Eq)
    if value is None:
        return False
    match op:
        case ast.Eq():
            return _equal(value, literal)
        case ast.NotEq():
            return not _equal(value, literal)
        case ast.In():
            return any(_equal(value, item) for item in literal)
        case ast.NotIn():
            return not any(_equal(value, item) for item in literal)
    order = _ORDER[type(op)]
    return _ordered(order, literal, value) if _is_literal(left) else _ordered(order, value, literal)


def _equal(value: Any, literal: Any) -> bool:
    if isinstance(value, tuple):
        return any(_equal(name, literal) for name in value)
    if value == literal:
        return True
    a, b = _number(value), _number(literal)
    return a is not None and b is not None and abs(a - b) <= 1e-12 * max(abs(a), abs(b))


def _ordered(order: Callable[[Any, Any], bool], left: Any, right: Any) -> bool:
    a, b = _number(left), _number(right)
    return a is not None and b is not None and order(a, b)


def _number(value: Any) -> float | None:
    """Return the number, in SI units for a quantity ("0.5 %" is 0.005); None for other strings."""
    try:
        if isinstance(value, (int, float)):
            return float(value)
        if not isinstance(value, str):
            return None
        number, unit = parse_quantity(value)
        return quantity(value, unit) if unit else number
    except (UsageError, OverflowError):
        return None
