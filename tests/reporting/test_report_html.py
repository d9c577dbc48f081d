"""Laws of the page: offline, escaped, small, and every cell in it."""

import html
import json
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.html import RunView, report_html, write_report

SUITE = {
    "name": "smoke",
    "title": "Three robots",
    "run": {"repeats": 3},
    "crosscheck": {"tolerance": 1e-12},
    "defaults": {
        "plant": "matched",
        "prior": {"mass": "20 %"},
        "held_out": ["fourier-other", "ptp"],
        "simulation": {"use": "inverse"},
        "noise": [{}, {"tau": "0.5 %"}],
    },
}
EVIL = "<script>alert('x')</script>\"&"


@pytest.fixture
def run(
    cells: pd.DataFrame, joints: pd.DataFrame, spec: Mapping[str, Any], tmp_path: Path
) -> RunView:
    env = {"python": "3.11.7", "git": {"commit": "abc", "dirty": False}}
    links = {str(cells["id"][0]): "artifacts/a b/c.rrd"}
    tables = (build_table(cells, spec),)
    return RunView(tmp_path, SUITE, env, cells, joints, tables, links, "sysid-bench run smoke")


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


def test_the_page_is_written_whole_and_alone(run: RunView) -> None:
    path = write_report(run)
    assert [file.name for file in run.folder.iterdir()] == [path.name]
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")


def test_every_cell_is_on_the_page(run: RunView) -> None:
    data = data_of(report_html(run))
    assert [row[0] for row in data["rows"]] == list(run.cells["id"])
    status = data["words"].index("status")
    words = [data["dictionary"][status][row[1 + status]] for row in data["rows"]]
    assert words == list(run.cells["status"])
    score = 1 + len(data["words"]) + data["scores"].index("torque_error")
    for row, value in zip(data["rows"], run.cells["torque_error"], strict=True):
        assert row[score] is None if pd.isna(value) else row[score] == pytest.approx(value, 1e-3)


def test_only_heads_of_metrics_wrap(run: RunView, spec: Mapping[str, Any]) -> None:
    several = {k: v for k, v in spec.items() if k != "cells"}
    wide = build_table(run.cells, {**several, "metrics": ["rmse_test", "torque_error", "rank"]})
    page = report_html(replace(run, tables=(wide, *run.tables)))
    first, *others = re.findall(r"<table[^>]*>\s*<caption>", page)
    assert 'class="metrics"' in first
    assert not any("class" in table for table in others)


def test_every_kind_of_failure_has_its_reason_and_command(run: RunView) -> None:
    page = html.unescape(report_html(run))
    lost = run.cells[run.cells["status"] != "ok"]
    for reason in lost["reason"]:
        assert reason in page
    for cell in lost["id"]:
        assert f"sysid-bench cell {run.folder} {cell}" in page


def test_the_page_says_what_it_assumes(run: RunView) -> None:
    page = report_html(run)
    for text in ("matched", "mass 20 %", "fourier-other", "inverse", "tau 0.5 %", "exact"):
        assert text in page
    assert "take the rest of the robot as known" in page


def test_every_robot_and_payload_is_cross_checked_once(run: RunView) -> None:
    page = report_html(run)
    assert page.count("<td>agrees</td>") == 9
    strict = replace(run, cells=run.cells.assign(crosscheck="failed"))
    assert report_html(strict).count("does not agree") == 9


def test_a_missing_gap_does_not_agree(run: RunView) -> None:
    blind = run.cells.assign(gap=float("nan"))
    page = report_html(replace(run, cells=blind))
    assert "<td>agrees</td>" not in page
    assert page.count("does not agree") == 9


class Elements(HTMLParser):
    """Every element and attribute of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_names_are_text_and_never_markup(run: RunView, spec: Mapping[str, Any]) -> None:
    cells = run.cells.assign(robot=EVIL, reason=EVIL, repairs=EVIL)
    joints = run.joints.assign(name=EVIL)
    evil = replace(
        run, cells=cells, joints=joints, command=EVIL, suite={**SUITE, "title": EVIL},
        env={EVIL: EVIL}, tables=(build_table(cells, {**spec, "title": EVIL}),),
        recordings=dict.fromkeys(cells["id"], f"javascript:{EVIL}"),
    )  # fmt: skip
    page = report_html(evil)
    elements = Elements()
    elements.feed(page)
    assert sum(tag == "script" for tag, _ in elements.found) == 2
    assert "<script>alert" not in page
    links = {row[-1] for row in data_of(page)["rows"]}
    assert all(link.startswith("javascript%3A") and "<" not in link for link in links)


def test_the_page_needs_no_network(run: RunView) -> None:
    elements = Elements()
    elements.feed(report_html(run))
    for tag, attributes in elements.found:
        assert tag not in ("link", "iframe", "img", "object", "embed")
        for name in ("src", "href", "xlink:href", "action"):
            assert (attributes.get(name) or "#").startswith("#")
    assert "url(http" not in report_html(run)


def test_five_thousand_cells_stay_below_a_megabyte(
    many_cells: pd.DataFrame, spec: Mapping[str, Any], run: RunView
) -> None:
    assert len(many_cells) >= 5000
    tables = (build_table(many_cells, spec),)
    path = write_report(replace(run, cells=many_cells, tables=tables))
    assert path.stat().st_size < 1_000_000


def test_a_run_where_all_failed_has_a_page(run: RunView, spec: Mapping[str, Any]) -> None:
    lost = run.cells[run.cells["status"] != "ok"].drop(columns=["gap", "closure", "native_gap"])
    empty = replace(run, cells=lost, joints=pd.DataFrame(), tables=(), recordings={}, suite={})
    assert f"<b>{len(lost)}</b>" in report_html(empty)


def test_the_script_of_the_page_fills_the_table(run: RunView) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed")
    flags = [
        "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
        "--disable-background-networking", "--disable-component-update",
    ]  # fmt: skip
    profile = f"--user-data-dir={run.folder / 'profile'}"
    command = [browser, *flags, profile, "--dump-dom", write_report(run).as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert f"{len(run.cells)} of {len(run.cells)} cells" in done.stdout
    assert 'href="artifacts/a%20b/c.rrd"' in done.stdout
