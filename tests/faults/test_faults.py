"""Laws of isolation: whatever one estimator does, the rows of all others are those of a run without
it, bit for bit; nothing stays behind; and the exit code says what happened."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.harness.run import RunResult, run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.words import MACHINE_FIELDS
from tests.faults.runners import left_behind

FAULTY = Path(__file__).parent / "faulty.py"
SOUND = ("ols", "wls", "ridge")
STATUS: Mapping[str, str] = {
    **dict.fromkeys(
        ("Raises", "Exits", "Interrupts", "EndsGenerator", "Recurses", "UnreadableError"), "failed"
    ),
    **dict.fromkeys(("AnswersNan", "AnswersInf", "AnswersHuge", "AnswersTooMany"), "failed"),
    **dict.fromkeys(("AnswersMatrix", "AnswersComplex", "AnswersText"), "failed"),
    **dict.fromkeys(("AnswersNone", "AnswersObject"), "failed"),
    **dict.fromkeys(("Segfaults", "Aborts", "Leaves", "ClosesDescriptors"), "crash"),
    **dict.fromkeys(("KillsItself", "KillsGroup"), "lost"),
    "Hangs": "timeout",
    **dict.fromkeys(("Allocates", "RaisesLimit"), "memory"),
    "AllocatesQuietly": "failed",
    "Prints": "ok",
    **dict.fromkeys(("ChangesFolder", "ChangesDefaults"), "ok"),
    **dict.fromkeys(("WritesData", "PatchesNumpy"), "failed"),
    **dict.fromkeys(("StartsThread", "LeavesFiles", "Forks", "ForksSession"), "ok"),
    **dict.fromkeys(("ForksAndReturns", "StartsProgram", "DaemonizesTwice"), "ok"),
    # It patches its own process, kills one that it does not see, and writes what nobody reads.
    **dict.fromkeys(
        ("PatchesScores", "KillsParent", "ForgesMessages", "WritesToDescriptors"), "ok"
    ),
}
"""The status of each fault; `ok` where the method answers rightly and misbehaves besides."""

DEAD = ("crash", "lost", "timeout")
"""Statuses of cells whose process did not write their row; one of `memory` may have done so."""

PLACES = (0, 2, 5)
"""First, middle and last of an experiment with the sound methods."""


def suite(*estimators: str, metric: str = "") -> Any:
    # A hang has to be waited for. Sound cells take .02 s and their preparation .1 s, the start of
    # workers apart, so that they are in time on a loaded machine, too.
    timeout = "12 s" if fault("Hangs") in estimators else "60 s"
    text = f"""
        schema = 1
        name = "faults"
        [run]
        timeout = "{timeout}"
        memory = "0.8 GB"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        noise = {{ tau = "1 %" }}
        [[robot]]
        use = "scara"
        """
    for place, use in enumerate(estimators):
        text += f'\n[[estimator]]\nuse = "{use}"\n'
        if use not in SOUND:
            text += f'label = "{use.rpartition(":")[2]} at {place}"\nplace = {place}\n'
    text += f'\n[[metric]]\nuse = "{metric}"\n' if metric else ""
    return parse_suite(text, folder=Path(__file__).parent)


def fault(name: str) -> str:
    return f"file:{FAULTY}:{name}"


def rows(result: RunResult) -> dict[str, dict[str, Any]]:
    """Rows by estimator, without the fields of the machine, which are plausible."""
    stored = result.folder.rows()
    assert (stored.torn, stored.garbled) == (0, ())
    for row in stored.rows.values():
        assert 0.0 <= row["load"] < 1e4
        peak = row["peak_memory"]  # MB; of a process that is gone it is not known
        if row["status"] != "memory" and sys.platform == "linux":
            assert (peak is None) == (row["status"] in DEAD)
        assert peak is None or 20.0 < peak < 800.0
    return {
        row["estimator"]: {k: v for k, v in row.items() if k not in MACHINE_FIELDS}
        for row in stored.rows.values()
    }


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    found = rows(run(suite(*SOUND), tmp_path_factory.mktemp("undisturbed") / "run", jobs=1))
    assert {row["status"] for row in found.values()} == {"ok"}
    return found


@pytest.fixture
def scratch(tmp_path: Path, token: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files, whose name is in the environment of methods as well."""
    folder = tmp_path / token
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    return folder


def at_places(name: str) -> list[Any]:
    """Sound estimators with a fault as first, middle and last one."""
    order = list(SOUND)
    for place in PLACES:
        order.insert(place, fault(name))
    return order


@pytest.mark.parametrize("name", STATUS)
def test_a_fault_is_one_row(
    tmp_path: Path, token: str, scratch: Path, undisturbed: dict[str, Any], name: str
) -> None:
    """The fault is the first, a middle and the last cell of one experiment."""
    result = run(suite(*at_places(name)), tmp_path / "run", jobs=1)
    found = rows(result)
    at_fault = [found.pop(f"{name} at {place}") for place in PLACES]
    assert [row["status"] for row in at_fault] == [STATUS[name]] * 3
    assert found == undisturbed
    assert result.exit_code == (0 if STATUS[name] == "ok" else 3)
    assert left_behind(token) == []
    assert list(scratch.iterdir()) == []
    logs = sum(file.stat().st_size for file in (tmp_path / "run" / "logs").iterdir())
    assert logs < 4e6


def test_a_forged_row_is_of_its_own_cell(tmp_path: Path) -> None:
    """A metric, which has the truth, writes its scores; what the plan determines stays."""
    result = run(suite(*SOUND, metric=fault("forges")), tmp_path / "run", jobs=1)
    stored, planned = result.folder.rows().rows, result.folder.planned_fields
    assert {planned[cell]["estimator"] for cell in stored} == set(SOUND)
    for cell, row in stored.items():
        assert row | planned[cell] == row
        assert row["nv"] == 4
    assert len({row["fingerprint"] for row in stored.values()}) == 1


@pytest.mark.parametrize("name", ["PatchesScores", "Aborts", "ClosesDescriptors"])
def test_a_fault_where_python_cannot_fork(
    tmp_path: Path, undisturbed: dict[str, Any], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The process of a fault ends with its cell; a fresh one takes the cells that are left."""
    (tmp_path / "sitecustomize.py").write_text("import select\n\ndel select.poll\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    result = run(suite(*at_places(name)), tmp_path / "run", jobs=2)
    found = rows(result)
    at_fault = [found.pop(f"{name} at {place}") for place in PLACES]
    assert [row["status"] for row in at_fault] == [STATUS[name]] * 3
    assert found == undisturbed


def test_all_faults_in_one_suite(
    tmp_path: Path, token: str, scratch: Path, undisturbed: dict[str, Any]
) -> None:
    order = [fault(name) for name in STATUS]
    for place, name in zip((0, len(order) // 2, len(order) + 2), SOUND, strict=True):
        order.insert(place, name)
    result = run(suite(*order), tmp_path / "run", jobs=2)
    found = rows(result)
    statuses = {name.partition(" at ")[0]: row["status"] for name, row in found.items()}
    assert statuses == {**STATUS, **dict.fromkeys(SOUND, "ok")}
    assert {name: found[name] for name in SOUND} == undisturbed
    assert left_behind(token) == []
    assert list(scratch.iterdir()) == []
