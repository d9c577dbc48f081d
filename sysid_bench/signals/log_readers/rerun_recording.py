"""Rerun recordings (.rrd): series of scalars, named by the paths of their entities."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file
from sysid_bench.signals.library_errors import library_errors
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, columns_with_names
from sysid_bench.types import Array

_SCALARS: Final = "Scalars:scalars"
_AUTOMATIC: Final = ("log_time", "log_tick")
"""Timelines that every recording has, of the computer that wrote it."""

_Series = dict[str, tuple[Array, Array]]
"""Time (N,) and scalars (N, k) of each entity."""


@dataclass(frozen=True)
class RerunRecording:
    """Series of scalars over one timeline: the largest set of entities with equal times, all of
    the file or those below the path `entity`; `t` is the time (s, or the number of a sequence)."""

    timeline: str = ""
    entity: str = ""
    suffixes: ClassVar[tuple[str, ...]] = (".rrd",)

    def read(self, path: Path) -> LogTable:
        """Return the series as columns; raises UsageError for a damaged file, or where the timeline
        is not clear."""
        check_file(path, LARGEST_LOG)
        with library_errors(path, "a Rerun recording"):
            batches = list(_scalar_batches(path, self.entity.strip("/")))
            series = _series(batches, self._timeline(path, batches))
        times, together = _largest_set(path, series)
        arrays = {"t": (times[:, None], ()), **{name: (x, ()) for name, x in together.items()}}
        return LogTable(path, *columns_with_names(path, arrays))

    def _timeline(self, path: Path, batches: list[tuple[str, Any]]) -> str:
        """Return the timeline named, or the only one that the recording's author chose."""
        every = set(chain.from_iterable(_timelines(batch) for _, batch in batches))
        chosen = {self.timeline} if self.timeline else _chosen_by_author(every)
        if len(chosen) == 1 and chosen <= every:
            return chosen.pop()
        raise UsageError(
            f"{path} has the timelines {', '.join(sorted(every)) or '(none)'}; name one with "
            "reader = { use = 'rerun', timeline = '...' }."
        )


def _chosen_by_author(timelines: set[str]) -> set[str]:
    """Return the timelines that Rerun does not add itself, or that of logging alone."""
    return timelines - {*_AUTOMATIC} or timelines & {"log_time"}


def _scalar_batches(path: Path, below: str) -> Iterator[tuple[str, Any]]:
    """Yield entity and Arrow batch of each chunk of scalars that change over time."""
    from rerun.chunk import RrdReader  # 0.6 s, spent only where such a file is read

    for chunk in RrdReader(path).stream():
        entity = chunk.entity_path.strip("/")
        if _is_below(entity, below) and not chunk.is_static:
            batch = chunk.to_record_batch()
            if _SCALARS in batch.schema.names:
                yield entity, batch


def _timelines(batch: Any) -> list[str]:
    return [name for name in batch.schema.names if ":" not in name and not name.startswith("rerun")]


def _series(batches: list[tuple[str, Any]], timeline: str) -> _Series:
    """Return time and scalars of each entity on a timeline, its chunks in the order of time."""
    parts: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for entity, batch in batches:
        if timeline in batch.schema.names:
            parts[entity].append((_times(batch.column(timeline)), _scalars(batch)))
    return {entity: _joined(chunks) for entity, chunks in parts.items()}


def _times(column: Any) -> Array:
    """Return times in s, or the numbers of a sequence; a date counts from 1970."""
    import pyarrow

    scale = 1.0 if pyarrow.types.is_integer(column.type) else 1e-9
    return np.asarray(column.cast(pyarrow.int64()).to_numpy(zero_copy_only=False) * scale)


def _is_below(entity: str, path: str) -> bool:
    return not path or entity == path or entity.startswith(f"{path}/")


def _scalars(batch: Any) -> Array:
    """Return the scalars (N, k) of a chunk; NaN where one logged none or another number of them."""
    lists = batch.column(batch.schema.names.index(_SCALARS))
    flat = np.asarray(lists.flatten().to_numpy(zero_copy_only=False), dtype=float)
    width = max(len(flat) // max(len(lists), 1), 1)
    lengths = np.array([len(value) if value.is_valid else 0 for value in lists])
    if (lengths == width).all():
        return flat.reshape(-1, width)
    rows = [value.as_py() or [] for value in lists]
    return np.array([row if len(row) == width else [np.nan] * width for row in rows], dtype=float)


def _joined(chunks: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the chunks of an entity as one series in the order of time."""
    widest = max(x.shape[1] for _, x in chunks)
    kept = [(t, x) for t, x in chunks if x.shape[1] == widest]
    times = np.concatenate([t for t, _ in kept])
    order = np.argsort(times, kind="stable")
    return times[order], np.concatenate([x for _, x in kept])[order]


def _largest_set(path: Path, series: _Series) -> tuple[Array, dict[str, Array]]:
    """Return times and scalars of the largest set of entities with equal times."""
    sets: dict[bytes, list[str]] = defaultdict(list)
    for entity, (times, _) in series.items():
        sets[times.tobytes()].append(entity)
    if not sets:
        raise UsageError(f"{path} holds no series of scalars.")
    entities = max(sets.values(), key=lambda names: (len(names), len(series[names[0]][0])))
    return series[entities[0]][0], {entity: series[entity][1] for entity in sorted(entities)}
