"""Suites and tasks of the tests of the harness serve here too."""

import sys
import uuid
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))


@pytest.fixture
def token(monkeypatch: pytest.MonkeyPatch) -> str:
    """A word in the environment of every process that a test starts; names of folders are cut."""
    word = uuid.uuid4().hex
    monkeypatch.setenv("SYSID_TEST_FAULT", word)
    return word
