"""Grammar of --select, `[[exclude]] when` and `[record] when`.

`robot == "panda" and noise.tau < 0.01`, `estimator in ["ols", "wls"]`, `not robot.free_base`.
Python's parser reads the text; functions are made from the tree, without eval.
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
_FIELD: Final = object()
"""In place of the value of what is not a literal."""
_GRAMMAR: Final = (
    "Write comparisons (== != < <= > >= in, not in) of fields with strings, numbers, true, false, "
    "none or lists, joined by and, or, not and parentheses."
)
_Condition = Callable[[Mapping[str, Any]], bool]


@dataclass(frozen=True)
class Expression:
    """A condition on a cell. `fields` are the names it reads, `text_values` the (field, text) of
    every comparison for equality with a string."""

    text: str
    fields: frozenset[str]
    text_values: tuple[tuple[str, str], ...]
    _holds: _Condition = field(repr=False, compare=False)

    @classmethod
    def parse(cls, text: str, known: Iterable[str] | None = None) -> "Expression":
        """Read a condition; raises UsageError outside the grammar or for fields not in `known`."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Python warns of escapes in strings
                tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise UsageError(f"{text!r} cannot be read as a condition. {_GRAMMAR}") from error
        # Functions from a checked tree, and no eval: suites come from other people.
        reader = _Reader(text)
        try:
            holds = reader.condition(tree)
            # Once now: a nesting that is too deep fails here, and not in the first cell.
            holds({})
        except RecursionError as error:
            raise UsageError(f"A condition of {len(text)} letters is nested too deeply.") from error
        there = reader.fields if known is None else set(known)
        for name in sorted(reader.fields - there):
            advice = "A string needs quotes." if "." not in name else ""
            raise unknown_name(f"field in {text!r}", name, sorted(there), advice)
        return cls(text, frozenset(reader.fields), tuple(reader.text_values), holds)

    def holds(self, cell: Mapping[str, Any]) -> bool:
        """Return whether a cell, a flat mapping with dotted keys, meets the condition.

        An absent field or None meets `== none` alone. A tuple holds alternative names: one that
        meets the condition suffices.
        """
        return self._holds(cell)


class _Reader:
    """Conditions from the syntax tree of a text, and what they read."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.fields = set[str]()
        self.text_values = list[tuple[str, str]]()

    def condition(self, node: ast.expr) -> _Condition:
        match node:
            case ast.BoolOp(op=op, values=values):
                parts, quantifier = list(map(self.condition, values)), all
                if isinstance(op, ast.Or):
                    quantifier = any
                return lambda cell: quantifier(holds(cell) for holds in parts)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                inner = self.condition(operand)
                return lambda cell: not inner(cell)
            case ast.Compare(left=left, ops=ops, comparators=others):
                pairs = zip(ops, [left, *others], others, strict=False)  # of a < b < c, two
                both = [self.comparison(*pair) for pair in pairs]
                return lambda cell: all(holds(cell) for holds in both)
            case ast.Constant(value=bool()) | ast.Name(id="true" | "false" | "none"):
                value = bool(_literal(node))
                return lambda cell: value
            case ast.Name() | ast.Attribute():
                name = self.name(node)
                self.fields.add(name)
                return lambda cell: bool(cell.get(name))
        raise UsageError(f"{ast.unparse(node)!r} in {self.text!r} is not a condition. {_GRAMMAR}")

    def comparison(self, op: ast.cmpop, left: ast.expr, right: ast.expr) -> _Condition:
        if not isinstance(op, _KNOWN):
            raise UsageError(f"{self.text!r} has an unknown comparison. {_GRAMMAR}")
        is_field_first = _literal(left) is _FIELD
        if is_field_first == (_literal(right) is _FIELD):
            raise UsageError(
                f"{ast.unparse(left)!r} and {ast.unparse(right)!r} in {self.text!r}: a comparison "
                "needs one field and one value; a string needs quotes."
            )
        name = self.name(left if is_field_first else right)
        literal = _literal(right if is_field_first else left)
        in_list = isinstance(op, (ast.In, ast.NotIn))
        if in_list and not (is_field_first and isinstance(literal, list)):
            raise UsageError(f"'in' in {self.text!r} needs a list on its right: [1, 2].")
        self.fields.add(name)
        wanted = literal if in_list else [literal]
        if isinstance(op, (ast.Eq, ast.In)):
            self.text_values += [(name, word) for word in wanted if isinstance(word, str)]
        is_negated = isinstance(op, (ast.NotEq, ast.NotIn))

        def holds(cell: Mapping[str, Any]) -> bool:
            value = cell.get(name)
            if literal is None:
                return isinstance(op, (ast.Eq, ast.NotEq)) and (value is not None) == is_negated
            # `!=` does not select cells that lack the field, either.
            if value is None:
                return False
            if order := _ORDER.get(type(op)):
                a, b = _number(value), _number(literal)
                if a is None or b is None:
                    return False
                return order(a, b) if is_field_first else order(b, a)
            return any(_equal(value, item) for item in wanted) != is_negated

        return holds

    def name(self, node: ast.expr) -> str:
        """Dotted name of a field."""
        match node:
            case ast.Name(id=word):
                return word
            case ast.Attribute(value=inner, attr=word):
                return f"{self.name(inner)}.{word}"
        raise UsageError(
            f"{ast.unparse(node)!r} in {self.text!r} is neither a field nor a value. {_GRAMMAR}"
        )


def _literal(node: ast.expr) -> Any:
    """Value of a literal, `_FIELD` for anything else."""
    match node:
        case ast.Constant(value=None | bool() | int() | float() | str() as value):
            return value
        case ast.Name(id=word):
            return _WORDS.get(word, _FIELD)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as number)):
            return -number
        case ast.List(elts=parts) | ast.Tuple(elts=parts):
            values = list(map(_literal, parts))
            return _FIELD if _FIELD in values else values
    return _FIELD


def _equal(value: Any, literal: Any) -> bool:
    # Alternative names of one thing: any of them may be meant.
    if isinstance(value, tuple):
        return any(_equal(name, literal) for name in value)
    if value == literal:
        return True
    a, b = _number(value), _number(literal)
    # "0.5 %" is 0.005 up to the rounding of its conversion.
    return a is not None and b is not None and abs(a - b) <= 1e-12 * max(abs(a), abs(b))


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
