"""Tables of Denavit-Hartenberg parameters, whose entries may be expressions."""

import ast
import csv
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Final, Literal

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import read_text

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
    if not all(map(math.isfinite, [value.constant, *value.coefficients.values()])):
        raise UsageError(f"{where}: {text.strip()!r} is not finite.")
    return value


def _value(
    node: ast.expr, symbols: Mapping[str, float], variables: frozenset[str]
) -> LinearExpression:
    match node:
        # bool is a subclass of int: True would be 1.
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return LinearExpression(float(number))
        case ast.Name(id=name):
            if name in variables:
                return LinearExpression(0.0, {name: 1.0})
            if name not in symbols:
                raise ValueError(f"unknown name {name!r}")
            return LinearExpression(symbols[name])
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inner):
            return _value(inner, symbols, variables).scaled(_SIGNS[type(sign)])
        case ast.BinOp(left=left, op=op, right=right):
            if type(op) not in _OPERATORS:
                raise ValueError(_NOT_LINEAR)
            return _OPERATORS[type(op)](
                _value(left, symbols, variables), _value(right, symbols, variables)
            )
    raise ValueError("it is not a sum or product of numbers and names")


NEEDED: Final = ("link", "joint", "a", "alpha", "d", "theta")
COLUMNS: Final = (*NEEDED, "prev", "low", "high", "mass", "com", "size")
KINEMATIC: Final = (*NEEDED, "prev")
BASES: Final = ("", "-", "0", "base", "—")
"""Values of `prev` for a link on the base."""

Kind = Literal["R", "P", "F"]
_KINDS: Final[dict[str, Kind]] = {"R": "R", "P": "P", "F": "F"}

_SYMBOL = re.compile(r"#\s*let\s+([A-Za-z_]\w*)\s*=\s*(.+)")
_CONNECT = re.compile(r"#\s*connect\s+(\S+)\s+(\S+)\s*")


@dataclass(frozen=True)
class DhRow:
    """One link: its kind, the previous link (None: the base), lengths and angles (m, rad) with the
    joint variables in `theta` or `d`, limits, and mass (kg), com and size of a box (m) in the
    axes of its frame, from its frame's origin."""

    link: str
    kind: Kind
    prev: str | None
    a: float
    alpha: float
    d: LinearExpression
    theta: LinearExpression
    motor: bool = True
    limits: tuple[float, float] | None = None
    mass: float | None = None
    com: tuple[float, float, float] | None = None
    size: tuple[float, float, float] | None = None

    @property
    def is_joint(self) -> bool:
        """False for a fixed frame."""
        return self.kind != "F"

    @property
    def joint_expression(self) -> LinearExpression:
        """Position of its joint: theta of an R row, d of a P row."""
        return self.theta if self.kind == "R" else self.d

    @property
    def coupling_coefficients(self) -> dict[str, float]:
        """Coefficients of the variables that its joint follows; empty for an independent joint."""
        coefficients = self.joint_expression.coefficients
        return {} if _variable(self.link) in coefficients else dict(coefficients)


@dataclass(frozen=True)
class DhTable:
    """Rows in the order of the table, named lengths, and closed chains as pairs of links: the
    origin of the first one's frame is a point of the second."""

    rows: tuple[DhRow, ...]
    symbols: Mapping[str, float] = field(default_factory=dict)
    connects: tuple[tuple[str, str], ...] = ()


def read_table(path: Path, symbols: Mapping[str, float] | None = None) -> DhTable:
    """Read the table of a CSV file; `symbols` replace the values of its named lengths.

    Raises UsageError with file, line and column.
    """
    lines = _numbered_lines(path)
    # Values (m) of the lines `# let NAME = EXPRESSION`, each of which may use those above it.
    lengths: dict[str, float] = {}
    for number, line in lines:
        if found := _SYMBOL.fullmatch(line):
            name, text = found.groups()
            value = read_expression(text, lengths, frozenset(), f"{path}, line {number}")
            lengths[name] = (symbols or {}).get(name, value.constant)
    connects = [(found[1], found[2]) for _, line in lines if (found := _CONNECT.fullmatch(line))]
    numbered = _csv_lines(path, lines)
    if len(numbered) < 2:
        raise UsageError(f"{path} has no rows; write a line of column names, then one per link.")
    header = [name.lower() for name in numbered[0][1]]
    _check_header(path, header)
    # A line may end before its last columns: their cells are empty.
    cells = [(number, dict(zip(header, row, strict=False))) for number, row in numbered[1:]]
    variables = frozenset(_variable(row.get("link", "")) for _, row in cells)
    rows: list[DhRow] = []
    for number, row in cells:
        before = rows[-1].link if rows else None
        rows.append(_Cells(f"{path}, line {number}", row, lengths, variables).read(before))
    _check_links(path, rows, [*chain.from_iterable(connects)])
    return DhTable(tuple(rows), lengths, tuple(connects))


def _numbered_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a file that are not blank, with their numbers from 1."""
    try:
        # utf-8-sig: spreadsheets begin a file with a byte order mark.
        lines = read_text(path, "utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"The table {str(path)!r} cannot be read: {error}.") from error
    return [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]


def _csv_lines(path: Path, lines: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
    """The cells of every line that is not a comment, with its number; the first are the names."""
    table = []
    for number, line in lines:
        if line.startswith("#"):
            continue
        try:
            table.append((number, [cell.strip() for cell in next(csv.reader([line]))]))
        except csv.Error as error:
            raise UsageError(
                f"{path}, line {number} is not a line of a table ({error}); separate its cells by "
                "commas."
            ) from error
    return table


def paper_table(
    path: Path,
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...], dict[str, float]]:
    """Return head and rows of a table's kinematic columns as written, and its named lengths (m)."""
    table = read_table(path)
    cells = [row for _, row in _csv_lines(path, _numbered_lines(path))]
    columns = [i for i, name in enumerate(cells[0]) if name.lower() in KINEMATIC]
    # The cells of these columns; those missing at the end of a line are empty.
    head, *rows = (tuple(row[i] if i < len(row) else "" for i in columns) for row in cells)
    return head, tuple(rows), dict(table.symbols)


def _variable(link: str) -> str:
    """Name of the joint variable of a link."""
    return f"q{link}"


@dataclass(frozen=True)
class _Cells:
    """The cells of one line, and the names that may occur in them."""

    where: str
    row: Mapping[str, str]
    symbols: Mapping[str, float]
    variables: frozenset[str]

    def read(self, before: str | None) -> DhRow:
        """Return the row; without a column `prev` its parent is the row before."""
        link = self.row.get("link", "")
        if not re.fullmatch(r"\w+", link):
            raise UsageError(
                f"{self.where}: a link's name has letters and digits only ('2p'); got {link!r}."
            )
        kind, _, rest = self.row.get("joint", "").partition(" ")
        if kind not in _KINDS or rest.strip() not in ("", "passive"):
            raise UsageError(
                f"{self.where}, column joint: {self.row.get('joint')!r}; write R, P or F, and "
                "'R passive' for a joint without motor."
            )
        prev = self.row.get("prev", before)
        theta, d = (self.linear(name, kind) for name in ("theta", "d"))
        return DhRow(
            link=link,
            kind=_KINDS[kind],
            prev=None if prev in BASES else prev,
            a=self.number("a"),
            alpha=self.number("alpha"),
            d=d,
            theta=theta,
            motor=not rest.strip(),
            limits=self.limits(),
            mass=self.number("mass") if self.row.get("mass") else None,
            com=self.three("com"),
            size=self.three("size"),
        )

    def linear(self, name: str, kind: str) -> LinearExpression:
        """Return theta or d; the one that is the joint's position may hold joint variables, and is
        the link's own variable by default."""
        text, where = self.text(name), f"{self.where}, column {name}"
        value = read_expression(text, self.symbols, self.variables, where)
        variable = _variable(self.row["link"])
        if (kind, name) not in (("R", "theta"), ("P", "d")):
            if value.coefficients:
                raise UsageError(f"{where}: {text!r} is variable, but the joint is {kind}.")
            return value
        # A constant is the offset of the joint's zero.
        if not value.coefficients:
            return value + LinearExpression(0.0, {variable: 1.0})
        if variable in value.coefficients and value.coefficients != {variable: 1.0}:
            raise UsageError(
                f"{where}: {text!r}; write {variable} plus a constant, or only the variables that "
                "it follows."
            )
        return value

    def text(self, name: str) -> str:
        """Return the text of a cell; tables of papers have a dash in empty ones."""
        return self.row.get(name, "").replace("—", "")

    def number(self, name: str, text: str | None = None) -> float:
        """Return the value of a cell, or of a text in it, without joint variables."""
        text, where = self.text(name) if text is None else text, f"{self.where}, column {name}"
        return read_expression(text, self.symbols, frozenset(), where).constant

    def limits(self) -> tuple[float, float] | None:
        """Return low and high; None where neither is stated."""
        if not any(self.row.get(name) for name in ("low", "high")):
            return None
        low, high = self.number("low"), self.number("high")
        if not low < high:
            raise UsageError(f"{self.where}: low must be below high; got {low:.4g}, {high:.4g}.")
        return low, high

    def three(self, name: str) -> tuple[float, float, float] | None:
        """Return the three numbers of one cell; None where it is empty."""
        words = self.row.get(name, "").split()
        if not words:
            return None
        if len(words) != 3:
            raise UsageError(f"{self.where}, column {name}: write three numbers; got {words}.")
        x, y, z = (self.number(name, word) for word in words)
        return x, y, z


def _check_header(path: Path, header: Sequence[str]) -> None:
    for name in header:
        if name not in COLUMNS:
            raise UsageError(f"{path}: {unknown_name('column of a DH table', name, COLUMNS)}")
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise UsageError(
            f"{path} lacks the columns {', '.join(missing)}; required are {', '.join(NEEDED)}."
        )


def _check_links(path: Path, rows: Sequence[DhRow], connected: Sequence[str]) -> None:
    """Refuse two links of one name, parents further down, variables that nothing moves or that have
    the name of a constant, and links of chains that there are not."""
    known: set[str] = set()
    for row in rows:
        if row.link in known:
            raise UsageError(f"{path}: two links are called {row.link!r}.")
        if row.prev not in {None, *known}:
            raise UsageError(
                f"{path}: link {row.link!r} follows {row.prev!r}, which is not above it in the "
                "table; order the rows from the base outwards."
            )
        known.add(row.link)
    independent = _independent_variables(path, rows)
    for link in connected:
        if link not in known:
            raise UsageError(
                f"{path}: connect: {unknown_name('link', link, [row.link for row in rows])}"
            )
    clash = independent.intersection(CONSTANTS)
    if clash:
        raise UsageError(f"{path}: {', '.join(sorted(clash))} is a constant; rename the link.")


def _independent_variables(path: Path, rows: Sequence[DhRow]) -> set[str]:
    """Variables of the joints that follow no other, after refusing followers of any other name."""
    # Of all rows before the check: rows of followers may come first.
    joints = [row for row in rows if row.is_joint and not row.coupling_coefficients]
    independent = {_variable(row.link) for row in joints}
    for row in rows:
        for name in row.coupling_coefficients:
            if name not in independent:
                raise UsageError(
                    f"{path}: link {row.link!r} follows {name}, which is not independent; "
                    f"independent are {', '.join(sorted(independent))}."
                )
    return independent
