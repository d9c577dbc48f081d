"""Rows of many cells in little memory."""

from collections.abc import Iterable, Iterator, Mapping

from sysid_bench.types import Row


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
