"""Merge of runs of one plan, as shards on several machines leave them."""

import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.errors import UsageError, first_names
from sysid_bench.harness.comparison.run_values import ROUNDING
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.row_files import ROWS_DIGEST, RowStart, hash_error, rows_digest
from sysid_bench.types import Row
from sysid_bench.words import MACHINE_FIELDS

_WORTH: Final = ("ok", "unsupported", "skipped", "failed", "crash", "memory", "timeout", "lost")
"""Statuses, the best first: of the rows of a cell the first in this order is kept."""
_EXCEPT: Final = MACHINE_FIELDS | {"fingerprint", "versions", "sources", "traceback", "losses"}


@dataclass(frozen=True)
class MergeResult:
    """Merged run. `contradictions`: cells with different ok rows, of two runs or in one, and
    `places` of these rows by cell; `changed`: places of rows that are not as they were written;
    nothing is written then. `twice`: cells that several runs computed with equal results, a test of
    reproducibility; `rounded` of them are equal up to the rounding of other kernels."""

    folder: RunFolder | None
    rows: int
    open: int
    twice: int
    rounded: int
    contradictions: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    places: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """1 where rows contradict each other or were changed, else 0."""
        return 1 if self.contradictions or self.changed else 0


def merge(paths: Sequence[Path], out: Path, *, mixed: bool = False) -> MergeResult:
    """Merge runs of the same plan into the folder `out`, which is then a run like any other.

    Of several rows of a cell an ok row is kept before any other. Raises UsageError for runs of
    different plans, for an `out` that exists, and, unless `mixed`, for rows of different code.
    """
    folders = [RunFolder.open(path) for path in paths]
    if (out / "plan.jsonl").exists():
        raise UsageError(f"{str(out)!r} is a run already; choose another -o, or remove it.")
    planned = _same_plan(folders)
    candidates, within, changed = _candidates(folders, frozenset(planned))
    if not mixed:
        _check_same_code(candidates)
    contradicting = within | _contradicting(candidates)
    equal = [rows for cell, rows in candidates.items() if cell not in contradicting]
    twice = sum(sum(row.status == "ok" for row in rows) > 1 for rows in equal)
    rounded = sum(len(_ok(rows, "result")) > 1 for rows in equal)
    if contradicting or changed:
        counts = (len(candidates), len(planned), twice, rounded)
        return MergeResult(None, *counts, tuple(contradicting), changed, contradicting)
    folder = folders[0].write_plan(out, _environment(folders))
    with folder.new_writer("merge") as writer:
        for cell in filter(candidates.__contains__, planned):
            # Only places are in memory; the rows of all runs together may be larger than it.
            best = min(candidates[cell], key=lambda row: _WORTH.index(row.status))
            writer.write(best.place.read())
    folder.write_environment(folder.environment | {ROWS_DIGEST: rows_digest(out / "cells")})
    _copy_artifacts(folders, out)
    folder.write_frames()
    return MergeResult(folder, len(candidates), len(planned) - len(candidates), twice, rounded)


def contradictions(folder: RunFolder) -> list[str]:
    """Return the planned cells with several ok rows of one code that are not equal up to rounding:
    of a method that is not deterministic, or of a file that was added."""
    return [*_candidates([folder], frozenset(folder.planned))[1]]


def _contradicting(found: "Mapping[str, Sequence[_Candidate]]") -> dict[str, list[str]]:
    """Return the places of the ok rows of those cells whose ok rows contradict each other."""
    several = {cell: rows for cell, rows in found.items() if len(_ok(rows, "result")) > 1}
    return {
        cell: [f"{row.place.path}:{row.place.line}" for row in rows if row.status == "ok"]
        for cell, rows in several.items()
        if not _agree(rows)
    }


_KERNELS: Final = 1e-12
"""Relative difference of the results of two processors: their kernels add in another order."""


def _agree(rows: "Iterable[_Candidate]") -> bool:
    """True where the ok rows of a cell are equal up to the rounding of other processors."""
    first, *others = (row.place.read() for row in rows if row.status == "ok")
    # Rounding grows with the condition number of the regressor: 1e-15 of a double times it.
    size = max(_KERNELS, 1e-15 * float(first.get("condition") or 0.0))
    kept = {key: value for key, value in first.items() if key not in _EXCEPT}
    return all(
        kept.keys() == {*other} - _EXCEPT and _are_near(kept, {k: other[k] for k in kept}, size)
        for other in others
    )


def _are_near(a: Any, b: Any, size: float) -> bool:
    """True for values of JSON whose numbers differ by rounding: relative to the larger one, and
    absolutely where both are errors of exact data. Counts, names and verdicts are equal."""
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= max(size * max(abs(a), abs(b)), ROUNDING)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_are_near(a[key], b[key], size) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(_are_near(x, y, size) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _same_plan(folders: Sequence[RunFolder]) -> tuple[str, ...]:
    """Return the ids of the cells of all runs; raise UsageError where they differ."""
    if not folders:
        raise UsageError("Name the runs to merge.")
    first, *others = folders
    wanted = set(first.planned)
    for folder in others:
        ids = set(folder.planned)
        if ids != wanted:
            raise UsageError(
                f"{str(folder.path)!r} holds another plan than {str(first.path)!r}: "
                f"{len(ids - wanted)} cells more and {len(wanted - ids)} fewer. Merge runs of one "
                "suite."
            )
    return first.planned


def _environment(folders: Sequence[RunFolder]) -> dict[str, Any]:
    """Return the environment of the first run, with those of all as `machines`."""
    of_run = ("machines", ROWS_DIGEST)
    found = chain.from_iterable(folder.machines for folder in folders)
    machines = [{key: x for key, x in one.items() if key not in of_run} for one in found]
    unique = {canonical(machine): machine for machine in machines}
    return {**machines[0], "machines": list(unique.values())}


def _copy_artifacts(folders: Sequence[RunFolder], out: Path) -> None:
    """Copy the stored data of each cell from the first run that has them."""
    for run in folders:
        for source in sorted((run.path / "artifacts").glob("*/paper")):
            target = out / "artifacts" / source.parent.name / "paper"
            if not target.exists():
                shutil.copytree(source, target)


class _Candidate(NamedTuple):
    """A row of a cell in one of the runs: what decides about it, and where it is."""

    status: str
    fingerprint: Any
    versions: str
    result: str  # hash of the part that every machine should reproduce; "" where it is not ok
    place: RowStart


def _candidate(row: Row, place: RowStart) -> _Candidate:
    # Bit by bit: rows of one code and one set of libraries are expected to be equal.
    result = {key: value for key, value in row.items() if key not in _EXCEPT}
    return _Candidate(
        row["status"],
        row.get("fingerprint"),
        sys.intern(canonical(row.get("versions"))),
        canonical_hash(result) if row["status"] == "ok" else "",
        place,
    )


def _candidates(
    folders: Iterable[RunFolder], planned: frozenset[str]
) -> tuple[dict[str, list[_Candidate]], dict[str, list[str]], tuple[str, ...]]:
    """Return the last rows of each planned cell, in the order of the runs; the cells with ok rows
    of one code in one run that contradict each other; and the places of changed rows of cells that
    have no other in their run."""
    found: dict[str, list[_Candidate]] = {}
    within: dict[str, list[str]] = {}
    places: list[str] = []
    for folder in folders:
        last, changed = dict[str, _Candidate](), dict[str, RowStart]()
        of_code: dict[Any, dict[str, list[_Candidate]]] = {}
        for row, place in folder.rows_with_origin():
            if isinstance(row, bytes):
                cell = hash_error(row, hashed=folder.has_hashes)
                if cell is not None and cell in planned:
                    changed[cell] = place
            elif row["id"] in planned:
                last[row["id"]] = one = _candidate(row, place)
                if one.status == "ok":
                    of_code.setdefault(one.fingerprint, {}).setdefault(row["id"], []).append(one)
        for rows in of_code.values():
            within |= _contradicting(rows)
        for cell, candidate in last.items():
            found.setdefault(cell, []).append(candidate)
        places += [f"{at.path}:{at.line}" for cell, at in changed.items() if cell not in last]
    return found, within, tuple(places)


def _check_same_code(candidates: Mapping[str, Sequence[_Candidate]]) -> None:
    mixed = [cell for cell, rows in candidates.items() if len(_ok(rows, "fingerprint")) > 1]
    code = {row.versions for row in chain.from_iterable(candidates.values())}
    if mixed or len(code) > 1:
        where = f" (cells {first_names(mixed)})" if mixed else ""
        raise UsageError(
            f"The runs were made by different code, models or libraries{where}; merge them "
            "nevertheless with --mixed, or run the older ones again with --rerun stale."
        )


def _ok(rows: Iterable[_Candidate], part: str) -> set[Any]:
    """Return the different values that the ok rows of a cell have in a part."""
    return {getattr(row, part) for row in rows if row.status == "ok"}
