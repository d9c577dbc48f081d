"""Shards of a plan: disjoint parts for machines that share nothing, whole experiments each."""

from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heapify, heapreplace
from math import fsum

from sysid_bench.errors import UsageError
from sysid_bench.harness.cell import Cell


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
        for name in sorted(costs, key=lambda name: (-costs[name], name)):
            load, index = loads[0]
            heapreplace(loads, (load + costs[name], index))
            if index == self.index:
                own.add(name)
        return frozenset(own)
