"""Expressions in the cells of a Denavit-Hartenberg table: "-q2 + pi/2", "2*a2", "-60*deg".

They are parsed, never evaluated as Python. A value is a constant plus a coefficient for each joint
variable in it."""

import ast
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from sysid_bench.errors import UsageError

CONSTANTS: Final = {"pi": math.pi, "deg": math.pi / 180.0}


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

    def times(self, factor: float) -> "LinearExpression":
        """Return the expression multiplied by a number."""
        scaled = {name: factor * value for name, value in self.coefficients.items()}
        return LinearExpression(factor * self.constant, scaled)


def read_expression(
    text: str, symbols: Mapping[str, float], variables: frozenset[str], where: str
) -> LinearExpression:
    """Return the value of a cell; an empty one is zero. Raises UsageError, with `where`, for
    anything but sums and products of numbers, `symbols`, pi and deg that are linear in
    `variables`."""
    if not text.strip():
        return LinearExpression(0.0)
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
        value = _value(tree, {**CONSTANTS, **symbols}, variables)
    except (SyntaxError, ValueError, RecursionError, OverflowError, ZeroDivisionError) as error:
        known = ", ".join([*sorted(variables), *symbols, *CONSTANTS])
        reason = str(error) if isinstance(error, ValueError) else "it is not a sum or product"
        raise UsageError(
            f"{where}: {text.strip()!r} cannot be read: {reason}; use numbers, + - * / **, "
            f"and {known}."
        ) from error
    numbers = [value.constant, *value.coefficients.values()]
    if not all(math.isfinite(number) for number in numbers):
        raise UsageError(f"{where}: {text.strip()!r} is not finite.")
    return value


def _value(
    node: ast.expr, symbols: Mapping[str, float], variables: frozenset[str]
) -> LinearExpression:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return LinearExpression(float(number))
        case ast.Name(id=name) if name in variables:
            return LinearExpression(0.0, {name: 1.0})
        case ast.Name(id=name) if name in symbols:
            return LinearExpression(symbols[name])
        case ast.Name(id=name):
            raise ValueError(f"unknown name {name!r}")
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return _value(inner, symbols, variables).times(-1.0)
        case ast.UnaryOp(op=ast.UAdd(), operand=inner):
            return _value(inner, symbols, variables)
        case ast.BinOp(left=left, op=op, right=right):
            return _combined(
                _value(left, symbols, variables), op, _value(right, symbols, variables)
            )
    raise ValueError("it is not a sum or product of numbers and names")


def _combined(
    left: LinearExpression, op: ast.operator, right: LinearExpression
) -> LinearExpression:
    match op:
        case ast.Add():
            return left + right
        case ast.Sub():
            return left + right.times(-1.0)
        case ast.Mult() if not right.coefficients:
            return left.times(right.constant)
        case ast.Mult() if not left.coefficients:
            return right.times(left.constant)
        case ast.Div() if not right.coefficients:
            return left.times(1.0 / right.constant)
        case ast.Pow() if not left.coefficients and not right.coefficients:
            return LinearExpression(float(left.constant**right.constant))
    raise ValueError("it is not linear in the joint variables")
