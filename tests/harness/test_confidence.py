"""The confidence level of a suite, or of the command line, reaches every interval."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import norm

from sysid_bench.commands.main import main
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_suite

SUITE = """
schema = 1
name   = "levels"
{}
[run]
repeats = 3
[defaults]
noise = {{ tau = "1 %" }}
excitation = {{ use = "fourier", period = "2 s", cycles = 1 }}
held_out = ["ptp"]
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
[[table]]
name = "widths"
rows = ["robot"]
columns = ["std_from"]
metrics = ["width_inertial", "coverage_inertial"]
[[table]]
name = "errors"
rows = ["robot"]
cells = {{ metric = "torque_error", stat = "mean", interval = "ci95" }}
"""


def invoked(*words: str) -> str:
    found = CliRunner().invoke(main, list(words), catch_exceptions=False)
    assert found.exit_code == 0, found.output
    return found.output


def textbook_width(folder: Path) -> np.ndarray:
    lines = RunFolder.open(folder).frames().by_std_from
    return lines.loc[lines["std_from"] == "textbook", "width_inertial"].to_numpy(float)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same suite at the usual level, with a level of its own, and with one of the command."""
    folder = tmp_path_factory.mktemp("levels")
    made = {}
    for name, key, words in (
        ("usual", "", ()),
        ("suite", "confidence = 0.5", ()),
        ("command", "", ("--confidence", "0.5")),
    ):
        file = folder / f"{name}.toml"
        file.write_text(SUITE.format(key))
        made[name] = folder / name
        invoked(*words, "run", str(file), "-o", str(made[name]))
    return made


def test_cells_have_intervals_of_the_level(runs: dict[str, Path]) -> None:
    usual, *others = (textbook_width(runs[name]) for name in ("usual", "suite", "command"))
    share = norm.ppf(0.75) / norm.ppf(0.975)
    for width in others:
        np.testing.assert_allclose(width, share * usual, rtol=1e-9)


def test_cells_of_another_level_are_others(runs: dict[str, Path]) -> None:
    usual, own, stated = (
        set(RunFolder.open(runs[n]).planned) for n in ("usual", "suite", "command")
    )
    assert own == stated
    assert own.isdisjoint(usual)
    assert parse_suite((runs["command"] / "run.toml").read_text()).confidence == 0.5


def test_tables_name_the_level_and_have_it(runs: dict[str, Path]) -> None:
    errors = ("errors", "--format", "csv")
    usual, at_half = (invoked("table", str(runs[name]), *errors) for name in ("usual", "suite"))
    assert at_half != usual
    assert invoked("--confidence", "0.5", "table", str(runs["usual"]), *errors) == at_half
    text = invoked("table", str(runs["suite"]), "widths", "--format", "md")
    assert "Width of 50 % intervals" in text
    assert "95 %" not in text


def test_a_level_beyond_its_range_is_refused(runs: dict[str, Path]) -> None:
    found = CliRunner().invoke(main, ["--confidence", "95", "report", str(runs["usual"])])
    assert found.exit_code == 2
    assert "--confidence" in found.output
