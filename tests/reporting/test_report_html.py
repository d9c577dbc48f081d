"""Laws of the page: offline, escaped, small, and every cell in it."""

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.reporting import report_data as page_data
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.html import RunView, report_html, write_compare_page, write_report
from sysid_bench.reporting.signal_figures import StoredTorque
from sysid_bench.reporting.text_table import TextTable
from tests.reporting.browser import shown

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


def read_data_text(text: str) -> dict[str, Any]:
    """The JSON data of a packed text."""
    return dict(json.loads(gzip.decompress(base64.b64decode(text))))


def data_of(page: str, name: str = "data") -> dict[str, Any]:
    found = re.search(rf'id="{name}">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return read_data_text(found[1])


def words_of(data: Mapping[str, Any], name: str) -> list[str]:
    """The words (cells) of a column."""
    i = data["words"].index(name)
    codes = data["codes"][i] or [0] * len(data["ids"])
    return [data["dictionary"][i][code] for code in codes]


def test_the_page_is_written_whole_and_alone(run: RunView) -> None:
    path = write_report(run)
    assert [file.name for file in run.folder.iterdir()] == [path.name]
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")


def test_every_cell_is_on_the_page(run: RunView) -> None:
    data = data_of(report_html(run))
    assert data["ids"] == list(run.cells["id"])
    for name in ("status", "robot", "payload", "task", "reason"):
        assert words_of(data, name) == list(run.cells[name])
    values = data["values"][data["scores"].index("torque_error")]
    for given, value in zip(values, run.cells["torque_error"], strict=True):
        assert given is None if pd.isna(value) else given == pytest.approx(value, 1e-3)


@pytest.mark.parametrize("count", [0, 1, 49, 50, 51, 100])
def test_the_first_rows_say_what_all_rows_say(run: RunView, count: int) -> None:
    page = report_html(replace(run, cells=run.cells.head(count)))
    found = re.search(r'id="first">(.*?)</script>', page)
    assert found is not None
    first, data = json.loads(found[1]), data_of(page)
    most = len(first["ids"])
    assert most == min(count, 50)
    assert first["ids"] == data["ids"][:most]
    assert first["values"] == [values[:most] for values in data["values"]]
    for name in data["words"]:
        assert words_of(first, name) == words_of(data, name)[:most]
    assert [first[key] for key in ("count", "shown")] == [count, data["shown"]]


def test_the_first_rows_are_drawn_and_all_can_be_chosen(run: RunView) -> None:
    dom = shown(write_report(run), run.folder / "profile")
    count = len(run.cells)
    assert count > 50
    assert f"{count} of {count} cells, the first 50 shown" in dom
    assert re.findall(r'aria-controls="row-(\w+)"', dom) == list(run.cells["id"][:50])
    assert '<option value="=ur5">' in dom


@pytest.mark.parametrize("size", [1, 7, 500])
def test_every_joint_is_in_the_page(
    run: RunView, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_data, "CELLS", size)
    chunks = [read_data_text(text) for text in page_data.joint_blocks(run.cells, run.joints)]
    assert sum(len(chunk["which"]) for chunk in chunks) == len(run.cells)
    found = []
    for number, chunk in enumerate(chunks):
        errors = iter(chunk["relative"])
        for place, names in enumerate(chunk["which"], start=number * size):
            for joint in chunk["names"][names] if names >= 0 else ():
                found.append((str(run.cells["id"][place]), joint, next(errors)))
        assert next(errors, None) is None
    wanted = run.joints[["id", "name", "relative"]].itertuples(index=False)
    for (cell, joint, error), (own, name, value) in zip(found, wanted, strict=True):
        assert (cell, joint) == (own, name)
        assert error == pytest.approx(value, 1e-2)


def test_joints_beyond_the_limit_of_a_page_are_left_out(
    run: RunView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_data, "CELLS", 7)
    whole = page_data.joint_blocks(run.cells, run.joints)
    monkeypatch.setattr(page_data, "MOST_JOINTS", sum(map(len, whole[:3])))
    assert page_data.joint_blocks(run.cells, run.joints) == whole[:3]
    monkeypatch.setattr(page_data, "MOST_JOINTS", sum(map(len, whole[:3])) - 1)
    assert page_data.joint_blocks(run.cells, run.joints) == whole[:2]


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
    assert sum(tag == "script" and not given for tag, given in elements.found) == 1
    assert "<script>alert" not in page
    links = set(data_of(page)["links"].values())
    assert len(data_of(page)["links"]) == len(cells)
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
    error = np.random.default_rng(2).lognormal(size=7 * len(many_cells))
    joints = pd.DataFrame({"id": np.repeat(many_cells["id"].to_numpy(), 7), "relative": error})
    joints["rmse_test"], joints["name"] = 10 * error[::-1], "joint"
    path = write_report(replace(run, cells=many_cells, tables=tables, joints=joints))
    assert path.stat().st_size < 1_000_000


def test_a_run_where_all_failed_has_a_page(run: RunView, spec: Mapping[str, Any]) -> None:
    lost = run.cells[run.cells["status"] != "ok"].drop(columns=["gap", "closure", "native_gap"])
    empty = replace(run, cells=lost, joints=pd.DataFrame(), tables=(), recordings={}, suite={})
    assert f"<b>{len(lost)}</b>" in report_html(empty)


def test_the_page_fills_the_table_from_its_address(run: RunView) -> None:
    first = str(run.cells["id"][0])
    sample = StoredTorque(
        "Held-out motion", np.arange(1000) / 100, np.ones((1000, 2)), np.zeros((1000, 2)),
        ("elbow", "wrist"), ("N m", "N m"),
    )  # fmt: skip
    page = write_report(replace(run, torques={first: sample}))
    dom = shown(page, run.folder / "profile", f"is.robot=ur5&open={first}&sort=-condition")
    robot = run.cells[run.cells["robot"] == "ur5"]
    assert f"{len(robot)} of {len(run.cells)} cells" in dom
    ids = re.findall(r'aria-controls="row-(\w+)"', dom)
    worst = robot.sort_values("condition", ascending=False, kind="stable", na_position="last")
    assert ids == list(worst["id"])[: len(ids)]
    assert len(ids) == min(len(robot), 50)
    assert f"sysid-bench run {run.folder} --select 'id == \"{first}\"' --rerun all" in dom
    assert 'href="artifacts/a%20b/c.rrd"' in dom
    for joint in sample.rows:  # an axis of its own for each
        assert dom.count(f">residual of {joint} [N m]<") == 1
    for joint in run.joints[run.joints["id"] == first]["name"]:
        assert f'<th scope="row">{joint}</th>' in dom


def measured(page: Path, value: str, address: str = "") -> float:
    """A number that JavaScript reads from a page half a second after its cells are there."""
    text = page.read_text(encoding="utf-8")
    script = f"<script>setTimeout(() => {{ document.body.dataset.found = {value}; }}, 500)</script>"
    page.write_text(f"{text}{script}", encoding="utf-8")
    found = re.search(r'data-found="([^"]*)"', shown(page, page.parent / "profile", address))
    assert found is not None
    return float(found[1])


def test_an_address_with_an_open_row_leads_to_the_cells(run: RunView) -> None:
    page = write_report(replace(run, tables=5 * run.tables))
    top = "document.getElementById('all').getBoundingClientRect().top"
    assert abs(measured(page, top, f"open={run.cells['id'][0]}")) < 40
    assert measured(write_report(replace(run, tables=5 * run.tables)), top) > 600


def test_no_note_makes_a_page_of_a_comparison_wider_than_its_window(tmp_path: Path) -> None:
    page = tmp_path / "compare.html"
    listing = TextTable("changes", "Changes", ("id", "reason"), (("1", "word " * 60),))
    write_compare_page(page, "a -> b", (listing,), (100 * "cells that have not run ",))
    wider = "document.documentElement.scrollWidth - innerWidth"
    assert measured(page, wider) <= 0
