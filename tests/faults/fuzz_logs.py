"""Formats of recordings that the check kit writes: damaged, they give one sentence."""

from pathlib import Path
from typing import Final

import h5py
import numpy as np
import rerun.chunk  # noqa: F401 - once, not in each process
import rosbags.rosbag2
import rosbags.typesys  # noqa: F401 - once, not in each process

from sysid_bench.apps.conformance.log_reader_checks import WRITERS
from sysid_bench.errors import UsageError
from sysid_bench.signals.log_reader import read_table
from tests.faults.fuzz_kind import Kind, text_files

_FOLDER: Final = "recording"

_METADATA: Final = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: sqlite3
  duration: {nanoseconds: 1990000000}
  starting_time: {nanoseconds_since_epoch: 0}
  message_count: 200
  topics_with_message_count:
    - topic_metadata:
        name: /joint_states
        type: sensor_msgs/msg/JointState
        serialization_format: cdr
        offered_qos_profiles: []
        type_description_hash: ""
      message_count: 200
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [bag.db3]
  files:
    - path: bag.db3
      starting_time: {nanoseconds_since_epoch: 0}
      duration: {nanoseconds: 1990000000}
      message_count: 200
"""


def _file_kind(suffix: str) -> Kind:
    def make(folder: Path) -> None:
        WRITERS[suffix](folder / f"log{suffix}")

    def read(folder: Path) -> None:
        if not list(folder.iterdir()):
            raise UsageError("absent")
        read_table(folder / f"log{suffix}")

    return Kind(f"log{suffix}", make, (f"*{suffix}",), read)


def _make_matlab_73(folder: Path) -> None:
    with h5py.File(folder / "log.mat", "w", userblock_size=512) as file:
        file["t"] = np.arange(40)[None] / 100
        file["run/q"] = np.random.default_rng(0).normal(size=(2, 40))
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    with (folder / "log.mat").open("r+b") as written:
        written.write(header)


def _read_matlab(folder: Path) -> None:
    read_table(folder / "log.mat")


def _make_data_set(folder: Path) -> None:
    WRITERS["meta/info.json"](folder / _FOLDER)


def _make_bag(folder: Path) -> None:
    text_files({f"{_FOLDER}/metadata.yaml": _METADATA})(folder)
    WRITERS[".db3"](folder / _FOLDER / "bag.db3")


def _read_folder(folder: Path) -> None:
    read_table(folder / _FOLDER)


_DATA_SET: Final = (f"{_FOLDER}/meta/info.json", f"{_FOLDER}/data/*.parquet")

LOG_KINDS: Final = (
    *(_file_kind(suffix) for suffix in (".h5", ".db3", ".mcap", ".rrd")),
    Kind("log.mat 7.3", _make_matlab_73, ("log.mat",), _read_matlab),
    Kind("lerobot", _make_data_set, _DATA_SET, _read_folder),
    Kind("bag", _make_bag, (f"{_FOLDER}/metadata.yaml",), _read_folder),
)
