"""The repository of docs/continuous-integration.md: green, then red after a change of the robot."""

import re
from pathlib import Path

import pytest

from tests.printed_commands import blocks, place, run_line

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "continuous-integration.md").read_text(encoding="utf-8")


@pytest.mark.long
def test_the_repository_is_green_then_red(tmp_path: Path) -> None:
    for _, text in blocks(TEXT):
        place(tmp_path, text)
    once = [line for kind, text in blocks(TEXT) if kind == "sh" for line in text.splitlines()]
    steps = re.findall(r"- run: (sysid-bench .*)", TEXT)
    assert len(once) == len(steps) == 3
    for line in (*once, *steps):
        done = run_line(line, tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
    method = tmp_path / "methods" / "truncated.py"
    method.write_text(method.read_text().replace("share: float = 1e-10", "share: float = 0.3"))
    runs = [run_line(line.replace("runs/ci", "runs/changed"), tmp_path) for line in steps]
    assert runs[-1].returncode == 1
    assert "torque_error" in runs[-1].stdout
    assert "Truncated" in runs[-1].stdout
    assert "::error file=regression.json" in runs[-1].stdout
    assert (tmp_path / "regression.xml").is_file()
