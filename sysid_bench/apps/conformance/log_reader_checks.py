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
from scipy.io import savemat

from sysid_bench.apps.conformance.findings import Finding, Kit, KitCase, Law
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.signals.log_library import log_library
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Array

JOINT_STATE: Final = "sensor_msgs/msg/JointState"


@dataclass(frozen=True, eq=False)
class _LogCase(KitCase):
    """A recorded file that the reader has to read."""

    file: Path


def check_log_reader(reader: Any, file: Path | None = None) -> list[Finding]:
    """Findings of all laws on a recorded file; None: on files that the kit writes, one for each
    common suffix of the reader.

    Raises UsageError where the kit has no file to read.
    """
    findings = _DeclarationKit.check(reader, [KitCase("its declaration")])
    if not findings[0].passed:  # files are chosen by suffix
        return findings
    if file is not None:
        return findings + _LogReaderKit.check(reader, [_LogCase(file.name, file)])
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
            findings += _LogReaderKit.check(reader, [case])
    return findings


class _DeclarationKit(Kit[KitCase]):
    @Law("declares its suffixes")
    def suffixes(self) -> str | None:
        wrong = [s for s in self.plugin.suffixes if not s.startswith(".") or s != s.lower()]
        return f"suffixes: {wrong[0]!r} must start with a dot and be lower case" if wrong else None

    @Law("can be hashed")
    def hashable(self) -> str | None:
        """Tables are cached by reader and file."""
        try:
            hash(self.plugin)
        except TypeError:
            return "it cannot be hashed: make it a frozen dataclass"
        return None


class _LogReaderKit(Kit[_LogCase]):
    runs = "reads a recorded file"

    def run(self) -> Any:
        return self.plugin.read(self.case.file)

    def kind(self) -> str:
        return "table" if isinstance(self.result, LogTable) else "other"

    @Law(runs, of=("other",))
    def no_table(self) -> str | None:
        return f"read() returned {type(self.result).__name__}, not a LogTable"

    @Law("gives numbers", of=("table",))
    def numbers(self) -> str | None:
        """Floats (N, c), N and c above zero, some of them finite."""
        values = self.result.values
        if values.ndim != 2 or values.dtype.kind != "f" or not values.size:
            return f"values are {values.dtype} {values.shape}; floats (N, c) are required"
        return None if np.isfinite(values).any() else "values hold no finite number"

    @Law("names columns of its table", of=("table",))
    def names(self) -> str | None:
        columns = set(range(self.result.values.shape[1]))
        outside = [name for name, at in self.result.names.items() if not set(at) <= columns]
        if not outside:
            return None
        return f"name {outside[0]!r} stands for columns outside of 0 ... {len(columns) - 1}"

    @Law("names a column once", of=("table",))
    def unique(self) -> str | None:
        """An array may have a name besides those of its columns."""
        single = [indices for indices in self.result.names.values() if len(indices) == 1]
        return "two names stand for the same column" if len(set(single)) < len(single) else None

    @Law("is deterministic", of=("table",))
    def repeats(self) -> str | None:
        table, again = self.result, self.run()
        # Empty cells are NaN, which equals nothing.
        same = np.array_equal(table.values, again.values, equal_nan=True)
        if same and dict(table.names) == dict(again.names):
            return None
        return "two calls return different tables"

    @Law("refuses an empty file", of=("table",))
    def empty(self) -> str | None:
        return self._accepts_damage("an empty file", 0.0)

    @Law("refuses a truncated file", of=("table",))
    def truncated(self) -> str | None:
        """A format of lines may yield fewer samples, as a logger that was stopped leaves them."""
        return self._accepts_damage("a truncated file", 0.5)

    def _accepts_damage(self, damage: str, share: float) -> str | None:
        """Violation where this share of the bytes of the file, or of the largest one in a folder,
        gives neither a UsageError nor fewer samples than all of it."""
        file = self.case.file
        with tempfile.TemporaryDirectory() as folder:
            damaged = Path(folder, file.name)
            if file.is_dir():
                shutil.copytree(file, damaged)
                files = [one for one in sorted(damaged.rglob("*")) if one.is_file()]
            else:
                files = [Path(shutil.copyfile(file, damaged))]
            # In a folder the largest file holds the samples.
            largest = max(files, key=lambda file: file.stat().st_size)
            largest.write_bytes(largest.read_bytes()[: int(share * largest.stat().st_size)])
            try:
                left = len(self.plugin.read(damaged).values)
            except UsageError:
                return None
            except Exception as error:
                return f"{damage} raised {reason_of(error)}; raise UsageError"
        if 0 < left < len(self.result.values):
            return None
        return f"{damage} gives {left} samples; raise UsageError"


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


def _write_parquet(file: Path) -> None:
    from pyarrow import parquet, table

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
            for stamp, message in _joint_states(store):
                bag.write(topic, stamp, bytes(store.serialize_cdr(message, JOINT_STATE)))
        shutil.copyfile(next(Path(folder, "bag").glob(f"*{file.suffix}")), file)


def _write_first_bag(file: Path) -> None:
    """The same bag of ROS 1."""
    types = log_library("rosbags.typesys", file)
    store = types.get_typestore(types.Stores.ROS1_NOETIC)
    with log_library("rosbags.rosbag1", file).Writer(file) as bag:
        topic = bag.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for stamp, message in _joint_states(store):
            bag.write(topic, stamp, bytes(store.serialize_ros1(message, JOINT_STATE)))


def _joint_states(store: Any) -> Iterator[tuple[int, Any]]:
    """Stamp (ns) and message of the signals, the joints in changing order."""
    state, header = store.types[JOINT_STATE], store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    signals = _signals()
    # Headers of ROS 1 have a number, too.
    number = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    for i, t in enumerate(signals["t"]):
        order, stamp = [[0, 1], [1, 0]][i % 2], round(t * 1e9)
        message = state(
            header=header(
                stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="", **number
            ),
            name=[("j1", "j2")[k] for k in order],
            position=signals["q"][i, order],
            velocity=np.zeros(0),
            effort=signals["tau"][i, order],
        )
        yield stamp, message


def _write_lerobot(folder: Path) -> None:
    from pyarrow import array, parquet, table

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
    ".npz": lambda file: np.savez(file, **_signals()),
    ".npy": lambda file: np.save(file, _matrix()),
    ".mat": lambda file: savemat(file, _signals()),
    ".parquet": _write_parquet,
    ".h5": _write_hdf5,
    ".hdf5": _write_hdf5,
    ".rrd": _write_rerun,
    ".bag": _write_first_bag,
    ".db3": _write_bag,
    ".mcap": _write_bag,
    "meta/info.json": _write_lerobot,
}
"""Common formats by suffix, or by the file that marks a folder, with a function that writes a small
recording."""
