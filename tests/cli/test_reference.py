"""The committed reference of the smoke suite is what the suite gives."""

import re
from pathlib import Path

import pytest

from .conftest import Run

REFERENCE = Path(__file__).parents[2] / "reports" / "reference" / "smoke.md"
ROUNDING = 1e-12
SELECT = 'robot == "ur5" and payload == "none" and task == "robot"'


def entries(text: str, robot: str) -> list[float]:
    """The medians of a robot's first line in the first table of a Markdown text."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {robot} | none |"))
    cells = line.replace("*", "").split("|")[3:-1]
    return [float(re.split(r" \\?\[", cell.strip())[0]) for cell in cells]


@pytest.mark.slow
def test_the_reference_is_what_the_suite_gives(cli: Run) -> None:
    done = cli("run", "smoke", "-o", "out", "--select", SELECT)
    assert done.returncode == 0, done.stderr
    printed = cli("table", "out", "main").stdout
    committed = REFERENCE.read_text(encoding="utf-8")
    for ours, theirs in zip(entries(printed, "ur5"), entries(committed, "ur5"), strict=True):
        if theirs < ROUNDING:
            assert ours < ROUNDING
        else:
            assert ours == pytest.approx(theirs, rel=0.01)
