"""The files cells.parquet, parameters.parquet and joints.parquet of a run, and what they cover.

consolidated.json states up to which byte of each row file the three files hold the rows, and the
hashes of their footers, and counts these rows. Readers use them where all of that is true and the
file is as it was written; else the row files decide.
"""

import hashlib
import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.harness.data_frames import columns_of
from sysid_bench.harness.row_counts import RowCounts
from sysid_bench.input_files import LARGEST_HASHED, check_file, file_hash, parse_json, read_text
from sysid_bench.types import Row

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow

FRAMES: Final = ("cells", "parameters", "joints")
COVERAGE_FILE: Final = "consolidated.json"

UNREADABLE: Final = (OSError, ValueError, LookupError, TypeError, NotImplementedError)
"""Errors of reading a Parquet file that is absent or damaged."""

_FORMAT: Final = 3
_HASH: Final = "sha256"
"""First key of consolidated.json: hash of the text behind it."""
_BLOCK: Final = 1 << 20


@dataclass(frozen=True)
class CoveragePart:
    """The covered part of a row file: its bytes, lines and sha256; `mtime` (ns) of the whole."""

    bytes: int
    lines: int
    sha256: str
    mtime: int

    def holds(self, path: Path) -> bool:
        """True where the file still begins with the covered part."""
        try:
            state = path.stat()
            if (state.st_size, state.st_mtime_ns) == (self.bytes, self.mtime):
                return True
            return state.st_size >= self.bytes and _hash_of_start(path, self.bytes) == self.sha256
        except OSError:
            return False


@dataclass(frozen=True)
class Coverage:
    """Rows that the Parquet files hold: a part of each row file, with the labels of a plan.
    `footers` are the sha256 of the ends of the files, which describe and number their contents;
    `kinds` are [first cell, types of the columns of each frame] of the rows (see build_frames.py);
    `counts` count them, None where they are of too many kinds.
    """

    footers: Mapping[str, str]
    plan: str
    files: Mapping[str, CoveragePart]
    garbled: tuple[str, ...]
    kinds: tuple[Any, ...] = ()
    counts: RowCounts | None = None
    format: int = _FORMAT

    @property
    def start(self) -> dict[str, tuple[int, int]]:
        """(line, offset) behind which each row file is not covered."""
        return {name: (file.lines, file.bytes) for name, file in self.files.items()}

    def holds(self, paths: Sequence[Path]) -> bool:
        """True where each covered row file is there and still begins with its covered part."""
        present = {path.name: path for path in paths}
        return all(n in present and file.holds(present[n]) for n, file in self.files.items())

    def to_json(self) -> str:
        """Text of consolidated.json."""
        counts = self.counts and self.counts.to_json()
        fields = asdict(replace(self, counts=None)) | {"counts": counts}
        texts = [f"{json.dumps(key)}: {_json_text(value)}" for key, value in fields.items()]
        text = ",\n".join(texts) + "\n}\n"
        return f'{{"{_HASH}": "{_text_hash(text)}",\n{text}'


def _json_text(value: Any) -> str:
    """JSON with a line for each entry of a long list."""
    if not isinstance(value, tuple):
        return json.dumps(value)
    return f"[{','.join(f'{chr(10)}{json.dumps(entry)}' for entry in value)}]"


def _text_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def read_coverage(folder: Path, paths: Sequence[Path]) -> Coverage | None:
    """Return the coverage of a run folder's Parquet files; None where it is absent or not true."""
    try:
        coverage = _parse_coverage(read_text(folder / COVERAGE_FILE))
        is_of_plan = coverage.plan == file_hash(folder / "plan.jsonl")
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    is_true = coverage.format == _FORMAT and is_of_plan and coverage.holds(paths)
    return coverage if is_true else None


def _parse_coverage(text: str) -> Coverage:
    """Raise ValueError, TypeError, KeyError or AttributeError for a text that was not written."""
    data = parse_json(text)
    if data.pop(_HASH) != _text_hash(text.partition("\n")[2]):
        raise ValueError("the text was changed")
    files = {name: CoveragePart(**file) for name, file in data.pop("files").items()}
    counts = data.pop("counts")
    data |= {key: tuple(data[key]) for key in ("garbled", "kinds")}
    return Coverage(**data, files=files, counts=counts and RowCounts.from_json(counts))


def frame_hash(path: Path) -> str:
    """Return the sha256 of the footer of a Parquet file, with its length and the magic number."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 8, 0))
        length = int.from_bytes(file.read(4), "little") + 8
        file.seek(max(size - length, 0))
        return hashlib.sha256(file.read(length)).hexdigest()


def coverage_part(path: Path, size: int, count: int, changed: int) -> CoveragePart:
    """Describe the first `size` bytes of a row file, with `count` lines, `changed` at a time."""
    return CoveragePart(size, count, _hash_of_start(path, size), changed)


def _hash_of_start(path: Path, size: int) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while size > 0 and (block := file.read(min(size, _BLOCK))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()


class FrameFiles:
    """Open Parquet files of one consolidation; they stay readable when others replace them."""

    def __init__(self, folder: Path, coverage: Coverage) -> None:
        """Raise OSError or ValueError where a file is absent, damaged or of another one."""
        import pyarrow.parquet

        self.files: dict[str, Any] = {}
        for name in FRAMES:
            path = folder / f"{name}.parquet"
            check_file(path, LARGEST_HASHED)
            self.files[name] = pyarrow.parquet.ParquetFile(path, page_checksum_verification=True)
            if frame_hash(path) != coverage.footers.get(name):
                raise ValueError(f"{path} is not of this consolidation.")

    def read(self, name: str, fields: Collection[str] | None = None) -> "pd.DataFrame":
        """Return a frame, or the columns of some fields that are there, as rows give it."""
        import pandas as pd

        table = self._table(name, fields)
        made = {name: _values(table.column(name)) for name in table.column_names}
        typed = {name: pd.Series(values, dtype=values.dtype) for name, values in made.items()}
        return pd.DataFrame(typed, index=pd.RangeIndex(table.num_rows))

    def fields_of_rows(self, fields: Collection[str]) -> dict[str, Row]:
        """Return some fields of all rows, by id, without those that a row does not have."""
        table = self._table("cells", fields)
        heads: list[Row] = [{} for _ in range(table.num_rows)]
        for name in table.column_names:
            for head, value in zip(heads, _python_values(table.column(name)), strict=True):
                if value is not None:
                    _put(head, name, value)
        return {head["id"]: head for head in heads}

    def _table(self, name: str, fields: Collection[str] | None) -> "pyarrow.Table":
        file = self.files[name]
        return file.read(columns=columns_of(fields, file.schema_arrow.names), use_threads=False)


def _put(row: Row, name: str, value: Any) -> None:
    """Put a value of a column into a row; "a.b" is the key b of the field a."""
    field, _, key = name.partition(".")
    if key:
        row.setdefault(field, {})[key] = value
    else:
        row[field] = value


def _python_values(column: Any) -> list[Any]:
    """Values of a column as JSON has them; whole numbers that stand among None are whole again."""
    values: list[Any] = column.to_pylist()  # to_numpy would load pandas
    return [_whole(value) for value in values] if column.type == "double" else values


def _whole(value: float | None) -> float | int | None:
    if value is None:
        return None
    return int(value) if value.is_integer() else value


def _values(column: Any) -> Any:
    """A column as `data_frames` types it: numbers, else objects with None for what is absent."""
    import pyarrow

    if pyarrow.types.is_floating(column.type) or pyarrow.types.is_integer(column.type):
        return column.to_numpy()
    if not pyarrow.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=object)
    # Each text is made once; a column of codes refers to it.
    encoded = column.dictionary_encode().unify_dictionaries()
    chunks = encoded.chunks
    words = np.array([*(chunks[0].dictionary.to_pylist() if chunks else ()), None], dtype=object)
    codes = [chunk.indices.fill_null(len(words) - 1).to_numpy() for chunk in chunks]
    return words[np.concatenate(codes)] if codes else np.array([], dtype=object)
