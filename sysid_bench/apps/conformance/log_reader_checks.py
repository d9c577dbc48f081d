"""Conformance kit of log readers: what a plug-in owes `identify --log`.

`read(path)` gives a LogTable of a recorded file. The kit writes files of common formats itself; for
another format, or another dialect of one, it takes a recorded file.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pyarrow import array, parquet, table
from scipy.io import savemat

from sysid_bench.apps.conformance.findings import Finding, Kit, Laws, findings_of
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.signals.log_library import log_library
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Array

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
READS: Final = "reads a recorded file"


@dataclass(frozen=True, eq=False)
class _LogCase:
    """A recorded file that the reader has to read."""

    name: str
    file: Path


def check_log_reader(reader: Any, file: Path | None = None) -> list[Finding]:
    """Findings of all laws on a recorded file; None: on files that the kit writes, one for each
    common suffix of the reader.

    Raises UsageError where the kit has no file to read.
    """
    findings = findings_of(DECLARED, "its declaration", reader)
    if not findings[0].passed:  # files are chosen by suffix
        return findings
    if file is not None:
        return findings + _LOG_READER_KIT.findings(reader, [_LogCase(file.name, file)])
    folders = getattr(reader, "folder_files", ())[:1]
    formats = [suffix for suffix in (*reader.suffixes, *folders) if suffix in WRITERS]
    if not formats:
        raise UsageError(
            f"A log reader for {', '.join(reader.suffixes) or 'no suffix'} is checked on a "
            f"recorded file: name one with --file FILE. Only {', '.join(WRITERS)} files are "
            "written by the check itself."
        )
    with tempfile.TemporaryDirectory() as folder:
        for suffix in formats:
            written = Path(folder, f"written{suffix}" if suffix.startswith(".") else "written")
            WRITERS[suffix](written)
            case = _LogCase(f"a {suffix} file of the kit", written)
            findings += _LOG_READER_KIT.findings(reader, [case])
    return findings


def _table_laws(case: _LogCase, table: Any) -> Iterator[Laws]:
    yield LOG_LAWS if isinstance(table, LogTable) else {READS: _is_no_table}


def _is_no_table(reader: Any, case: _LogCase, table: Any) -> str:
    return f"read() returned {type(table).__name__}, not a LogTable"


def _has_suffixes(reader: Any) -> str | None:
    wrong = [s for s in reader.suffixes if not s.startswith(".") or s != s.lower()]
    return f"suffixes: {wrong[0]!r} must start with a dot and be lower case" if wrong else None


def _can_be_hashed(reader: Any) -> str | None:
    """Tables are cached by reader and file."""
    try:
        hash(reader)
    except TypeError:
        return "it cannot be hashed: make it a frozen dataclass"
    return None


def _gives_numbers(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    """Floats (N, c), N and c above zero, some of them finite."""
    values = table.values
    if values.ndim != 2 or values.dtype.kind != "f" or not values.size:
        return f"values are {values.dtype} {values.shape}; floats (N, c) are required"
    return None if np.isfinite(values).any() else "values hold no finite number"


def _names_columns(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    """Names stand for columns of the table."""
    columns = range(table.values.shape[1])
    outside = [name for name, indices in table.names.items() if not set(indices) <= set(columns)]
    if not outside:
        return None
    return f"name {outside[0]!r} stands for columns outside of 0 ... {len(columns) - 1}"


def _names_a_column_once(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    """An array may have a name besides those of its columns."""
    single = [indices for indices in table.names.values() if len(indices) == 1]
    return "two names stand for the same column" if len(set(single)) < len(single) else None


def _is_deterministic(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    again = reader.read(case.file)
    # Empty cells are NaN, which equals nothing.
    same = np.array_equal(table.values, again.values, equal_nan=True)
    if same and dict(table.names) == dict(again.names):
        return None
    return "two calls return different tables"


def _refuses_an_empty_file(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    return _accepts_damage("an empty file", reader, case, table, 0.0)


def _refuses_a_truncated_file(reader: Any, case: _LogCase, table: LogTable) -> str | None:
    """A format of lines may yield fewer samples: a logger that was stopped leaves such files."""
    return _accepts_damage("a truncated file", reader, case, table, 0.5)


def _accepts_damage(
    damage: str, reader: Any, case: _LogCase, table: LogTable, share: float
) -> str | None:
    """Violation where this share of the bytes of the file, or of the largest one in a folder, gives
    neither a UsageError nor fewer samples than all of it."""
    with tempfile.TemporaryDirectory() as folder:
        damaged = _copied(case.file, Path(folder))
        largest = max(_files(damaged), key=lambda file: file.stat().st_size)
        largest.write_bytes(largest.read_bytes()[: int(share * largest.stat().st_size)])
        try:
            left = len(reader.read(damaged).values)
        except UsageError:
            return None
        except Exception as error:
            return f"{damage} raised {reason_of(error)}; raise UsageError"
    if 0 < left < len(table.values):
        return None
    return f"{damage} gives {left} samples; raise UsageError"


def _copied(recording: Path, folder: Path) -> Path:
    """Copy of a recorded file or folder."""
    copy = folder / recording.name
    if recording.is_dir():
        shutil.copytree(recording, copy)
    else:
        shutil.copyfile(recording, copy)
    return copy


def _files(recording: Path) -> list[Path]:
    if not recording.is_dir():
        return [recording]
    return [file for file in sorted(recording.rglob("*")) if file.is_file()]


DECLARED: Final[dict[str, Callable[[Any], str | None]]] = {
    "declares its suffixes": _has_suffixes,
    "can be hashed": _can_be_hashed,
}
LOG_LAWS: Final[Laws] = {
    "gives numbers": _gives_numbers,
    "names columns of its table": _names_columns,
    "names a column once": _names_a_column_once,
    "is deterministic": _is_deterministic,
    "refuses an empty file": _refuses_an_empty_file,
    "refuses a truncated file": _refuses_a_truncated_file,
}

_LOG_READER_KIT: Final = Kit(
    runs=READS,
    run=lambda reader, case: reader.read(case.file),
    laws=_table_laws,
    given=lambda case: (),  # a file, which holds no arrays
    changed="",
)

_NAMES: Final = ("t", "q1", "q2", "tau1", "tau2")


def _signals() -> dict[str, Any]:
    """Time (s), position (rad) and torque (N m) of two joints, 200 samples."""
    t = np.arange(200) / 100.0
    q = np.sin(np.outer(t, (1.0, 2.0)))
    return {"t": t, "q": q, "tau": -9.81 * q}


def _matrix() -> Array:
    """The same signals as columns `_NAMES`, (200, 5)."""
    return np.column_stack(list(_signals().values()))


def _write_text(file: Path) -> None:
    np.savetxt(file, _matrix(), delimiter=",", header=",".join(_NAMES), comments="")


def _write_npz(file: Path) -> None:
    np.savez(file, **_signals())


def _write_npy(file: Path) -> None:
    np.save(file, _matrix())


def _write_mat(file: Path) -> None:
    savemat(file, _signals())


def _write_parquet(file: Path) -> None:
    parquet.write_table(table(dict(zip(_NAMES, _matrix().T, strict=True))), file)


def _write_hdf5(file: Path) -> None:
    h5py = log_library("h5py", file)
    with h5py.File(file, "w") as written:
        for name, values in _signals().items():
            written[f"observations/{name}"] = values


def _write_rerun(file: Path) -> None:
    import rerun as rr  # 0.6 s, spent only where such a reader is checked

    stream = rr.RecordingStream("sysid_bench", recording_id="kit")
    stream.save(file)
    times = rr.TimeColumn("time", duration=_matrix()[:, 0])
    for name, values in zip(_NAMES[1:], _matrix().T[1:], strict=True):
        stream.send_columns(name, indexes=[times], columns=rr.Scalars.columns(scalars=values))
    stream.flush()
    stream.disconnect()


def _write_bag(file: Path) -> None:
    """A bag of joint states; what is written as a folder is left as its only file."""
    bags = log_library("rosbags.rosbag2", file)
    types = log_library("rosbags.typesys", file)
    plugin = getattr(bags.StoragePlugin, "MCAP" if file.suffix == ".mcap" else "SQLITE3")
    store = types.get_typestore(types.Stores.LATEST)
    with tempfile.TemporaryDirectory() as folder:
        with bags.Writer(Path(folder, "bag"), version=9, storage_plugin=plugin) as bag:
            topic = bag.add_connection("/joint_states", JOINT_STATE, typestore=store)
            for stamp, raw in _joint_states(store):
                bag.write(topic, stamp, raw)
        shutil.copyfile(next(Path(folder, "bag").glob(f"*{file.suffix}")), file)


def _joint_states(store: Any) -> Iterator[tuple[int, bytes]]:
    """Stamp (ns) and bytes of the signals as messages, the joints in changing order."""
    state, header = store.types[JOINT_STATE], store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    signals = _signals()
    for i, t in enumerate(signals["t"]):
        order, stamp = [[0, 1], [1, 0]][i % 2], round(t * 1e9)
        message = state(
            header=header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=""),
            name=[("j1", "j2")[k] for k in order],
            position=signals["q"][i, order],
            velocity=np.zeros(0),
            effort=signals["tau"][i, order],
        )
        yield stamp, bytes(store.serialize_cdr(message, JOINT_STATE))


def _write_lerobot(folder: Path) -> None:
    signals = _signals()
    columns = {
        "observation.state": array(signals["q"].tolist()),
        "timestamp": signals["t"],
        "episode_index": np.zeros(len(signals["t"]), dtype=int),
    }
    info = {
        "codebase_version": "v2.1",
        "fps": 100,
        "total_episodes": 1,
        "features": {"observation.state": {"names": ["j1", "j2"]}},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    parquet.write_table(table(columns), folder / "data" / "episode_000000.parquet")


WRITERS: Final[Mapping[str, Callable[[Path], None]]] = {
    ".csv": _write_text,
    ".txt": _write_text,
    ".npz": _write_npz,
    ".npy": _write_npy,
    ".mat": _write_mat,
    ".parquet": _write_parquet,
    ".h5": _write_hdf5,
    ".hdf5": _write_hdf5,
    ".rrd": _write_rerun,
    ".db3": _write_bag,
    ".mcap": _write_bag,
    "meta/info.json": _write_lerobot,
}
"""Common formats by suffix, or by the file that marks a folder, with a function that writes a small
recording."""
