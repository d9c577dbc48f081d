"""Progress off a terminal: a line a minute, and none for short runs."""

import pytest

from sysid_bench.commands.progress import ProgressLines


def test_a_line_a_minute(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    lines = ProgressLines(clock=lambda: now[0])
    lines.update("plan", {"open": 4, "seconds": {"a": 1.0, "b": 1.0, "c": 1.0, "d": 5.0}})
    for passed, cell, status in ((30.0, "a", "ok"), (61.0, "b", "failed"), (90.0, "c", "ok")):
        now[0] = passed
        lines.update("row", {"id": cell, "status": status, "reason": ""})
    assert capsys.readouterr().err == "2/4 cells, 1 failed, 25 % after 61 s, about 183 s left\n"
    now[0] = 130.0
    lines.update("row", {"id": "d", "status": "ok", "reason": ""})
    assert capsys.readouterr().err == "4/4 cells, 1 failed, 100 % after 130 s\n"


def test_one_small_cell_predicts_no_rest(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    lines = ProgressLines(clock=lambda: now[0])
    lines.update("plan", {"open": 2, "seconds": {"a": 1e-3, "b": 1.0}})
    now[0] = 61.0
    lines.update("row", {"id": "a", "status": "ok", "reason": ""})
    assert capsys.readouterr().err == "1/2 cells, 0 % after 61 s\n"
