"""The committed references are what their suites give."""

import re
from pathlib import Path

import pytest

from .conftest import Run

pytestmark = pytest.mark.long

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
    done = cli("run", "smoke", "-o", "out", "-j", "1", "--select", SELECT)
    assert done.returncode == 0, done.stderr
    printed = cli("table", "out", "main").stdout
    committed = REFERENCE.read_text(encoding="utf-8").partition("**Held-out torque error")[2]
    for ours, theirs in zip(entries(printed, "ur5"), entries(committed, "ur5"), strict=True):
        if theirs < ROUNDING:
            assert ours < ROUNDING
        else:
            assert ours == pytest.approx(theirs, rel=0.01)


def test_the_table_of_the_last_joint_is_what_the_suite_gives(cli: Run) -> None:
    """Of one arm: ranks and verdicts, line by line."""
    done = cli("run", "terminal", "-o", "out", "-j", "1", "--select", 'robot == "scara"')
    assert done.returncode == 0, done.stderr
    committed = (REFERENCE.parent / "terminal.md").read_text(encoding="utf-8").splitlines()
    lines = [line for line in done.stdout.splitlines() if " scara | " in line]
    words = [line for line in lines if "identifiable" in line]
    assert lines[0] == "| scara | 3 | 5 | 4 | 4 |"
    assert len(words) == 3
    for line in (lines[0], *words):
        assert line in committed


def test_the_table_of_the_last_joint_has_twelve_arms() -> None:
    text = (REFERENCE.parent / "terminal.md").read_text(encoding="utf-8")
    ranks = text.partition("Base parameters: largest value.")[2].partition("**")[0]
    lines = [line.strip("| ").split(" | ") for line in ranks.splitlines() if line.startswith("|")]
    arms = {name: numbers for name, *numbers in lines[2:]}
    assert len(arms) >= 12
    assert arms.pop("scara") == ["3", "5", "4", "4"]
    assert set(map(tuple, arms.values())) == {("7", "9", "10", "10")}


@pytest.mark.data
def test_errors_across_days_are_what_the_suite_gives(cli: Run, data_folder: Path) -> None:
    done = cli("run", "dvrk-real", "-o", "out", "-j", "1", "--select",
               'excitation == "PSM" and estimator == "wls"')  # fmt: skip
    assert done.returncode == 0, done.stderr
    committed = (REFERENCE.parent / "dvrk-real.md").read_text(encoding="utf-8").splitlines()
    # Tables by joint have six numbers; the table of times has one, which differs from run to run.
    lines = [line for line in done.stdout.splitlines() if line.startswith("| PSM | 0.0")]
    numbers = {line for line in lines if line.count("|") == 8}
    assert len(numbers) == 2
    assert numbers <= set(committed)
