"""Denavit-Hartenberg tables as printed in papers, read from CSV.

    # let a2 = 0.279                 named lengths, which printed results use
    # connect 2pp 3                  o_2pp is a point of link 3: a closed chain
    link, joint, prev, a, alpha, d, theta, low, high, mass, com, size
    1,    R,     ,     0, pi/2,  0, q1
    2p,   R,     1,    a2p, 0,   0, q2 + q3

`joint` is R (revolute), P (prismatic) or F (a fixed frame); `passive` after it means no motor.
`theta` of an R row and `d` of a P row hold the link's own variable `q<link>` (the default of an
empty cell) or those that it follows; all other cells are constant. Only link, joint, a, alpha, d,
theta are required: `prev` is the row before, and unknown masses are those of bars.
"""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.dh.dh_expression import CONSTANTS, LinearExpression, read_expression

NEEDED: Final = ("link", "joint", "a", "alpha", "d", "theta")
COLUMNS: Final = (*NEEDED, "prev", "low", "high", "mass", "com", "size")
KINEMATIC: Final = (*NEEDED, "prev")
BASES: Final = ("", "-", "0", "base", "—")
"""Values of `prev` for a link on the base."""

_SYMBOL = re.compile(r"#\s*let\s+([A-Za-z_]\w*)\s*=\s*(.+)")
_CONNECT = re.compile(r"#\s*connect\s+(\S+)\s+(\S+)\s*")


@dataclass(frozen=True)
class DhRow:
    """One link: its kind, the previous link (None: the base), lengths and angles (m, rad) with the
    joint variables in `theta` or `d`, limits, and mass (kg), com and size of a box (m) in the
    axes of its frame, from its frame's origin."""

    link: str
    kind: Literal["R", "P", "F"]
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
    def variable(self) -> str:
        """Name of the joint variable of this link."""
        return f"q{self.link}"

    @property
    def joint_expression(self) -> LinearExpression:
        """Position of its joint: theta of an R row, d of a P row."""
        return self.theta if self.kind == "R" else self.d

    @property
    def coupling_coefficients(self) -> dict[str, float]:
        """Coefficients of the variables that its joint follows; empty for an independent joint."""
        return (
            {}
            if self.variable in self.joint_expression.coefficients
            else dict(self.joint_expression.coefficients)
        )


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
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"There is no readable table {str(path)!r}: {error}.") from error
    lengths: dict[str, float] = {}
    connects = []
    numbered = []
    for number, line in enumerate(lines, start=1):
        if found := _CONNECT.fullmatch(line.strip()):
            connects.append((found[1], found[2]))
        elif found := _SYMBOL.fullmatch(line.strip()):
            value = read_expression(found[2], lengths, frozenset(), f"{path}, line {number}")
            lengths[found[1]] = (symbols or {}).get(found[1], value.constant)
        elif line.strip() and not line.lstrip().startswith("#"):
            numbered.append((number, [c.strip() for c in next(csv.reader([line]))]))
    if len(numbered) < 2:
        raise UsageError(f"{path} has no rows; write a line of column names, then one per link.")
    header = [name.lower() for name in numbered[0][1]]
    _check_header(path, header)
    cells = [(n, dict(zip(header, row, strict=False))) for n, row in numbered[1:]]
    rows = _rows(path, cells, lengths)
    _check_links(path, rows, connects)
    return DhTable(rows, lengths, tuple(connects))


def printed_table(
    path: Path,
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...], dict[str, float]]:
    """Return head and rows of a table's kinematic columns as written, and its named lengths (m)."""
    table = read_table(path)
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    cells = [[c.strip() for c in next(csv.reader([x]))] for x in lines if not x.startswith("#")]
    shown = [i for i, name in enumerate(cells[0]) if name.lower() in KINEMATIC]
    head, *rows = (tuple(row[i] if i < len(row) else "" for i in shown) for row in cells)
    return head, tuple(rows), dict(table.symbols)


def _check_header(path: Path, header: list[str]) -> None:
    for name in header:
        if name not in COLUMNS:
            raise UsageError(f"{path}: {unknown_name('column of a DH table', name, COLUMNS)}")
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise UsageError(
            f"{path} lacks the columns {', '.join(missing)}; required are {', '.join(NEEDED)}."
        )


def _rows(
    path: Path, cells: list[tuple[int, dict[str, str]]], symbols: Mapping[str, float]
) -> tuple[DhRow, ...]:
    variables = frozenset(f"q{row.get('link', '')}" for _, row in cells)
    rows: list[DhRow] = []
    for number, row in cells:
        before = rows[-1].link if rows else None
        rows.append(_Cells(f"{path}, line {number}", row, symbols, variables).read(before))
    return tuple(rows)


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
        if kind not in ("R", "P", "F") or rest.strip() not in ("", "passive"):
            raise UsageError(
                f"{self.where}, column joint: {self.row.get('joint')!r}; write R, P or F, and "
                "'R passive' for a joint without motor."
            )
        prev = self.row.get("prev")
        theta, d = (self.linear(name, kind) for name in ("theta", "d"))
        return DhRow(
            link=link,
            kind=kind,  # type: ignore[arg-type]
            prev=before if prev is None else None if prev in BASES else prev,
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
        """Return theta or d; the joint variable of the link is the default where the joint
        moves."""
        variable, text = f"q{self.row['link']}", self.row.get(name, "").replace("—", "")
        moves = (kind, name) in (("R", "theta"), ("P", "d"))
        value = read_expression(text, self.symbols, self.variables, f"{self.where}, column {name}")
        if not moves and value.coefficients:
            raise UsageError(
                f"{self.where}, column {name}: {text!r} is variable, but the joint is {kind}."
            )
        if moves and not value.coefficients:
            value = value + LinearExpression(0.0, {variable: 1.0})
        if moves and variable in value.coefficients and value.coefficients != {variable: 1.0}:
            raise UsageError(
                f"{self.where}, column {name}: {text!r}; write {variable} plus a constant, or "
                "only the variables that it follows."
            )
        return value

    def number(self, name: str) -> float:
        """Return the value of a constant cell."""
        text = self.row.get(name, "").replace("—", "")
        where = f"{self.where}, column {name}"
        return read_expression(text, self.symbols, frozenset(), where).constant

    def limits(self) -> tuple[float, float] | None:
        """Return low and high; None where neither is stated."""
        if not self.row.get("low") and not self.row.get("high"):
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
        where = f"{self.where}, column {name}"
        x, y, z = (
            read_expression(word, self.symbols, frozenset(), where).constant for word in words
        )
        return x, y, z


def _check_links(path: Path, rows: tuple[DhRow, ...], connects: list[tuple[str, str]]) -> None:
    known: dict[str, DhRow] = {}
    for row in rows:
        if row.link in known:
            raise UsageError(f"{path}: two links are called {row.link!r}.")
        if row.prev is not None and row.prev not in known:
            raise UsageError(
                f"{path}: link {row.link!r} follows {row.prev!r}, which is not above it in the "
                "table; order the rows from the base outwards."
            )
        known[row.link] = row
    moving = {row.variable for row in rows if row.kind != "F" and not row.coupling_coefficients}
    for row in rows:
        for name in row.coupling_coefficients:
            if name not in moving:
                raise UsageError(
                    f"{path}: link {row.link!r} follows {name}, which is not independent; "
                    f"independent are {', '.join(sorted(moving))}."
                )
    for pair in connects:
        for link in pair:
            if link not in known:
                raise UsageError(f"{path}: connect: {unknown_name('link', link, known)}")
    clash = moving.intersection(CONSTANTS)
    if clash:
        raise UsageError(f"{path}: {', '.join(sorted(clash))} is a constant; rename the link.")
