"""`figure` and `[[macro]]`: files for a paper from stored rows, exit codes, mistakes."""

import json
import re
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.harness.suite.load_suite import parse_suite

from .conftest import OUTPUTS, SUITE, Run


@pytest.fixture
def run(copied: Path) -> Path:
    return copied / "run"


def test_a_figure_alone_lists_names(run: Path, cli: Run) -> None:
    before = sorted(run.rglob("*"))
    done = cli("figure", str(run))
    assert (done.returncode, done.stdout) == (0, "errors\n")
    assert sorted(run.rglob("*")) == before


@pytest.mark.parametrize(("size", "suffix"), [("single", ""), ("double", "-double")])
def test_a_figure_is_a_pdf_and_a_png(
    run: Path, cli: Run, tmp_path: Path, size: str, suffix: str
) -> None:
    out = tmp_path / "made"
    done = cli("figure", str(run), "errors", "--size", size, "-o", str(out), "--json")
    assert done.returncode == 0, done.stderr
    files = [out / f"errors{suffix}.{kind}" for kind in ("pdf", "png")]
    assert json.loads(done.stdout)["files"] == list(map(str, files))
    assert sorted(out.iterdir()) == files
    assert files[0].read_bytes().startswith(b"%PDF")
    assert files[1].read_bytes().startswith(b"\x89PNG")


def test_all_figures_are_written_beside_those_of_the_report(run: Path) -> None:
    made = sysid_bench.figure(run, "all")
    assert made.files == [str(run / "figures" / f"errors.{kind}") for kind in ("pdf", "png")]


def test_mistakes_name_what_there_is(run: Path) -> None:
    with pytest.raises(UsageError, match="errors"):
        sysid_bench.figure(run, "error")
    with pytest.raises(UsageError, match="double"):
        sysid_bench.figure(run, "errors", size="wide")


def test_macros_of_a_suite_stand_beside_the_tables(run: Path) -> None:
    text = (run / "tables" / "macros.tex").read_text()
    found = dict(re.findall(r"\\newcommand\{\\(\w+)\}\{\\num\{(.+)\}\}", text))
    cells = sysid_bench.open_run(run).cells
    error = cells["torque_error"][cells["estimator"] == "wls"].median()
    assert float(found["WlsError"]) == pytest.approx(error, rel=6e-3)
    assert found["Cells"] == "12"


@pytest.mark.parametrize("name", ["Error1", "E", "my error", "\\\\Error"])
def test_a_macro_has_letters_alone(name: str) -> None:
    with pytest.raises(UsageError, match="macro"):
        parse_suite(SUITE + OUTPUTS.replace("WlsError", name), "paper.toml")
