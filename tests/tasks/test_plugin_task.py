"""A task in a file of its own runs in a suite, on the command line and through the check."""

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from sysid_bench.commands.basis import basis
from sysid_bench.commands.identify import identify
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.harness.fingerprint import cell_fingerprint
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.signals.log_data import log_of

WRIST = Path(__file__).with_name("wrist.py")
SUITE = """
schema = 1
name   = "wrist"

[defaults]
task       = ["link", "file:wrist.py:Wrist"]
terms      = []
excitation = { use = "fourier", period = "2 s", cycles = 1 }
held_out   = ["ptp"]
rate       = "50 Hz"

[[robot]]
use = "ur5"

[[estimator]]
use = "ols"
"""


@pytest.fixture
def suite_file(tmp_path: Path) -> Path:
    shutil.copy(WRIST, tmp_path / "wrist.py")
    file = tmp_path / "suite.toml"
    file.write_text(SUITE)
    return file


def test_a_task_in_a_file_beside_the_suite_runs_from_end_to_end(suite_file: Path) -> None:
    result = run(suite_file, suite_file.parent / "out", jobs=1)
    rows = list(result.folder.rows().rows.values())
    assert {row["task"]: row["status"] for row in rows} == {"link": "ok", "Wrist": "ok"}
    wrist = next(row for row in rows if row["task"] == "Wrist")
    assert wrist["parameters"] == 20
    assert wrist["torque_error"] < 1e-9


def test_its_cells_are_selected_by_label_and_by_name(suite_file: Path) -> None:
    plan = cells_of_suite(load_suite(suite_file))
    for name in ("Wrist", "file:wrist.py:Wrist"):
        assert len(plan.select(f"task == '{name}'")) == 1
    assert [cell.spec.task for cell in plan.cells] == ["link", "file:wrist.py:Wrist"]


def test_a_changed_file_makes_its_rows_stale_and_no_others(suite_file: Path) -> None:
    from sysid_bench.harness import fingerprint

    cells, folder = cells_of_suite(load_suite(suite_file)).cells, suite_file.parent
    before = [cell_fingerprint(cell, None, folder) for cell in cells]
    (folder / "wrist.py").write_text(WRIST.read_text() + "\n# another version\n")
    for cached in (fingerprint._file, fingerprint._plugin, fingerprint._fingerprint):
        cached.cache_clear()
    after = [cell_fingerprint(cell, None, folder) for cell in cells]
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False]


def test_an_unknown_task_of_a_suite_is_named_with_its_line_and_all_tasks(suite_file: Path) -> None:
    suite_file.write_text(SUITE.replace("file:wrist.py:Wrist", "wrenhc"))
    with pytest.raises(UsageError, match=r"suite.toml:6: .*'wrench'.*terminal.*wrench-payload"):
        load_suite(suite_file)
    suite_file.write_text(SUITE.replace("file:wrist.py:Wrist", "file:wrong.py:Wrist"))
    with pytest.raises(UsageError, match=r"wrong.py"):
        load_suite(suite_file)


def test_the_commands_take_it_by_its_file() -> None:
    answer = basis("ur5", f"file:{WRIST}:Wrist", ("viscous",))
    assert (answer["parameters"], answer["terms"]) == (20 + 6, ["viscous"])


OWN_VERB = """
class Mine(Wrist):
    commands = {"identify": "file:wrist.py:answer"}


def answer(request):
    return IdentifyResult(
        model=request.model, file="", task=request.task, terms=[], rows=[], estimator="mine",
        scores={"rank": 7}, std_from=None, std_limit=None, joints={}, warnings=[],
    )
"""


def test_a_task_has_a_verb_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head = "from sysid_bench.commands.identify_result import IdentifyResult\n"
    (tmp_path / "wrist.py").write_text(head + WRIST.read_text() + OWN_VERB)
    monkeypatch.chdir(tmp_path)
    log = log_of({"q_a": [0.0, 1.0], "tau_a": [0.0, 1.0]}, {"rate": "1 Hz"})
    result = identify("ur5", "file:wrist.py:Mine", log=log)
    assert (result.estimator, result.rank, result["rank"]) == ("mine", 7, 7)
    with pytest.raises(AttributeError, match="rnak"):
        result.rnak  # noqa: B018
    with pytest.raises(UsageError, match="--share"):
        identify("ur5", f"file:{WRIST}:Wrist", log=log, share=["a"])


def test_an_object_that_is_not_a_task_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'math:inf' is not a task: .*TaskDefinition"):
        find_task("math:inf")


def test_it_passes_the_check() -> None:
    result = CliRunner().invoke(main, ["check-plugin", "--kind", "task", f"file:{WRIST}:Wrist"])
    assert result.exit_code == 0, result.output
    assert "keeps its laws" in result.output
