"""Rows of a run that another process is writing."""

from dataclasses import dataclass, field
from pathlib import Path

from sysid_bench.harness.work.row_files import lines, parse_row, row_files, with_entries
from sysid_bench.types import Row


@dataclass(eq=False)
class NewRows:
    """Rows below a run folder by id; each line is read once."""

    folder: Path
    rows: dict[str, Row] = field(default_factory=dict)
    _behind: dict[Path, tuple[int, int]] = field(default_factory=dict)

    def update(self) -> None:
        """Read the lines that were completed since the last look."""
        for path in row_files(self.folder / "cells"):
            number, offset = self._behind.get(path, (0, 0))
            for line in lines(path, number, offset):
                if line.unfinished:
                    break
                self._behind[path] = line.number, line.end
                if (row := parse_row(line.text, hashed=True)) is not None:
                    self.rows[row["id"]] = with_entries(row)
