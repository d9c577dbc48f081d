"""A Denavit-Hartenberg table as papers print it, read from CSV.

    # let a2 = 0.279                 lengths with names, so that results can be printed with them
    # connect 2pp 3                  o_2pp is a point of link 3: a closed chain
    link, joint, prev, a, alpha, d, theta, low, high, mass, com, size
    1,    R,     ,     0, pi/2,  0, q1
    2p,   R,     1,    a2p, 0,   0, q2 + q3

`joint` is R (revolute), P (prismatic) or F (a fixed frame); with `passive` after it no motor is
there. `theta` of an R row and `d` of a P row hold the link's own variable `q<link>` (an empty cell
means just that) or those that it follows; everything else is constant. Only link, joint, a, alpha,
d, theta are needed: `prev` is the row before, and what is unknown of masses is made up.
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
"""What stands in `prev` of a link on the base."""

_SYMBOL = re.compile(r"#\s*let\s+([A-Za-z_]\w*)\s*=\s*(.+)")
_CONNECT = re.compile(r"#\s*connect\s+(\S+)\s+(\S+)\s*")


@dataclass(frozen=True)
class DhRow:
    """One link: its kind, the link before (None: the base), lengths and angles (m, rad) with the
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
        """The name of its own joint variable."""
        return f"q{self.link}"

    @property
    def moves(self) -> LinearExpression:
        """What its joint does: theta of an R row, d of a P row."""
        return self.theta if self.kind == "R" else self.d

    @property
    def follows(self) -> dict[str, float]:
        """Coefficients of the variables that it follows; none where it moves on its own."""
        return {} if self.variable in self.moves.coefficients else dict(self.moves.coefficients)


@dataclass(frozen=True)
class DhTable:
    """The rows in the order of the table, the lengths that have names, and closed chains as pairs
    of links: the origin of the first one's frame is a point of the second."""

    rows: tuple[DhRow, ...]
    symbols: Mapping[str, float] = field(default_factory=dict)
    connects: tuple[tuple[str, str], ...] = ()


def read_table(path: Path, symbols: Mapping[str, float] | None = None) -> DhTable:
    """The table of a CSV file; `symbols` replace the values of its named lengths.

    Raises UsageError naming file, line and column.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"There is no readable table {str(path)!r}: {error}.") from error
    told: dict[str, float] = {}
    connects = []
    numbered = []
    for number, line in enumerate(lines, start=1):
        if found := _CONNECT.fullmatch(line.strip()):
            connects.append((found[1], found[2]))
        elif found := _SYMBOL.fullmatch(line.strip()):
            value = read_expression(found[2], told, frozenset(), f"{path}, line {number}")
            told[found[1]] = (symbols or {}).get(found[1], value.constant)
        elif line.strip() and not line.lstrip().startswith("#"):
            numbered.append((number, [c.strip() for c in next(csv.reader([line]))]))
    if len(numbered) < 2:
        raise UsageError(f"{path} has no rows; write a line of column names, then one for a link.")
    header = [name.lower() for name in numbered[0][1]]
    _check_header(path, header)
    cells = [(n, dict(zip(header, row, strict=False))) for n, row in numbered[1:]]
    rows = _rows(path, cells, told)
    _check_links(path, rows, connects)
    return DhTable(rows, told, tuple(connects))


def printed_table(
    path: Path,
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...], dict[str, float]]:
    """Head and rows of a table's kinematic columns as they are written, and its lengths."""
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
            f"{path} lacks the columns {', '.join(missing)}; needed are {', '.join(NEEDED)}."
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
    """The cells of one line, and what names mean in them."""

    where: str
    row: Mapping[str, str]
    symbols: Mapping[str, float]
    variables: frozenset[str]

    def read(self, before: str | None) -> DhRow:
        """The row; without a column `prev` it hangs on the one before."""
        link = self.row.get("link", "")
        if not re.fullmatch(r"\w+", link):
            raise UsageError(
                f"{self.where}: a link is called by letters and digits ('2p'); got {link!r}."
            )
        kind, _, rest = self.row.get("joint", "").partition(" ")
        if kind not in ("R", "P", "F") or rest.strip() not in ("", "passive"):
            raise UsageError(
                f"{self.where}, column joint: {self.row.get('joint')!r}; write R, P or F, and "
                "'R passive' where no motor is."
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
        """theta or d; what the joint moves is its own variable where the cell is empty."""
        own, text = f"q{self.row['link']}", self.row.get(name, "").replace("—", "")
        moves = (kind, name) in (("R", "theta"), ("P", "d"))
        value = read_expression(text, self.symbols, self.variables, f"{self.where}, column {name}")
        if not moves and value.coefficients:
            raise UsageError(
                f"{self.where}, column {name}: {text!r} moves, but the joint is {kind}."
            )
        if moves and not value.coefficients:
            value = value + LinearExpression(0.0, {own: 1.0})
        if moves and own in value.coefficients and value.coefficients != {own: 1.0}:
            raise UsageError(
                f"{self.where}, column {name}: {text!r}; write {own} plus a constant, or the "
                "variables that it follows without its own."
            )
        return value

    def number(self, name: str) -> float:
        """A constant cell."""
        text = self.row.get(name, "").replace("—", "")
        place = f"{self.where}, column {name}"
        return read_expression(text, self.symbols, frozenset(), place).constant

    def limits(self) -> tuple[float, float] | None:
        """low and high, where they are told."""
        if not self.row.get("low") and not self.row.get("high"):
            return None
        low, high = self.number("low"), self.number("high")
        if not low < high:
            raise UsageError(f"{self.where}: low must be below high; got {low:.4g}, {high:.4g}.")
        return low, high

    def three(self, name: str) -> tuple[float, float, float] | None:
        """Three numbers in one cell."""
        words = self.row.get(name, "").split()
        if not words:
            return None
        if len(words) != 3:
            raise UsageError(
                f"{self.where}, column {name}: write three numbers apart by blanks; got {words}."
            )
        place = f"{self.where}, column {name}"
        x, y, z = (
            read_expression(word, self.symbols, frozenset(), place).constant for word in words
        )
        return x, y, z


def _check_links(path: Path, rows: tuple[DhRow, ...], connects: list[tuple[str, str]]) -> None:
    known: dict[str, DhRow] = {}
    for row in rows:
        if row.link in known:
            raise UsageError(f"{path}: two links are called {row.link!r}.")
        if row.prev is not None and row.prev not in known:
            raise UsageError(
                f"{path}: link {row.link!r} hangs on {row.prev!r}, which is not above it in the "
                "table; order the rows from the base outwards."
            )
        known[row.link] = row
    moving = {row.variable for row in rows if row.kind != "F" and not row.follows}
    for row in rows:
        for name in row.follows:
            if name not in moving:
                raise UsageError(
                    f"{path}: link {row.link!r} follows {name}, which does not move on its own; "
                    f"there are {', '.join(sorted(moving))}."
                )
    for pair in connects:
        for link in pair:
            if link not in known:
                raise UsageError(f"{path}: connect: {unknown_name('link', link, known)}")
    clash = moving.intersection(CONSTANTS)
    if clash:
        raise UsageError(f"{path}: {', '.join(sorted(clash))} is a constant; call the link else.")
