"""LeRobot data sets, versions 2 and 3: the folder with meta/info.json and parquet files."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import parse_json, read_text
from sysid_bench.signals.log_table import LogTable, columns_with_names
from sysid_bench.types import Array

_EPISODE: Final = "episode_index"
_DOUBT: Final = (
    "LeRobot states no units: positions may be in rad, in degrees, or in percent of a calibrated "
    "range. Write unit = 'rad' or unit = 'deg'; percent needs gain = [...] in rad for each"
)


@dataclass(frozen=True)
class Lerobot:
    """One episode of a data set: features as arrays, their columns named as in meta/info.json
    ("observation.state.elbow"), and the rate stated there."""

    episode: int | None = None
    suffixes: ClassVar[tuple[str, ...]] = ()
    folder_files: ClassVar[tuple[str, ...]] = ("meta/info.json", "data/**/*.parquet")

    def read(self, path: Path) -> LogTable:
        """Return the columns of an episode; raises UsageError where several exist and none is
        chosen, and for a damaged file."""
        info = _info(path)
        arrays = _episode_arrays(path, self._chosen(path, info))
        named = {name: (x, _words(info, name, x.shape[1])) for name, x in arrays.items()}
        values, names = columns_with_names(path, named)
        return LogTable(path, values, names, rate=_rate(info), unit_doubt=_DOUBT)

    def _chosen(self, path: Path, info: Mapping[str, Any]) -> int:
        count = info.get("total_episodes")
        if self.episode is not None:
            return self.episode
        if count == 1:
            return 0
        raise UsageError(
            f"{path} holds {count} episodes; choose one with reader = {{ use = 'lerobot', "
            "episode = 0 }."
        )


def _info(path: Path) -> Mapping[str, Any]:
    """Return meta/info.json; raises UsageError for another text."""
    file = path / "meta" / "info.json"
    try:
        info = parse_json(read_text(file))
    except ValueError as error:
        raise UsageError(f"{file} is not valid JSON: {error}.") from error
    if not isinstance(info, Mapping):
        raise UsageError(f"{file} is not the description of a LeRobot data set.")
    return info


def _rate(info: Mapping[str, Any]) -> float | None:
    rate = info.get("fps")
    return float(rate) if isinstance(rate, (int, float)) and 0 < rate < 1e9 else None


def _episode_arrays(path: Path, episode: int) -> dict[str, Array]:
    """Return the columns of one episode, which may lie in several files.

    Raises UsageError with the number of files looked through where it is in none of them.
    """
    files = sorted(path.glob("data/**/*.parquet"))
    own = [file for file in files if file.name == f"episode_{episode:06d}.parquet"]
    parts = [part for file in own or files if (part := _rows(file, episode)) is not None]
    if not parts:
        raise UsageError(f"{path}: no episode {episode} in its {len(files)} parquet files.")
    return _joined(parts)


def _joined(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return the columns that all parts have, one part after the other."""
    shared = set.intersection(*map(set, parts))
    return {
        name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name in shared
    }


def _rows(file: Path, episode: int) -> dict[str, Array] | None:
    """Return the rows of an episode in a file by column, None where it has none."""
    from sysid_bench.signals.arrow_columns import read_arrow  # loads pyarrow

    # Its other columns are unpacked only where the file holds the episode.
    rows = read_arrow(file, [_EPISODE])[_EPISODE][:, 0] == episode
    return {name: x[rows] for name, x in read_arrow(file).items()} if rows.any() else None


def _words(info: Mapping[str, Any], feature: str, width: int) -> list[str]:
    """Return names of the columns of a feature, [] where the file has none for each of them."""
    features = info.get("features")
    entry = features.get(feature) if isinstance(features, Mapping) else None
    written = entry.get("names") if isinstance(entry, Mapping) else None
    words = list(_texts(written))
    unique = len(set(words)) == len(words) == width > 1
    return [f"{feature}.{word}" for word in words] if unique else []


def _texts(written: Any) -> Iterator[str]:
    """Yield names in a list, or in the lists of a table such as {"motors": [...]}."""
    if isinstance(written, Mapping):
        lists = [value for value in written.values() if isinstance(value, list)]
        written = list(chain.from_iterable(lists))
    if isinstance(written, list):
        yield from (word for word in written if isinstance(word, str))
