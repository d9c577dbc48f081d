"""Log readers: built-in ones keep the requirements of the check kit, a plug-in of fifteen lines
joins by suffix or by name, and its errors are one sentence."""

import json
import struct
from dataclasses import dataclass
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sysid_bench import identify, plugin_names
from sysid_bench.apps.conformance import failed_checks
from sysid_bench.apps.conformance.log_reader_checks import check_log_reader
from sysid_bench.commands.check_plugin import check_plugin
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.pytest_plugin import assert_conforms
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_reader import read_table
from sysid_bench.signals.log_table import LogTable, table_of_arrays
from tests.robots import named_robot

from .logs import Recorded, recorded, write

PLUGIN = """
from dataclasses import dataclass
import numpy as np
from sysid_bench.errors import UsageError
from sysid_bench.signals.log_table import LogTable, table_of_arrays

@dataclass(frozen=True)
class Reader:
    channels: int = 19
    suffixes = (".raw",)

    def read(self, path) -> LogTable:
        x = np.fromfile(path)
        if len(x) == 0 or len(x) % self.channels:
            raise UsageError(f"{path} does not hold {self.channels} channels.")
        return table_of_arrays(path, {"all": x.reshape(-1, self.channels)})
"""
"""Doubles, sample after sample; 19 channels are t, q, v, tau of six joints."""

PARTS: dict[str, Any] = {
    name: {"columns": [f"all:{2 + 6 * i + j}" for j in range(6)]}
    for i, name in enumerate(("q", "v", "tau"))
}


@pytest.fixture(scope="module")
def log() -> Recorded:
    return recorded(named_robot("ur5"), period=2.0)


@pytest.fixture
def raw(tmp_path: Path, log: Recorded) -> Path:
    """mine.py with the plug-in, and run.raw."""
    (tmp_path / "mine.py").write_text(PLUGIN)
    np.column_stack([log.t, log.q, log.v, log.tau]).tofile(tmp_path / "run.raw")
    return tmp_path / "run.raw"


def description(folder: Path, log: Recorded, **changed: Any) -> Path:
    """run.toml of run.raw."""
    return write(folder, log, **{"file": "run.raw", **PARTS, **changed})


@pytest.mark.parametrize("kind", ["csv", "csv bare", "csv ;", "txt", "npz", "mat", "parquet"])
def test_built_in_readers_pass_the_check_kit(kind: str, log: Recorded, tmp_path: Path) -> None:
    file = write(tmp_path, log, kind).with_suffix("." + kind.partition(" ")[0])
    readers = {
        name: plugin_names.build("log_reader", name) for name in plugin_names.known("log_reader")
    }
    (reader,) = (one for one in readers.values() if file.suffix in one.suffixes)
    assert failed_checks(check_log_reader(reader, file)) == []


def test_one_array_without_a_name(tmp_path: Path) -> None:
    file = tmp_path / "run.npy"
    np.save(file, np.arange(12.0).reshape(6, 2))
    np.testing.assert_array_equal(read_table(file).columns([2])[:, 0], np.arange(1.0, 12.0, 2))
    assert failed_checks(check_log_reader(plugin_names.build("log_reader", "numpy"), file)) == []


def test_a_plug_in_reader_identifies_a_robot(raw: Path, log: Recorded) -> None:
    named = description(raw.parent, log, reader="file:mine.py:Reader")
    answer = identify("ur5", log=[named], filter="none", derivatives="from v", estimator="ols")
    assert answer["logs"][0]["samples"] == len(log.t)
    plain = write(raw.parent, log, name="plain")
    same = identify("ur5", log=[plain], filter="none", derivatives="from v", estimator="ols")
    assert answer["rmse_train"] == pytest.approx(same["rmse_train"], rel=1e-9)
    assert_conforms(f"file:{raw.parent}/mine.py:Reader", "log-reader", raw)


def test_a_reader_has_settings_and_one_signal_may_name_its_own(raw: Path, log: Recorded) -> None:
    np.column_stack([log.t, log.q, log.v]).tofile(raw.parent / "short.raw")
    reader = {"use": "file:mine.py:Reader", "channels": 13}
    q = {"file": "short.raw", "reader": reader, "columns": [2, 3, 4, 5, 6, 7]}
    path = description(raw.parent, log, reader="file:mine.py:Reader", q=q)
    read = read_description(path)
    table = read_table(read.file_of(read.q), read.reader_of(read.q))
    np.testing.assert_array_equal(table.columns(read.q.columns), log.q)
    assert {file.name for file in read.files} == {"short.raw", "run.raw", "mine.py"}


def test_a_file_of_another_suffix_by_the_name_of_its_reader(tmp_path: Path, log: Recorded) -> None:
    write(tmp_path, log)
    (tmp_path / "run.csv").rename(tmp_path / "run.log")
    read = read_description(write(tmp_path, log, file="run.log", reader="delimited-text"))
    assert len(read_table(read.file_of(read.q), read.reader_of(read.q)).values) == len(log.t)
    assert [file.name for file in read.files] == ["run.log"]


def test_an_installed_reader_is_chosen_by_suffix(
    raw: Path, log: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    def installed() -> EntryPoints:
        target = f"file:{raw.parent / 'mine.py'}:Reader"
        return EntryPoints([EntryPoint("raw", target, "sysid_bench.log_readers")])

    with pytest.raises(
        UsageError, match=r"'\.raw'.*\.parquet.*reader = .*sysid_bench\.log_readers"
    ):
        read_table(raw)
    monkeypatch.setattr(plugin_names, "entry_points", installed)
    assert len(read_table(raw).values) == len(log.t)
    assert raw.parent / "mine.py" in read_description(description(raw.parent, log)).files


def test_errors_of_a_plug_in_are_one_sentence(raw: Path, log: Recorded) -> None:
    mine = raw.parent / "mine.py"
    spec = f"file:{mine}:Reader"
    raw.write_bytes(struct.pack("5d", *range(5)))
    with pytest.raises(UsageError, match="does not hold 19 channels"):
        read_table(raw, spec)
    mine.write_text(PLUGIN.replace("raise UsageError(", "raise KeyError("))
    with pytest.raises(UsageError, match=r"run\.raw: the log reader .* failed with KeyError"):
        read_table(raw, spec)
    mine.write_text(PLUGIN.replace("return table_of_arrays(", "return (").replace("5d", "19d"))
    raw.write_bytes(struct.pack("19d", *range(19)))
    with pytest.raises(UsageError, match="must return a LogTable"):
        read_table(raw, spec)
    with pytest.raises(UsageError, match="parquet"):
        read_table(raw, "parket")
    with pytest.raises(UsageError, match="use = "):
        read_table(raw, {"channels": 13})


@dataclass
class _Careless:
    """Breaks one requirement on reading, or with "names" several."""

    mistake: str
    calls: int = 0

    @property
    def suffixes(self) -> tuple[str, ...]:
        return ("RAW",) if self.mistake == "suffix" else (".raw",)

    def __hash__(self) -> int:
        if self.mistake == "hash":
            raise TypeError("unhashable type")
        return 0

    def read(self, path: Path) -> Any:
        if self.mistake == "absent":
            raise KeyError("q")
        if self.mistake == "array":
            return np.zeros((3, 2))
        self.calls += 1
        values = np.full((3, 2), float(self.calls) if self.mistake == "memory" else 1.0)
        if self.mistake == "integers":
            values = values.astype(int)
        if self.mistake == "nan":
            values[:] = np.nan
        return LogTable(path, values, {"a": (0,), "b": (0,), "c": (2,)})


CARELESS = {
    "suffix": "declares its suffixes .* 'RAW' must start with a dot",
    "hash": "it cannot be hashed",
    "absent": "reads a recorded file .*: it raised KeyError",
    "array": "read\\(\\) returned ndarray, not a LogTable",
    "memory": "two calls return different tables",
    "integers": "values are int.* floats \\(N, c\\) are required",
    "nan": "values hold no finite number",
}


@pytest.mark.parametrize("mistake", CARELESS)
def test_a_careless_reader_is_found(mistake: str, raw: Path) -> None:
    with pytest.raises(AssertionError, match=CARELESS[mistake]):
        assert_conforms(_Careless(mistake), "log-reader", raw)


def test_the_check_kit_finds_every_law_that_is_broken(raw: Path) -> None:
    broken = "\n".join(failed_checks(check_log_reader(_Careless("memory"), raw)))
    for text in ("'c'", "same column", "two calls", "empty", "truncated"):
        assert text in broken


@pytest.mark.parametrize("name", plugin_names.BUILTIN["log_reader"])
def test_built_in_readers_are_checked_on_files_of_the_kit(name: str) -> None:
    if name == "rerun":
        pytest.importorskip("rerun.chunk", reason="needs rerun-sdk 0.38 or newer, which reads")
    answer = check_plugin(name, kind="log-reader")
    assert (answer.ok, answer.broken) == (True, [])
    assert answer.checks >= 8


def test_a_reader_of_another_format_is_checked_on_a_file(raw: Path) -> None:
    use = f"file:{raw.parent}/mine.py:Reader"
    command = ["check-plugin", "--kind", "log-reader", use]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2
    assert "is checked on a recorded file: name one with --file" in result.output
    result = CliRunner().invoke(main, [*command, "--file", str(raw)])
    assert result.exit_code == 0, result.output
    raw.write_bytes(raw.read_bytes()[:-8])
    result = CliRunner().invoke(main, [*command, "--file", str(raw), "--json"])
    assert result.exit_code == 1
    (failed,) = json.loads(result.output)["broken"]
    assert (failed["law"], failed["case"]) == ("reads a recorded file", "run.raw")
    assert "does not hold 19 channels" in failed["message"]


def test_a_recorded_file_is_for_log_readers(raw: Path) -> None:
    with pytest.raises(UsageError, match="read by log readers, not by a plug-in of kind plant"):
        check_plugin("matched", kind="plant", file=raw)


@pytest.mark.parametrize("place", range(3))
def test_a_list_in_place_of_an_array_is_named(place: int, tmp_path: Path) -> None:
    names = ("q", "v", "tau")
    arrays = {name: [0.0] if i == place else np.zeros(4) for i, name in enumerate(names)}
    with pytest.raises(UsageError, match=rf"{names[place]} is a list.*asarray"):
        table_of_arrays(tmp_path / "log.own", arrays)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("mark", [";", "\t"])
def test_texts_of_other_countries_are_read(tmp_path: Path, encoding: str, mark: str) -> None:
    x = np.random.default_rng(0).normal(size=(20, 3)).round(6)
    x[:3] = [[0, 0, 1], [1, 0, 1], [2, 0, 1]]  # a start at rest: "0;0;1" has no decimals
    for decimal in ".,":
        lines = [["t", "q", "tau"], *([f"{v:.9g}".replace(".", decimal) for v in row] for row in x)]
        text = "\n".join(map(mark.join, lines)) + "\n"
        start = "\ufeff" if encoding.startswith("utf-16-") else ""
        (tmp_path / "run.csv").write_text(start + text, encoding=encoding)
        table = read_table(tmp_path / "run.csv")
        np.testing.assert_array_equal(table.values, x)
        assert [name.lstrip("\ufeff") for name in table.names] == ["t", "q", "tau"]
