"""Grammar of --select, `[[exclude]] when` and `[record] when`.

`robot == "panda" and noise.tau < 0.01`, `estimator in ["ols", "wls"]`, `not robot.free_base`.
Python's parser reads the text; this module interprets the tree, without eval.
"""

import ast
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
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
_OF_LIST: Final = (ast.In, ast.NotIn)
_KNOWN: Final[tuple[type[ast.cmpop], ...]] = (ast.Eq, ast.NotEq, *_OF_LIST, *_ORDER)
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
            _check_known(text, fields, sorted(set(known)))
        return cls(text, frozenset(fields), tree)

    @property
    def text_values(self) -> list[tuple[str, str]]:
        """Return (field, text) of every comparison for equality with a string."""
        nodes = (node for node in ast.walk(self._tree) if isinstance(node, ast.Compare))
        compared = chain.from_iterable(map(_comparisons, nodes))
        texts = (_texts(a, b) for op, a, b in compared if isinstance(op, (ast.Eq, ast.In)))
        return list(chain.from_iterable(texts))

    def holds(self, cell: Mapping[str, Any]) -> bool:
        """Return whether a cell, a flat mapping with dotted keys, meets the condition.

        An absent field or None meets `== none` alone. A tuple holds alternative names: one that
        meets the condition suffices.
        """
        return _holds(self._tree, cell)


def _check_known(text: str, fields: set[str], known: list[str]) -> None:
    for name in sorted(fields.difference(known)):
        advice = "A string needs quotes." if "." not in name else ""
        raise unknown_name(f"field in {text!r}", name, known, advice)


def _comparisons(node: ast.Compare) -> Iterator[tuple[ast.cmpop, ast.expr, ast.expr]]:
    """Return each operator of a comparison with its two sides: of a < b < c, two."""
    sides = [node.left, *node.comparators]
    return zip(node.ops, sides, sides[1:], strict=False)


def _field_first(left: ast.expr, right: ast.expr) -> tuple[ast.expr, ast.expr]:
    """Return the field and the value that a comparison has on its two sides."""
    return (right, left) if _is_literal(left) else (left, right)


def _texts(left: ast.expr, right: ast.expr) -> list[tuple[str, str]]:
    """Return (field, text) for each string that a field is compared with."""
    field, value = _field_first(left, right)
    literal = _literal(value)
    words = literal if isinstance(literal, list) else [literal]
    return [(_name(field, ""), word) for word in words if isinstance(word, str)]


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
        case ast.Compare():
            for op, left, right in _comparisons(node):
                fields.add(_checked_field(op, left, right, text))
        case ast.Name() | ast.Attribute() if not _is_literal(node):
            fields.add(_name(node, text))
        case ast.Constant(value=bool()) | ast.Name():
            pass
        case _:
            raise UsageError(f"{_source(node)!r} in {text!r} is not a condition. {_GRAMMAR}")


def _checked_field(op: ast.cmpop, left: ast.expr, right: ast.expr, text: str) -> str:
    """Return the field of a comparison; raise UsageError for one outside the grammar."""
    if not isinstance(op, _KNOWN):
        raise UsageError(f"{text!r} has an unknown comparison. {_GRAMMAR}")
    if _is_literal(left) == _is_literal(right):
        raise UsageError(
            f"{_source(left)!r} and {_source(right)!r} in {text!r}: a comparison needs one "
            "field and one value; a string needs quotes."
        )
    field, value = _field_first(left, right)
    name = _name(field, text)
    if isinstance(op, _OF_LIST) and (value is left or not isinstance(value, (ast.List, ast.Tuple))):
        raise UsageError(f"'in' in {text!r} needs a list on its right: [1, 2].")
    return name


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
        case ast.Compare():
            return all(_compare(op, a, b, cell) for op, a, b in _comparisons(node))
    return bool(_literal(node) if _is_literal(node) else cell.get(_name(node, "")))


def _compare(op: ast.cmpop, left: ast.expr, right: ast.expr, cell: Mapping[str, Any]) -> bool:
    field, written = _field_first(left, right)
    literal, value = _literal(written), cell.get(_name(field, ""))
    if literal is None:
        return isinstance(op, (ast.Eq, ast.NotEq)) and (value is None) == isinstance(op, ast.Eq)
    if value is None:
        return False
    if order := _ORDER.get(type(op)):
        return _ordered(order, *((value, literal) if field is left else (literal, value)))
    wanted = literal if isinstance(op, _OF_LIST) else [literal]
    is_found = any(_equal(value, item) for item in wanted)
    return is_found != isinstance(op, (ast.NotEq, ast.NotIn))


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
