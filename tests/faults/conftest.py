"""Suites and tasks of the tests of the harness serve here too."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))


@pytest.fixture
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A word in the environment of every process that a test starts."""
    monkeypatch.setenv("SYSID_TEST_FAULT", tmp_path.name)
    return tmp_path.name
