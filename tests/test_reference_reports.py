"""Reports of reports/reference: rows kept beside them come out again, and what is older than the
code is named."""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from reports.make.kept_rows import designs, differing, spread_of
from reports.make.page_numbers import PART
from reports.make.reference_check import NOT_AGAIN, TYPED
from reports.make.reference_reports import (
    PAGES,
    ROWS,
    RunCommand,
    id_hash,
    job_of_witness,
    rows_hash,
    scores,
)
from sysid_bench.excitation.optimised import Optimised
from sysid_bench.experiments.simulated import noise_free
from tests.experiments.experiment_world import argument, ready, rows_of, spec
from tests.experiments.plugins import Halving

NOT_MADE_AGAIN: dict[str, str] = {
    "actuators": "recorded robots; minutes",
    "birdy-rv2sq": "hours of one core",
    "birdy-tx40": "2.4 hours of one core",
    "claims": "an hour of two cores",
    "coverage-closed-loop": "hours of two cores",
    "excitations": "hours of one core",
    "methods": "hours of two cores",
    "peers": "half an hour of two cores",
    "pipelines": "the part of sub-steps: hours",
    "real": "ten minutes of two cores; recorded robots",
}
"""Pages with a part older than its suite, or of a checkout with changes, as the page states."""
HALVING = "tests.experiments.plugins:Halving"
FILES = sorted(ROWS.glob("*.json"))


def kept(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    if "SYSID_BENCH_DATA" not in os.environ and found["job"]["experiment"].get("log"):
        pytest.skip("SYSID_BENCH_DATA is unset")
    return found


@pytest.mark.long
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_row_of_each_report_comes_out_again(file: Path) -> None:
    row = kept(file)
    with designs(row["designs"]):
        (again,) = rows_of(job_of_witness(row))
    assert not differing(row["row"], scores(again), row["spread"]), "make the report again"
    if row["printed"]:
        assert is_printed(row, again[row["printed"]["metric"]])


def is_printed(row: Mapping[str, Any], value: float) -> bool:
    """True where the table of the page has the value, in the digits of a number of it."""
    page = (PAGES / row["page"]).read_text(encoding="utf-8")
    tables = [part[2] for part in PART.finditer(page) if row["printed"]["table"] in part[1].split()]
    numbers = re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", "".join(tables))
    return not tables or any(text in numbers for text in digits(value))


def digits(value: float) -> set[str]:
    """Texts of a number with two to four digits, as tables print it."""
    found = set()
    for places in range(1, 4):
        mantissa, exponent = f"{value:.{places}e}".split("e")
        found.add(f"{mantissa}e{int(exponent)}")
        found.add(f"{float(f'{value:.{places}e}'):.{max(0, places - int(exponent))}f}")
    return found


@pytest.mark.long
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_suite_of_a_report_still_plans_its_cells(file: Path) -> None:
    row = kept(file)
    page = (PAGES / row["page"]).read_text(encoding="utf-8")
    (part,) = (text for command, text in PART.findall(page) if command == row["command"])
    if NOT_AGAIN not in part:
        assert RunCommand.parse(row["command"]).planned() == row["planned"], "make the report again"


def runs_of(page: Path) -> list[RunCommand]:
    """The runs that a page is made of."""
    parts = PART.finditer(page.read_text(encoding="utf-8"))
    return [RunCommand.parse(part[1]) for part in parts if part[1].startswith("sysid-bench run ")]


def is_copied(page: Path) -> bool:
    """True for a page without runs that says that its figures are copied."""
    return not runs_of(page) and bool(TYPED.search(page.read_text(encoding="utf-8")))


def test_every_run_of_a_page_has_a_kept_row_or_its_page_says_why_not() -> None:
    runs = {page.stem: runs_of(page) for page in PAGES.glob("*.md")}
    bare = {name for name, found in runs.items() if not found}
    assert bare == {page.stem for page in PAGES.glob("*.md") if is_copied(page)}
    old = {name for name, found in runs.items() if any(not r.witness.is_file() for r in found)}
    assert old <= NOT_MADE_AGAIN.keys()


def test_pages_name_what_is_older_than_the_code() -> None:
    said = {
        page.stem
        for page in PAGES.glob("*.md")
        if "Not made again since commit" in page.read_text(encoding="utf-8")
    }
    assert said == NOT_MADE_AGAIN.keys()


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_kept_row_is_that_of_a_command_of_its_page(file: Path) -> None:
    row = json.loads(file.read_text(encoding="utf-8"))
    parts = {p[1]: p[2] for p in PART.finditer((PAGES / row["page"]).read_text(encoding="utf-8"))}
    assert row["rows_hash"] in parts[row["command"]]
    assert RunCommand.parse(row["command"]).witness == file
    assert row["row"]["id"] == row["job"]["estimators"][0]["cell"]


def test_hashes_depend_on_scores_alone_and_not_on_the_order() -> None:
    rows = [{"id": "a", "torque_error": 0.1, "seconds": 1.0}, {"id": "b", "torque_error": 0.2}]
    assert (
        rows_hash(rows) == rows_hash(rows[::-1]) == rows_hash([{**rows[0], "seconds": 2}, rows[1]])
    )
    assert rows_hash(rows) != rows_hash([{**rows[0], "torque_error": 0.1 + 1e-15}, rows[1]])
    assert id_hash("ab") == id_hash("ba") != id_hash("a")


def test_a_number_may_differ_by_its_spread_and_by_no_more() -> None:
    before = {"a": 1.0, "of": {"b": 2.0}, "stop": "converged"}
    assert not differing(before, {"a": 1.0 + 1e-7, "of": {"b": 2.0}, "stop": "converged"})
    after = {"a": 1.0, "of": {"b": 2.1}, "stop": "converged"}
    assert len(differing(before, after)) == 1
    assert not differing(before, after, {"of.b": 0.11})
    assert len(differing(before, after, {"of.b": 0.09, "b": 1.0})) == 1
    assert len(differing(before, {"a": 1.0, "of": {}, "stop": "limit"})) == 2


def test_the_spread_is_that_of_methods_that_depend_on_last_bits() -> None:
    made = spec(robot="scara", noise={"q": 1e-5, "tau_relative": 0.01})
    limit = Halving().residual(ready(robot="scara", noise=made.noise).problem, steps=3)
    for entry, depends in (("ols", False), ({"use": HALVING, "limit": limit}, True)):
        job = argument(made, entry)
        (row,) = rows_of(job)
        assert ("torque_error" in spread_of(scores(row), job)) == depends


def test_a_kept_motion_is_not_searched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    design = {"use": "optimised", "harmonics": 1, "iterations": 2, "starts": 1, "period": "5 s"}
    job = argument(spec(robot="scara", excitation=design), "ols")
    noise_free._shared_part.cache_clear()
    with designs() as found:
        (row,) = rows_of(job)
    (C,) = found.values()
    noise_free._shared_part.cache_clear()
    monkeypatch.setattr(Optimised, "solve", None)
    with designs([C.tolist()]):
        (again,) = rows_of(job)
    assert not differing(scores(row), scores(again))
    noise_free._shared_part.cache_clear()
    with designs([(0.9 * C).tolist()]):
        (other,) = rows_of(job)
    assert differing(scores(row), scores(other))
