"""Written manifests read back as given."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

from sysid_bench.models.manifest import JointTerms, find_manifest, read_manifest
from sysid_bench.models.writing.manifest_writer import manifest_text
from tests.robots import NAMED

OTHERS = ("path", "manifest_file", "dh", "paper")
"""Fields that belong to the original file."""


@pytest.mark.parametrize("name", NAMED)
def test_a_written_manifest_reads_back_as_given(name: str, tmp_path: Path) -> None:
    terms = JointTerms(viscous=0.1 + 0.2, offset=-1e-3, spring=-2.0, viscous_coupling={"b": 0.5})
    manifest = replace(
        find_manifest(name), joints={"a": terms}, locked={"c": 0.25}, massless=("d",),
        gravity=(0.0, 9.81, 0.0), couplings=False, assets=tmp_path,
    )  # fmt: skip
    (tmp_path / "model.xml").write_text("<mujoco/>")
    file = tmp_path / "robot.toml"
    file.write_text(manifest_text(manifest, "model.xml"))
    again = read_manifest(file)
    for field in fields(manifest):
        if field.name not in OTHERS:
            assert getattr(again, field.name) == getattr(manifest, field.name), field.name
    assert again.path == tmp_path / "model.xml"
