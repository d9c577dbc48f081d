"""The commit of a wheel is what its build wrote; anything else is no commit."""

import json
from pathlib import Path

import pytest

from sysid_bench import version_fields


@pytest.mark.parametrize("dirty", [True, False])
def test_a_wheel_has_the_commit_of_its_checkout(
    dirty: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = {"commit": "0123abcd", "dirty": dirty}
    (tmp_path / "commit.json").write_text(json.dumps(built))
    monkeypatch.setattr(version_fields, "PACKAGE_FOLDER", tmp_path)
    assert version_fields.environment()["git"] == built


@pytest.mark.parametrize("text", [None, "", "[]", "{}", '{"commit": "a"}'])
def test_a_wheel_without_a_commit_has_none(
    text: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is not None:
        (tmp_path / "commit.json").write_text(text)
    monkeypatch.setattr(version_fields, "PACKAGE_FOLDER", tmp_path)
    assert version_fields.environment()["git"] is None
