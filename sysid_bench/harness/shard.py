"""Shards of a plan: disjoint parts for machines that share nothing, whole experiments each."""

from collections.abc import Iterable
from dataclasses import dataclass

from sysid_bench.errors import UsageError
from sysid_bench.harness.cell import Cell


@dataclass(frozen=True)
class Shard:
    """Part `index` (from 1) of `count`, chosen by the ids of experiments alone: the same cells on
    every machine, whatever is selected there."""

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

    def cells(self, cells: Iterable[Cell]) -> tuple[Cell, ...]:
        """Return the cells of this part."""
        return tuple(cell for cell in cells if self._of(cell.experiment) == self.index - 1)

    def _of(self, experiment: str) -> int:
        return int(experiment, 16) % self.count
