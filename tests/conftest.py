"""Shared by all tests: shapes of the nouns are enforced, Hypothesis is calm, data is found."""

import os
import sys
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

from sysid_bench.extras import EXTRAS

DATA = "SYSID_BENCH_DATA"

if "sysid_bench.types" in sys.modules:
    raise pytest.UsageError("sysid_bench.types was imported too early: its shapes go unchecked.")
install_import_hook("sysid_bench.types", "beartype.beartype")

# No deadlines: two test processes on two cores make single examples slow now and then. CI repeats
# the same examples, so that more of them find nothing new; `make nightly` draws many.
settings.register_profile("here", deadline=None, max_examples=30)
settings.register_profile("ci", deadline=None, max_examples=30, derandomize=True, database=None)
settings.register_profile("nightly", deadline=None, max_examples=300)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of recorded robot data; the test skips while the variable is unset."""
    named = os.environ.get(DATA)
    if not named:
        pytest.skip(f"{DATA} is unset; let it name the folder of recorded robot data.")
    folder = Path(named)
    if not folder.is_dir():
        pytest.skip(f"{DATA} names {named!r}, and there is no such folder.")
    return folder


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report: pytest.TestReport = _absent_extra_is_a_skip(_no_data_is_a_failure((yield)))
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report: pytest.CollectReport = _absent_extra_is_a_skip(_no_data_is_a_failure((yield)))
    return report


def _no_data_is_a_failure(report: Any) -> Any:
    # Whoever sets the variable wants these tests to run: a quiet skip would hide that they did not.
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else ""
    if os.environ.get(DATA) and report.skipped and reason.startswith(f"Skipped: {DATA}"):
        report.outcome = "failed"
        report.longrepr = f"{DATA} is set, so this may not skip: {reason}"
    return report


def _is_absent(package: str) -> bool:
    try:
        return find_spec(package.replace("-", "_")) is None
    except ModuleNotFoundError:  # a module of a package that is absent
        return True


ABSENT = {name: f"the extra {EXTRAS[name]}" for name in EXTRAS if _is_absent(name)}
if _is_absent("pinocchio"):
    ABSENT["pinocchio"] = "Pinocchio (the package pin)"
if "rerun" not in ABSENT and _is_absent("rerun.chunk"):
    ABSENT["rerun.chunk"] = "rerun-sdk 0.38 or newer, which reads recordings"


def _absent_extra_is_a_skip(report: Any) -> Any:
    """Without an extra, a test that fails for want of it skips and names it; with all
    extras, as `make` installs them, every failure is one."""
    text = str(report.longrepr) if report.failed else ""
    for package, needed in ABSENT.items():
        asked = f"sysid-bench[{EXTRAS.get(package, package)}]" in text
        imported = f"No module named '{package.replace('-', '_')}" in text
        imported |= f"`Import {package}` failed" in text  # of pandas
        if asked or imported or f"needs {package}, which the installed" in text:
            report.outcome = "skipped"
            report.longrepr = (str(report.fspath), 0, f"Skipped: needs {needed}")
    return report
