"""Laws of supervision outside of cells: plug-ins that are made for a plan, executed again for a
recording, or used by one command cost what they spoil, and nothing else."""

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import sysid_bench
from sysid_bench.commands import worker_execute as supervise
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.harness.work.row_files import with_hash
from tests.robots import named_robot
from tests.signals.logs import recorded, write

UNRULY = Path(__file__).parent / "unruly.py"


@pytest.fixture(autouse=True)
def undisturbed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Whatever happens in a test, this process stays as it was."""
    monkeypatch.chdir(tmp_path)
    before = (os.getcwd(), np.geterr(), threading.active_count())
    yield
    assert (os.getcwd(), np.geterr(), threading.active_count()) == before
    loaded = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    assert str(UNRULY) not in loaded


def suite(folder: Path, *estimators: str, more: str = "", timeout: str = "60 s") -> str:
    text = f"""
        schema = 1
        name = "unruly"
        [run]
        timeout = "{timeout}"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        noise = {{ tau = "1 %" }}
        [[robot]]
        use = "scara"
        {more}
        """
    for name in estimators:
        text += f'\n[[estimator]]\nuse = "file:{UNRULY}:{name}"\n'
    (folder / "suite.toml").write_text(text)
    return str(folder / "suite.toml")


ENDS = {
    "MakeHangs": "longer than the limit of 15 s",
    "MakeAborts": "SIGABRT",
    "MakeExits": "SystemExit",
    "Absent": "has no 'Absent'",
}


@pytest.mark.parametrize(
    ("fault", "place"),
    [(fault, 1) for fault in ENDS] + [("MakeAborts", 0), ("MakeAborts", 2)],
)
def test_a_plan_names_the_plugin_that_cannot_be_made(
    fault: str, place: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault == "MakeHangs":
        monkeypatch.setattr("sysid_bench.harness.worker_names.SECONDS", 15.0)
    names = ["Sound", "Sound"]
    names.insert(place, fault)
    with pytest.raises(UsageError) as caught:
        sysid_bench.plan(suite(tmp_path, *names))
    (line,) = str(caught.value).splitlines()
    assert f"estimator[{place}]" in line
    assert ENDS[fault] in line


def test_a_plan_collects_all_plugins_that_cannot_be_made(tmp_path: Path) -> None:
    more = f"""
        [[metric]]
        use = "file:{UNRULY}:aborting_metric"
        """
    path = suite(tmp_path, "MakeExits", "Sound", "MakeAborts", more=more)
    task = {"defaults.task": f"file:{UNRULY}:AbortingTask"}
    with pytest.raises(UsageError) as caught:
        sysid_bench.plan(path, overrides=task)
    lines = str(caught.value).splitlines()
    places = ("defaults.task", "metric[0]", "estimator[0]", "estimator[2]")
    assert len(lines) == len(places)
    assert all(any(place in line for line in lines) for place in places)


def test_a_plan_with_plugins_that_change_their_process(tmp_path: Path) -> None:
    more = f"""
        [[metric]]
        use = "file:{UNRULY}:own_metric"
        [[table]]
        name = "own"
        cells = {{ metric = "own" }}
        """
    path = suite(tmp_path, "MakeForks", "MakeChanges", "Sound", more=more)
    result = sysid_bench.plan(path)
    assert len(result.cells) == 3
    assert result.code == f"runs code: file:{UNRULY}"
    assert "code" not in result.to_dict()


def _run(path: str, out: Path) -> Any:
    return sysid_bench.run(path, out, jobs=1, record='status == "ok"')


@pytest.mark.parametrize("first", [0, 1, 2])
def test_a_recording_costs_itself_alone(
    first: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hang, crash and change of the process, each in the first, middle and last place."""
    monkeypatch.setenv("SYSID_TEST_SEEN", "yes")
    names = ["AgainHangs", "AgainAborts", "AgainChanges"]
    path = suite(tmp_path, *names[first:], *names[:first], timeout="15 s")
    result = _run(path, tmp_path / "run")
    assert (result.exit_code, result.counts) == (0, {"ok": 3})
    rows = result.folder.rows().rows
    recorded = {rows[file.parent.name]["estimator"] for file in _recordings(tmp_path / "run")}
    assert recorded == {"AgainChanges"}, result.notes
    page = (tmp_path / "run" / "report.html").read_text()
    for name, reason in (("AgainHangs", "limit of 15 s"), ("AgainAborts", "SIGABRT")):
        (note,) = [note for note in result.notes if name in note]
        assert reason in note
        assert name in page
        assert reason in page
    assert (tmp_path / "run" / "tables" / "main.tex").is_file()
    # Resumed, nothing is left to do: a recording that failed is not tried again and again.
    assert _run(path, tmp_path / "run").notes == result.notes


def test_record_reports_what_it_could_not_write_after_all_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SYSID_TEST_SEEN", "yes")
    path = suite(tmp_path, "AgainAborts", "Sound")
    sysid_bench.run(path, tmp_path / "run", jobs=1)
    with pytest.raises(UsageError, match=r"AgainAborts[\s\S]*SIGABRT[\s\S]*1 written"):
        sysid_bench.record(tmp_path / "run", 'status == "ok"')
    assert len(_recordings(tmp_path / "run")) == 1


def _recordings(run: Path) -> list[Path]:
    return list(run.glob("artifacts/*/*.rrd*"))


def _command(*words: str) -> Result:
    return CliRunner().invoke(main, words)


def _identify(name: str, *more: str) -> Result:
    estimator = f"file:{UNRULY}:{name}"
    return _command("identify", "scara", "--simulate", "--estimator", estimator, *more)


def test_a_command_with_a_sound_plugin() -> None:
    """It prints what the command in this process prints for the same method."""
    result, same = (
        _identify("Sound", "--json"),
        _command("identify", "scara", "--simulate", "--json"),
    )
    assert (result.exit_code, same.exit_code) == (0, 0), result.output
    mine, own = json.loads(result.stdout), json.loads(same.stdout)
    assert mine.keys() == own.keys()
    assert mine["torque_error"] == pytest.approx(own["torque_error"], abs=1e-9)


def test_commands_with_plugins_that_end_badly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write(tmp_path, recorded(named_robot("scara"), 0), reader=f"file:{UNRULY}:Reader")
    ends = [
        (_identify("Raises"), "boom"),
        (_command("check-plugin", f"file:{UNRULY}:MakeAborts"), "SIGABRT"),
        (_command("basis", "scara", "--task", f"file:{UNRULY}:AbortingTask"), "SIGABRT"),
        (_command("excite", "scara", "--task", f"file:{UNRULY}:AbortingTask"), "SIGABRT"),
        (_command("identify", "scara", "--log", str(log), "--test", str(log)), "SIGABRT"),
    ]
    monkeypatch.setattr(supervise, "SECONDS", 20.0)
    ends.append((_identify("Hangs"), "limit of 20 s. "))
    for result, text in ends:
        assert result.exit_code == 2, result.output
        assert text in result.stderr
        assert result.stdout == ""
        assert result.stderr.startswith("sysid-bench: ")
        assert len(result.stderr) < 1000


def test_commands_with_terms_that_end_badly(tmp_path: Path) -> None:
    """Columns of a plug-in, named on the command line or by the manifest of the robot."""
    scara = named_robot("scara")
    log, own = write(tmp_path, recorded(scara, 0)), tmp_path / "robot.toml"
    feature = f"{scara.rows[1]}.file:{UNRULY}:MakeAborts"
    own.write_text(
        f'name = "own"\nfile = "{scara.manifest.path.resolve()}"\n'
        f'terms = ["viscous", "{feature}"]\n'
    )
    data = ("--log", str(log), "--test", str(log))
    for words in (
        ("identify", "scara", *data, "--terms", f"viscous,{feature}"),
        ("identify", str(own), *data),
    ):
        result = _command(*words)
        assert result.exit_code == 2, result.output
        assert "SIGABRT" in result.stderr
        assert result.stdout == ""


def test_shards_merge_into_the_run(tmp_path: Path) -> None:
    path = suite(tmp_path, "Sound")
    sweep = ("--set", 'defaults.rate=["100 Hz","150 Hz","200 Hz","250 Hz"]')
    for part in ("1/2", "2/2"):
        done = _command("run", path, "-o", f"part{part[0]}", "-j", "1", "--shard", part, *sweep)
        assert done.exit_code == 0, done.output
        assert done.stderr.count("runs code") == 1
        assert "runs code" not in done.stdout
    merged = _command("merge", "part1", "part2", "-o", "whole")
    assert merged.exit_code == 0
    assert "4 rows, 0 open" in merged.output
    assert Path("whole/report.html").is_file()
    row = sysid_bench.open_run("part1").rows().rows.popitem()[1]
    forged = {**row, "beta_error": 1.0}
    Path("part2/cells/999999-other.jsonl").write_bytes(with_hash(json.dumps(forged).encode()))
    merged = _command("merge", "part1", "part2", "-o", "again")
    assert merged.exit_code == 1
    assert row["id"] in merged.output
    assert not Path("again").exists()
    _check_other_code(0)
    old = with_hash(json.dumps({**row, "fingerprint": "0" * 16}).encode())
    Path("whole/cells/999999-other.jsonl").write_bytes(old)
    _check_other_code(1)


def _check_other_code(count: int) -> None:
    """The run `whole` reports so many rows of other code, wherever a reader may look."""
    note = "1 row is from other code, models or libraries than now"
    assert json.loads(_command("status", "whole", "--json").stdout)["other_code"] == count
    texts = [_command("status", "whole").stdout]
    assert _command("report", "whole").exit_code == 0
    texts += [Path("whole", name).read_text() for name in ("report.html", "tables/main.tex")]
    texts += [Path("whole/tables/numbers.tex").read_text()]
    texts += [_command("table", "whole", "main", "--format", "latex").stdout]
    assert [note in text for text in texts] == [count > 0] * 5
    assert note not in Path("whole/tables/main.md").read_text()
