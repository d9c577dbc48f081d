"""Metrics: one record each, and a user's own from a file to the report."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.apps.conformance.metric import check_metric, metric_cells
from sysid_bench.commands.check_plugin import check_plugin
from sysid_bench.commands.list import list_, show
from sysid_bench.commands.record import matching_cells
from sysid_bench.commands.report import report, table
from sysid_bench.errors import UsageError
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.fingerprint import cell_fingerprint
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite, parse_stored, suite_text
from sysid_bench.identification.identify import identify
from sysid_bench.metrics import METRICS, REASONS, metric_fields, metric_of_plugin, names_of
from sysid_bench.plugin_names import build
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.latex import Origin, to_latex
from sysid_bench.reporting.writers import to_csv, to_markdown
from sysid_bench.types import Metric, MetricInput, Score
from sysid_bench.words import LEVEL_AXES

# A complete metric in ten lines.
OWN = '''
import numpy as np
from sysid_bench.types import Metric, MetricInput

def mean_error(cell: MetricInput) -> float:
    """Mean |b - Y beta| over mean |b|, all held-out motions and joints."""
    blocks = [pair for problem in cell.held_out.values() for pair in problem.blocks()]
    errors = [np.abs(b - Y @ cell.estimate.beta).sum() for Y, b in blocks]
    return sum(errors) / sum(np.abs(b).sum() for _, b in blocks)

Mean = Metric("mean_error", "Relative mean torque error", better="lower", ranked=True,
              needs=("held-out",), compute=mean_error)
'''
BROKEN = (
    OWN
    + '''
def fails(cell):
    raise ZeroDivisionError("no torque")

Fails = Metric("fails", "Always fails", "N m", compute=fails)

def Share(above: float = 0.5) -> Metric:
    """A metric with a setting."""
    return Metric("share", "Share", digits=2, compute=lambda cell: above)
'''
)
SUITE = """
schema = 1
name = "own"
[defaults]
rate = "50 Hz"
excitation = { use = "fourier", period = "3 s", cycles = 1 }
noise = { tau = "1 %" }
[[robot]]
use = ["random:7", "random:8"]
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
[[metric]]
use = "file:mine.py:Mean"
[[metric]]
use = "file:mine.py:Fails"
[[metric]]
use = "file:mine.py:Share"
above = 0.25
[[table]]
name = "glance"
columns = ["estimator"]
metrics = ["torque_error", "mean_error", "fails", "share", "rank"]
best = "bold"
select = "mean_error > 0"
[[ranking]]
name = "order"
metric = "mean_error"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(BROKEN)
    (folder / "own.toml").write_text(SUITE)
    return folder


@pytest.fixture(scope="module")
def ran(folder: Path) -> RunFolder:
    result = run(folder / "own.toml", folder / "out", jobs=1)
    assert result.exit_code == 0, result.counts
    return result.folder


# --- Records --------------------------------------------------------------------------------------


def test_every_number_of_a_score_has_a_record() -> None:
    numbers = {field.name for field in dataclasses.fields(Score)}
    numbers -= {"joints", "torque_error_by_motion"}
    assert numbers <= set(METRICS)


def test_records_are_consistent() -> None:
    for metric in METRICS.values():
        assert metric.better in ("lower", "higher", None)
        assert not metric.ranked or (metric.better == "lower" and metric.level == "cell")
        assert metric.level in (*LEVEL_AXES, "cell", "repeats")
    assert {metric.name for metric in METRICS.values() if metric.ranked} < set(names_of("cell"))


def test_the_catalogue_lists_and_shows_metrics() -> None:
    names = [entry["name"] for entry in list_("metrics")]
    assert names[: len(METRICS)] == list(METRICS)
    assert show("rmse_test")["unit"] == "N m|N"
    assert "(N·m, N)" in show("rmse_test")["title"]


# --- A metric of the user's own -------------------------------------------------------------------


def test_its_value_is_a_field_of_every_row(ran: RunFolder) -> None:
    rows = ran.rows().rows
    assert len(rows) == len(ran.plan.cells) == 4
    for cell in ran.plan.cells:
        row = rows[cell.id]
        assert row["status"] == "ok"
        assert row["mean_error"] == pytest.approx(mean_error_of(cell), rel=1e-9)
        assert row["share"] == 0.25


def mean_error_of(cell: Cell) -> float:
    """Mean |b - W beta| over mean |b| on the held-out motions, from the stacked rows."""
    spec = cell.spec
    prepared = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, None, None))
    method = build("estimator", cell.estimator)
    beta = identify(method, prepared.problem, prepared.experiment).beta
    tests = prepared.held_out.values()
    b = np.concatenate([problem.b for problem in tests])
    W = np.vstack([problem.W for problem in tests])
    return float(np.abs(b - W @ beta).sum() / np.abs(b).sum())


def test_an_exception_empties_its_field_and_nothing_else(ran: RunFolder) -> None:
    assert ran.rows().rows
    for row in ran.rows().rows.values():
        assert row["fails"] is None
        assert row[REASONS] == {"fails": "ZeroDivisionError: no torque"}
        assert row["reason"] == ""


def test_tables_rankings_reports_and_selections_know_it(ran: RunFolder) -> None:
    page = report(ran.path).read_text()
    text = table(ran.path, "glance")
    assert "ols / Relative mean torque error ↓" in text
    assert "ols / Always fails (N·m) |" in text
    assert "Always fails: 4 cells without a value: ZeroDivisionError: no torque." in text
    assert "Relative mean torque error" in page
    assert "| wls | 1 | 1.00 | 1.00 | 0 | 2 |" in table(ran.path, "order")
    assert len(matching_cells(ran, "mean_error > 0")) == 4


def test_a_frozen_suite_keeps_the_record_without_the_file(folder: Path) -> None:
    suite = load_suite(folder / "own.toml")
    frozen = parse_stored(suite_text(suite), "run.toml")
    assert frozen == suite
    assert frozen.metrics["mean_error"] == dataclasses.replace(
        metric_of_plugin(suite_metric(folder)), compute=None
    )


def suite_metric(folder: Path) -> Metric:
    from sysid_bench.plugin_names import build

    metric = build("metric", f"file:{folder / 'mine.py'}:Mean")
    assert isinstance(metric, Metric)
    return metric


def test_a_changed_metric_makes_cells_stale(ran: RunFolder, tmp_path: Path) -> None:
    cell = ran.plan.cells[0]
    prints: set[str] = set()
    folder = tmp_path / "copy"
    assert ran.suite.folder is not None
    shutil.copytree(ran.suite.folder, folder, ignore=shutil.ignore_patterns("run*"))
    for text in (OWN, OWN + "\n"):
        (folder / f"mine{len(prints)}.py").write_text(text)
        spec = {"use": f"file:mine{len(prints)}.py:Mean"}
        prints.add(cell_fingerprint(cell, None, folder, [spec]))
    prints.add(cell_fingerprint(cell, None, folder))
    assert len(prints) == 3
    assert "" not in prints


MISTAKES = {
    'file:mine.py:Mean"': ('file:mine.py:Meen"', "Meen"),
    "above = 0.25": ("abov = 0.25", "above"),
    'metrics = ["torque_error", "mean_error"': ('metrics = ["torque_error", "meen"', "mean_error"),
    'metric = "mean_error"': ('metric = "share"', "metric to rank by"),
    'select = "mean_error > 0"': ('select = "meen_error > 0"', "mean_error"),
    'best = "bold"': ('cells = { metric = "rank" }', "not both"),
    "[[ranking]]": ('[[metric]]\nuse = "file:mine.py:Mean"\n[[ranking]]', "used already"),
    '[[metric]]\nuse = "file:mine.py:Fails"': ('[[metric]]\nuse = "math:pi"', "types.Metric"),
}


@pytest.mark.parametrize("right", MISTAKES)
def test_mistakes_are_found_before_anything_runs(folder: Path, right: str) -> None:
    wrong, word = MISTAKES[right]
    assert right in SUITE
    (folder / "wrong.toml").write_text(SUITE.replace(right, wrong, 1))
    with pytest.raises(UsageError, match=word):
        load_suite(folder / "wrong.toml")


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "rank"},
        {"name": "Two words"},
        {"level": "joint"},
        {"compute": None},
        {"better": "higher", "ranked": True},
    ],
)
def test_a_record_that_makes_no_sense_is_refused(changes: dict[str, Any]) -> None:
    sound = Metric("own", "Own", compute=lambda cell: 1.0)
    assert metric_of_plugin(sound) is sound
    with pytest.raises(UsageError):
        metric_of_plugin(dataclasses.replace(sound, **changes))


@pytest.mark.parametrize("value", [np.nan, np.inf, "1", np.ones(2), np.ones(1), {}])
def test_only_finite_numbers_are_values(value: Any, cell: MetricInput) -> None:
    metric = Metric("own", "Own", compute=lambda cell: value)
    fields = metric_fields({"own": lambda: metric}, cell)
    assert fields["own"] is None
    assert fields[REASONS]["own"]


@pytest.mark.parametrize("value", [1, True, np.float64(1.0), np.int32(1), np.bool_(True)])
def test_scalars_are_values(value: Any, cell: MetricInput) -> None:
    metric = Metric("own", "Own", compute=lambda cell: value)
    assert metric_fields({"own": lambda: metric}, cell) == {"own": 1.0}


# --- The check kit --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cell() -> MetricInput:
    return metric_cells()[0]


def test_the_example_keeps_its_laws(folder: Path) -> None:
    assert check_plugin(f"file:{folder / 'mine.py'}:Mean", kind="metric")["ok"]


def memory(cell: MetricInput, seen: list[int] = []) -> float:  # noqa: B006
    seen.append(1)
    return float(len(seen))


def writing(cell: MetricInput) -> float:
    assert cell.estimate.beta is not None
    cell.estimate.beta[0] *= 1 + 1e-9
    return 1.0


def flattering(cell: MetricInput) -> float:
    assert cell.estimate.beta is not None
    return float(1 / np.linalg.norm(cell.estimate.beta))


@pytest.mark.parametrize(
    ("compute", "word"),
    [
        (memory, "two values"),
        (writing, "input has changed"),
        (flattering, "look better"),
        (lambda cell: -1.0, "not negative"),
        (lambda cell: None, "No cell has a value"),
        (lambda cell: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_broken_laws_are_found(
    compute: Callable[[MetricInput], float | None], word: str, cell: MetricInput
) -> None:
    metric = Metric("own", "Own", better="lower", ranked=True, compute=compute)
    assert any(word in finding for finding in check_metric(metric, [cell]))


# --- Tables with several metrics ------------------------------------------------------------------

GLANCE = {
    "name": "glance",
    "rows": ["robot", "payload"],
    "columns": ["estimator"],
    "metrics": ["rmse_test", "rank", "feasible", "torque_error"],
    "best": "bold",
    "select": {"noise": "q 1e-4 rad, tau 0.5 %"},
}


def test_each_metric_is_a_column_with_unit_and_direction(cells: pd.DataFrame) -> None:
    table = build_table(cells, GLANCE)
    head = to_markdown(table).splitlines()[4]
    assert head.startswith("| robot | payload | ols / Held-out RMSE (N·m, N) ↓ |")
    assert "ols / Base parameters |" in head
    assert "ols / Share of feasible estimates ↑" in head
    assert "↓ lower is better; ↑ higher is better" in table.description
    tex = to_latex(table, Origin("run", "hash", "made"))
    assert r"\shortstack{Held-out RMSE \\" in tex
    assert r"\ensuremath{\downarrow}" in tex
    lines = [line.split(",") for line in to_csv(table).splitlines()]
    assert lines[0].count("metric") == 1
    at = {name: i for i, name in enumerate(lines[0])}
    assert {line[at["metric"]] for line in lines[1:]} == set(GLANCE["metrics"])


def test_several_metrics_have_the_numbers_of_single_ones(cells: pd.DataFrame) -> None:
    table = build_table(cells, GLANCE)
    for name in GLANCE["metrics"]:
        single = {**GLANCE, "cells": {"metric": name}}
        del single["metrics"]
        for (row, column), entry in build_table(cells, single).entries.items():
            assert table.entries[row, (*column, name)] == entry


def test_the_best_follows_the_direction_of_each_metric(cells: pd.DataFrame) -> None:
    table = build_table(cells, GLANCE)
    for row in table.rows:
        for metric in table.metrics:
            entries = [table.entry(row, (name, metric.name)) for name in ("ols", "wls")]
            values = [e.value for e in entries if e is not None and e.value is not None]
            best = [e.value for e in entries if e is not None and e.best]
            if metric.better is None or not values or (len(values) > 1 and len(set(values)) == 1):
                assert not best
            else:
                wanted = min(values) if metric.better == "lower" else max(values)
                assert wanted in best


def test_each_metric_has_one_notation(cells: pd.DataFrame) -> None:
    table = build_table(cells, GLANCE)
    for metric in table.metrics:
        styles = {table.column_notation[c] for c in table.columns if c[-1] == metric.name}
        assert len(styles) == 1
