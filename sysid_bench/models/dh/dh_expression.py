"""Expressions in the cells of a Denavit-Hartenberg table: "-q2 + pi/2", "2*a2", "-60*deg".

They are parsed, never evaluated as Python. A value is a constant plus a coefficient for each joint
variable in it."""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from sysid_bench.errors import UsageError

CONSTANTS: Final = {"pi": math.pi, "deg": math.pi / 180.0}

_SIGNS: Final[dict[type[ast.unaryop], float]] = {ast.UAdd: 1.0, ast.USub: -1.0}
_OPERATORS: Final[dict[type[ast.operator], "_Operator"]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_NOT_READ: Final = (
    *(ArithmeticError, RecursionError, MemoryError, SyntaxError, TypeError, ValueError),
)
_NOT_LINEAR: Final = "it is not linear in the joint variables"


@dataclass(frozen=True)
class LinearExpression:
    """constant + sum of coefficients times joint variables."""

    constant: float
    coefficients: Mapping[str, float] = field(default_factory=dict)

    def __add__(self, other: "LinearExpression") -> "LinearExpression":
        names = dict.fromkeys([*self.coefficients, *other.coefficients])
        total = {n: self.coefficients.get(n, 0.0) + other.coefficients.get(n, 0.0) for n in names}
        return LinearExpression(
            self.constant + other.constant, {n: value for n, value in total.items() if value}
        )

    def __sub__(self, other: "LinearExpression") -> "LinearExpression":
        return self + other.scaled(-1.0)

    def __mul__(self, other: "LinearExpression") -> "LinearExpression":
        if not other.coefficients:
            return self.scaled(other.constant)
        return other.scaled(self._number())

    def __truediv__(self, other: "LinearExpression") -> "LinearExpression":
        return self.scaled(1.0 / other._number())

    def __pow__(self, other: "LinearExpression") -> "LinearExpression":
        return LinearExpression(float(self._number() ** other._number()))

    def scaled(self, factor: float) -> "LinearExpression":
        """Return the expression multiplied by a number."""
        scaled = {name: factor * value for name, value in self.coefficients.items()}
        return LinearExpression(factor * self.constant, scaled)

    def _number(self) -> float:
        if self.coefficients:
            raise ValueError(_NOT_LINEAR)
        return self.constant


_Operator = Callable[[LinearExpression, LinearExpression], LinearExpression]


def read_expression(
    text: str, symbols: Mapping[str, float], variables: frozenset[str], where: str
) -> LinearExpression:
    """Return the value of a cell; an empty one is zero. Raises UsageError, with `where`, for
    anything but sums and products of numbers, `symbols`, pi and deg that are linear in
    `variables`."""
    if not text.strip():
        return LinearExpression(0.0)
    try:
        # In Python ^ is the exclusive or of bits.
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
        value = _value(tree, {**CONSTANTS, **symbols}, variables)
    # TypeError: a root of a negative number is complex. MemoryError: Python's parser refuses depth.
    except _NOT_READ as error:
        known = ", ".join([*sorted(variables), *symbols, *CONSTANTS])
        reason = str(error) if isinstance(error, ValueError) else "it is not a sum or product"
        raise UsageError(
            f"{where}: {text.strip()!r} cannot be read: {reason}; use numbers, + - * / **, "
            f"and {known}."
        ) from error
    _check_finite(value, f"{where}: {text.strip()!r}")
    return value


def _check_finite(value: LinearExpression, label: str) -> None:
    if not all(map(math.isfinite, [value.constant, *value.coefficients.values()])):
        raise UsageError(f"{label} is not finite.")


def _value(
    node: ast.expr, symbols: Mapping[str, float], variables: frozenset[str]
) -> LinearExpression:
    match node:
        # bool is a subclass of int: True would be 1.
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return LinearExpression(float(number))
        case ast.Name(id=name):
            return _named(name, symbols, variables)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inner):
            return _value(inner, symbols, variables).scaled(_SIGNS[type(sign)])
        case ast.BinOp(left=left, op=op, right=right):
            return _combined(
                _value(left, symbols, variables), op, _value(right, symbols, variables)
            )
    raise ValueError("it is not a sum or product of numbers and names")


def _named(name: str, symbols: Mapping[str, float], variables: frozenset[str]) -> LinearExpression:
    if name in variables:
        return LinearExpression(0.0, {name: 1.0})
    if name not in symbols:
        raise ValueError(f"unknown name {name!r}")
    return LinearExpression(symbols[name])


def _combined(
    left: LinearExpression, op: ast.operator, right: LinearExpression
) -> LinearExpression:
    if type(op) not in _OPERATORS:
        raise ValueError(_NOT_LINEAR)
    return _OPERATORS[type(op)](left, right)
