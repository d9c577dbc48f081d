"""A report is a function of the run folder: data, robot and plug-ins may be gone."""

import shutil
from pathlib import Path

import pytest

from sysid_bench.commands.report import report, table
from sysid_bench.errors import UsageError
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from tests.signals.logs import write_two

pytestmark = pytest.mark.long

ROBOT = """
name = "arm"
file = "example-robot-data:ur_description/urdf/ur5_robot.urdf"
tool = "tool0"
terms = ["viscous", "coulomb"]
"""
METHODS = '''
import dataclasses
from sysid_bench.identification.estimators.linear import OLS
from sysid_bench.types import Metric

class Mine(OLS):
    """Least squares under another name."""

def size(cell):
    return len(cell.estimate.beta)

Count = Metric("count_of_columns", "Columns", digits=0, compute=size)
'''
SUITE = """
schema = 1
name = "gone"
[[log]]
name = "plain"
robot = "arm/robot.toml"
train = ["run.toml"]
test = ["other.toml"]
filter = "none"
[[estimator]]
use = "file:mine.py:Mine"
[[metric]]
use = "file:mine.py:Count"
[[table]]
name = "glance"
rows = ["robot"]
columns = ["estimator"]
metrics = ["torque_error", "count_of_columns"]
[[paper]]
name = "base"
show = "base-parameters"
[[paper]]
name = "model"
show = "model"
select = "torque_error < 1"
[[paper]]
name = "torques"
show = "torques"
test = "other"
"""


def sources(folder: Path) -> list[Path]:
    return [*folder.glob("*.csv"), *folder.glob("*.toml"), folder / "mine.py", folder / "arm"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "robot.toml").write_text(ROBOT)
    (tmp_path / "mine.py").write_text(METHODS)
    (tmp_path / "gone.toml").write_text(SUITE)
    return write_two(tmp_path)


def written(run_folder: RunFolder) -> dict[str, bytes]:
    """Every file that a report writes."""
    files = [*run_folder.path.glob("tables/*"), *run_folder.path.glob("figures/*")]
    files.append(run_folder.path / "report.html")
    return {file.name: file.read_bytes() for file in files}


def test_reports_need_neither_data_nor_robot_nor_plugin(folder: Path) -> None:
    result = run(folder / "gone.toml", folder / "out", jobs=1)
    assert result.counts == {"ok": 1}
    report(result.folder.path)
    before = written(result.folder)
    assert {"base.md", "model.tex", "glance.csv", "torques.svg", "torques.pdf"} <= set(before)
    printed = [table(result.folder.path, name) for name in ("glance", "base", "model")]

    for source in sources(folder):
        shutil.rmtree(source) if source.is_dir() else source.unlink()
    for name in ("tables", "figures"):
        shutil.rmtree(result.folder.path / name)
    report(result.folder.path)
    assert written(result.folder) == before
    assert [table(result.folder.path, name) for name in ("glance", "base", "model")] == printed


def test_what_was_not_stored_is_named_with_a_command(folder: Path) -> None:
    result = run(folder / "gone.toml", folder / "out", jobs=1)
    shutil.rmtree(result.folder.path / "artifacts")
    with pytest.raises(UsageError, match="--rerun all"):
        report(result.folder.path)


def test_the_reason_is_kept_where_an_entry_cannot_be_shown(folder: Path) -> None:
    text = SUITE.replace('test = "other"\n', 'test = "nowhere"\n')
    (folder / "gone.toml").write_text(text)
    result = run(folder / "gone.toml", folder / "out", jobs=1)
    assert result.counts == {"ok": 1}
    with pytest.raises(UsageError, match=r"torques.*nowhere"):
        report(result.folder.path)
