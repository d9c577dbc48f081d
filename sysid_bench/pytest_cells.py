"""pytest plug-in: every cell of a suite is a test.

`pytest --sysid-suite suite.toml [--sysid-baseline FILE]`, or `sysid_suites` and `sysid_baselines`
in the configuration of pytest. Every session imports this file: the items, and all that they need,
are loaded for a suite alone.
"""

from importlib import import_module
from pathlib import Path
from typing import Any, Final

import pytest

_ITEMS: Final = "sysid_bench.pytest_suite"
_SUITES: Final = pytest.StashKey[list[Path]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the command line, and keys of the configuration."""
    group = parser.getgroup("sysid-bench")
    group.addoption(
        "--sysid-suite", action="append", default=[], metavar="SUITE",
        help="Collect every cell of this suite as a test; without other paths, these alone.",
    )  # fmt: skip
    group.addoption(
        "--sysid-baseline", action="append", default=[], metavar="FILE",
        help="Compare the cells of the suite of this baseline with it.",
    )  # fmt: skip
    parser.addini("sysid_suites", "suites whose cells are tests", type="linelist", default=[])
    parser.addini("sysid_baselines", "baselines of these suites", type="linelist", default=[])


def pytest_configure(config: pytest.Config) -> None:
    """Add the suites to the paths of the session."""
    config.addinivalue_line("markers", "sysid_cell: a cell of a suite")
    suites = _suite_files(config)
    if not suites:
        return
    alone = config.getoption("--sysid-suite") and config.args_source != config.ArgsSource.ARGS
    config.args[:] = [*([] if alone else config.args), *map(str, suites)]


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> Any:
    """Collect a suite that was named; other TOML files are left alone."""
    if file_path.suffix != ".toml" or file_path.resolve() not in _suite_files(parent.config):
        return None
    return import_module(_ITEMS).suite_file(file_path, parent)


def _suite_files(config: pytest.Config) -> list[Path]:
    """Files of the suites that are named; built-in ones by their name."""
    if _SUITES not in config.stash:
        named = config.getoption("--sysid-suite") or config.getini("sysid_suites")
        found = import_module(_ITEMS).suite_files(config, named) if named else []
        config.stash[_SUITES] = found
    return config.stash[_SUITES]
