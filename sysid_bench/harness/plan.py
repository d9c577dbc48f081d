"""Plan of a suite: its cells, one experiment and one estimator each."""

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from heapq import heapify, heapreplace
from math import fsum
from typing import IO, Any

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.harness.cell import Cell, fields
from sysid_bench.harness.power import claim_power, not_ranked, ranking_power
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import Names, default_names
from sysid_bench.harness.suite_cells import check_size, is_random, suite_cells
from sysid_bench.models.model_record import ModelRecord
from sysid_bench.types import Row
from sysid_bench.words import BASELINE_LABELS, CELL_FIELDS

_ID = b'{"id": "'
_KIND = len(_ID + b'123456789abc", "experiment": "123456789abc", ')
"""Offset of the first field of a line that cells share which differ by their repeat."""
_REPEAT = b', "repeat": '  # as last field of a line


@dataclass(frozen=True)
class Plan:
    """Every cell in the order of the suite. `excluded` counts cells per reason; `models` holds the
    records of the robots, by label."""

    cells: tuple[Cell, ...]
    excluded: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    models: Mapping[str, ModelRecord] = field(default_factory=dict)

    @property
    def spec_list(self) -> tuple[ExperimentSpec, ...]:
        """The experiments in the order of their first cell."""
        return tuple({cell.experiment: cell.spec for cell in self.cells}.values())

    @property
    def fields(self) -> frozenset[str]:
        """Names of fields that expressions can read."""
        return CELL_FIELDS.union(*(fields(cell) for cell in self.cells))

    def select(self, text: str | None) -> tuple[Cell, ...]:
        """Return the cells that meet an expression; all of them for None."""
        if text is None:
            return self.cells
        condition = Expression.parse(text, self.fields)
        return tuple(cell for cell in self.cells if condition.holds(fields(cell)))

    def unknown_values(self, text: str) -> list[str]:
        """Return a sentence for each text of an expression that no cell has in that field."""
        cell_fields = [fields(cell) for cell in self.cells]
        sentences = []
        for name, wanted in Expression.parse(text, self.fields).text_values:
            values = set[str]()
            for flat in cell_fields:
                value = flat.get(name)
                words = value if isinstance(value, tuple) else (value,)
                values |= {word for word in words if isinstance(word, str)}
            if not values or wanted in values:
                continue
            near = get_close_matches(wanted, sorted(values), n=3, cutoff=0.5)
            shown = near or [*sorted(values)[:8], *["..."][: len(values) > 8]]
            there = f"{'nearest' if near else 'there'} {'is' if len(shown) == 1 else 'are'}"
            sentences.append(f"No cell has {name} == {wanted!r}; {there} {', '.join(shown)}.")
        return sentences

    def to_json_lines(self) -> Iterator[str]:
        """Yield the lines of plan.jsonl, from which a run is resumed without the suite."""
        return (json.dumps(cell.to_json()) + "\n" for cell in self.cells)

    @classmethod
    def from_json_lines(cls, lines: Iterable[bytes]) -> "Plan":
        """Read the cells of a plan.jsonl, which holds neither exclusions nor notes."""
        return cls(tuple(_cell_of(number, line) for number, line in _numbered(lines)))


def cells_of_suite(suite: Suite, names: Names | None = None, *, large: bool = False) -> Plan:
    """Return all cells of a suite, without those of an [[exclude]] and without duplicates.

    Raises UsageError for more than MANY cells, unless `large`, for an estimator with the label of a
    baseline, and for a ranking with an unknown reference or member of its family, before all is
    computed.
    """
    if not large:
        check_size(suite)
    names = names or default_names()
    cells = suite_cells(suite, names)
    _check_labels(cells)
    _check_rankings(suite, cells)
    rules = [(Expression.parse(rule.when), rule.reason) for rule in suite.exclude]
    kept, excluded = [], {reason: 0 for _, reason in rules}
    for cell in cells:
        flat = fields(cell) if rules else {}
        reason = next((reason for rule, reason in rules if rule.holds(flat)), None)
        if reason is None:
            kept.append(cell)
        else:
            excluded[reason] += 1
    # By id: two entries of a suite may mean the same cell, which is then computed once.
    unique: dict[str, Cell] = {}
    for cell in kept:
        unique.setdefault(cell.id, cell)
    ordered = tuple(unique.values())
    return Plan(
        ordered, excluded, tuple(_notes(suite, kept, ordered)), _models(suite, names, ordered)
    )


def _models(suite: Suite, names: Names, cells: Iterable[Cell]) -> dict[str, ModelRecord]:
    """Return the records of the robots that are here, by their labels."""
    robots = {c.labels["robot"]: (c.spec.robot, suite.folder, c.spec.free_base) for c in cells}
    found = {label: names.model(*robot) for label, robot in robots.items()}
    return {label: record for label, record in found.items() if record is not None}


def _check_labels(cells: Iterable[Cell]) -> None:
    """Raise UsageError for an estimator whose label is that of a baseline."""
    for label in {cell.labels["estimator"]: None for cell in cells}:
        # Readers do not see case and spaces either.
        if " ".join(label.split()).casefold() in BASELINE_LABELS:
            raise UsageError(
                f"The estimator {label!r} has the label of a baseline ({', '.join(BASELINE_LABELS)}"
                "), which tables and rankings print beside methods; give it another `label`."
            )


def _check_rankings(suite: Suite, cells: Iterable[Cell]) -> None:
    """Raise UsageError for a ranking with an unknown reference or member of its family, and for a
    family of methods that are not ranked."""
    cells = tuple(cells)
    methods = sorted({cell.labels["estimator"] for cell in cells})
    unranked = not_ranked(cells)
    for entry in suite.ranking:
        for method in (entry.against, *entry.family):
            if method not in methods:
                where = f"The ranking {entry.name!r} names it as its reference or in its family."
                raise unknown_name("estimator of this suite", method, methods, where)
        if entry.family and unranked.issuperset(entry.family):
            raise UsageError(
                f"The family of the ranking {entry.name!r} has no method with a verdict: "
                f"{', '.join(entry.family)} declare that they depend on the frames of the links, "
                "and are not ranked. Name another method, or leave out 'family'."
            )


def _notes(suite: Suite, kept: Sequence[Cell], unique: Sequence[Cell]) -> Iterator[str]:
    if suite.run.repeats > 1 and not all(is_random(cell.spec) for cell in unique):
        yield (
            "Experiments without noise under the simulation 'inverse' give the same numbers each "
            f"time: repeat 0 stands for all {suite.run.repeats}."
        )
    noisy = (cell.spec.signals for cell in unique if cell.spec.noise)
    if any(signals.get("derivatives") == "exact" for signals in noisy):
        yield (
            "Some cells have noise and derivatives = 'exact': their v and a come from ideal "
            "sensors, without noise. signals = { derivatives = 'from q', filter = ... } makes them "
            "from the encoders."
        )
    if len(kept) > len(unique):
        yield f"{len(kept) - len(unique)} cells were specified twice and are run once."
    yield from ranking_power(suite, unique)
    yield from claim_power(suite, unique)


# --- Lines of plan.jsonl ------------------------------------------------------------------------


def _numbered(lines: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    """Number the lines of a plan.jsonl that are not empty, without their ends."""
    return ((n, line.rstrip(b"\r\n")) for n, line in enumerate(lines, 1) if line.strip())


def planned_cells(lines: Iterable[bytes]) -> tuple[str, ...]:
    """Return the ids of the cells of a plan.jsonl."""
    return tuple(_id_of(number, line) for number, line in _numbered(lines))


def _id_of(number: int, line: bytes) -> str:
    """Id of a line. Plans begin each line with it: parsing the rest would take 20 times as long."""
    name = line[len(_ID) : len(_ID) + 12]
    if line.startswith(_ID) and name.isalnum() and line.startswith(b'", ', 20) and line[-1] == 125:
        return name.decode()
    return _cell_of(number, line).id


def offset_by_cell(lines: Iterable[bytes]) -> dict[str, int]:
    """Return for each cell of a plan.jsonl, by id, the offset (bytes) of the line of the first cell
    with the same code and models. Of cells that differ by their repeat one is parsed."""
    alike, same, places = dict[bytes, int](), dict[str, int](), dict[str, int]()
    offset = 0
    for number, whole in enumerate(lines, 1):
        if line := whole.strip():
            # Part of a line that cells share which differ by their repeat; of other lines all.
            end = line.rfind(_REPEAT)
            is_plain = line.startswith(b'"labels": ', _KIND) and line.endswith(b"}}")
            is_plain = is_plain and line[end + len(_REPEAT) : -2].isdigit()
            kind = line[_KIND:end] if is_plain else line
            if kind not in alike:
                alike[kind] = same.setdefault(_cell_of(number, line).code_key, offset)
            places[_id_of(number, line)] = alike[kind]
        offset += len(whole)
    return places


def cell_at(plan: IO[bytes], offset: int) -> Cell:
    """Return the cell of an open plan.jsonl whose line begins at an offset."""
    plan.seek(offset)
    return _cell_of(f"byte {offset}", plan.readline())


def planned_fields(lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """Yield `Cell.first_fields` of each cell of a plan.jsonl, without the rest of the cell."""
    for number, line in _numbered(lines):
        try:
            data = json.loads(line)
            # A million cells have few different labels: each text is in memory once.
            labels = {sys.intern(key): sys.intern(word) for key, word in data["labels"].items()}
            repeat = data["spec"]["repeat"]
            head = {"id": data["id"], "experiment": data["experiment"], **labels, "repeat": repeat}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            head = _cell_of(number, line).first_fields  # raises with the reason
        yield head


def _cell_of(number: int | str, line: bytes) -> Cell:
    try:
        data = json.loads(line)
        spec = ExperimentSpec.from_json(data["spec"])
        cell = Cell(spec, data["estimator"], data["labels"], data["facts"], data["seconds"])
        written_id, read_id = data["id"], cell.id
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"plan.jsonl:{number}: not a valid cell ({error!r}).") from error
    # Another version may read other defaults: its row would be that of another cell.
    if read_id != written_id:
        raise UsageError(
            f"plan.jsonl:{number}: the cell {written_id} reads as {read_id} with this version of "
            "sysid_bench; run the suite into another folder (-o)."
        )
    return cell


@dataclass(frozen=True)
class Shard:
    """Part `index` (from 1) of `count` of a whole plan: the same cells on every machine, whatever
    is selected there."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Read "2/8"; raises UsageError for anything else."""
        index, slash, count = text.partition("/")
        if not (slash and index.isdecimal() and count.isdecimal()):
            raise UsageError(f"The shard {text!r} is not a part like '2/8' (part 2 of 8).")
        shard = cls(int(index), int(count))
        if not 1 <= shard.index <= shard.count:
            raise UsageError(
                f"The shard {text!r} does not exist: parts are 1/{count} to {count}/{count}."
            )
        return shard

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    def experiments(self, plan: Iterable[Cell]) -> frozenset[str]:
        """Return the experiments of this part: each goes, the dearest first, to the part that costs
        least so far (Graham 1969), by the expected costs of its cells in the plan. None for a part
        beyond the number of experiments."""
        seconds: dict[str, list[float]] = {}
        for cell in plan:
            seconds.setdefault(cell.experiment, []).append(cell.seconds)
        costs = {name: fsum(parts) for name, parts in seconds.items()}  # in any order of cells
        loads = [(0.0, index) for index in range(1, self.count + 1)][: len(costs)]
        heapify(loads)
        own = set[str]()
        # Ties by id, so that all machines deal the plan out alike, without contact.
        for name in sorted(costs, key=lambda name: (-costs[name], name)):
            load, index = loads[0]
            heapreplace(loads, (load + costs[name], index))
            if index == self.index:
                own.add(name)
        return frozenset(own)


class RowTable(Mapping[str, Row]):
    """Rows by their id, kept as tuples beside one copy of the names of their fields."""

    def __init__(self, rows: Iterable[Row]) -> None:
        names: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._rows = {}
        for row in rows:
            own = tuple(row)
            self._rows[row["id"]] = names.setdefault(own, own), tuple(row.values())

    def __getitem__(self, key: str) -> Row:
        """The row of an id."""
        return dict(zip(*self._rows[key], strict=True))

    def __iter__(self) -> Iterator[str]:
        """Ids in their order."""
        return iter(self._rows)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._rows)
