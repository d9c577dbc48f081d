"""Laws of the size of a plan: it is counted without making cells, and what it counts is there."""

import re
from pathlib import Path

import pytest
from harness_world import NAMES

from sysid_bench.errors import UsageError
from sysid_bench.harness import suite_cells as plan_size
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.model import Suite

HEAD = """
schema = 1
name = "size"
[run]
repeats = {repeats}
[defaults]
rate = [{rates}]
noise = [{noise}]
prior = [{prior}]
simulation = [{simulation}]
[[robot]]
use = ["ur5", "panda"]
payloads = ["none", "sphere-1kg"]
{more}
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
"""
NOISY, EXACT = '{ tau = "1 %" }', "{}"


def suite(
    repeats: int = 1, rates: int = 1, noise: str = EXACT, prior: str = '"truth"',
    simulation: str = '"inverse"', more: str = "",
) -> Suite:  # fmt: skip
    sweep = ", ".join(f'"{100 + n} Hz"' for n in range(rates))
    text = HEAD.format(
        repeats=repeats, rates=sweep, noise=noise, prior=prior, simulation=simulation, more=more
    )
    return parse_suite(text, folder=Path(), names=NAMES)


@pytest.mark.parametrize("noise", [EXACT, NOISY, f"{EXACT}, {NOISY}"])
@pytest.mark.parametrize("prior", ['"truth"', "{ redrawn = true }, { redrawn = false }"])
@pytest.mark.parametrize("simulation", ['"inverse"', '"inverse", "closed-loop"'])
def test_the_size_is_the_number_of_cells(
    noise: str, prior: str, simulation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = suite(3, 2, noise, prior, simulation)
    cells = len(cells_of_suite(sample, NAMES).cells)
    monkeypatch.setattr(plan_size, "MANY", cells - 1)
    with pytest.raises(UsageError, match=rf"'size' has {cells:,} cells "):
        cells_of_suite(sample, NAMES)
    assert len(cells_of_suite(sample, NAMES, large=True).cells) == cells
    monkeypatch.setattr(plan_size, "MANY", cells)
    assert len(cells_of_suite(sample, NAMES).cells) == cells


def test_several_tables_of_robots_and_the_product(monkeypatch: pytest.MonkeyPatch) -> None:
    sample = suite(more='[[robot]]\nuse = "go2"\n', rates=3)
    monkeypatch.setattr(plan_size, "MANY", 29)
    product = r"5 robots with payloads x 2 estimators x 3 rate = 30\. .*--large"
    with pytest.raises(UsageError, match=product):
        cells_of_suite(sample, NAMES)


def test_a_plan_that_no_machine_could_hold_is_refused_at_once() -> None:
    """Made cell by cell it would never end: 3,000 rates, 10^9 repeats."""
    sample = suite(repeats=10**9, rates=3000, noise=NOISY)
    with pytest.raises(UsageError) as caught:
        cells_of_suite(sample, NAMES)
    factors = "2 robots x 2 payloads x 2 estimators x 3,000 rate x 1,000,000,000 repeats"
    assert re.search(re.escape(f"{factors} = 24,000,000,000,000"), str(caught.value))
