"""Laws of staleness: what a row has really read decides, and what is gone decides nothing."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.experiments import third_party as loaded_sources
from sysid_bench.harness import fingerprint as fingerprints
from sysid_bench.harness.run import RunResult, run
from sysid_bench.harness.suite.load_suite import load_suite

PLUGIN = """
import os, sys
sys.path.insert(0, os.path.dirname(__file__))
import sysid_helper_of_test
import sysid_dist_of_test

class Mine:
    def solve(self, problem):
        return sysid_helper_of_test.fit(problem)
"""
HELPER = """
import numpy as np
from sysid_bench.types import Estimate

def fit(problem):
    return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])
"""
MODEL = """
<mujoco><compiler meshdir="meshes"/>
  <asset><mesh name="part" file="part.obj"/><mesh name="link" file="link.stl"/></asset>
  <worldbody><body><joint name="j" axis="0 1 0"/>
    <inertial pos="0 0 .1" mass="1" diaginertia="1e-2 1e-2 1e-2"/>
  </body></worldbody>
</mujoco>
"""
MESH = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
_CORNERS = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
_FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
STL = b"version 1.0".ljust(80) + struct.pack("<I", 4)
STL += b"".join(struct.pack("<12fH", 0, 0, 0, *_CORNERS[face].ravel(), 0) for face in _FACES)
SUITE = """
schema = 1
name = "stale"
[defaults]
excitation = { use = "fourier", harmonics = 2, period = "1 s" }
held_out = ["ptp"]
[[robot]]
use = ["scara", "file:arm.xml"]
[[estimator]]
use = "ols"
[[estimator]]
use = "file:mine.py:Mine"
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A suite of two robots and two methods; the plug-in imports a helper and a distribution."""
    installed = tmp_path / "env" / "site-packages"
    (installed / "sysid_dist_of_test-1.0.dist-info").mkdir(parents=True)
    info = installed / "sysid_dist_of_test-1.0.dist-info"
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: sysid-dist-of-test\nVersion: 1.0\n"
    )
    (info / "top_level.txt").write_text("sysid_dist_of_test\n")
    (info / "RECORD").write_text("")
    (installed / "sysid_dist_of_test.py").write_text("")
    monkeypatch.syspath_prepend(installed)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "part.obj").write_text(MESH)
    (tmp_path / "meshes" / "link.stl").write_bytes(STL)
    for name, text in (
        ("mine.py", PLUGIN), ("sysid_helper_of_test.py", HELPER), ("arm.xml", MODEL),
        ("suite.toml", SUITE),
    ):  # fmt: skip
        (tmp_path / name).write_text(text)
    return tmp_path


def forget() -> None:
    """What is read once per process is forgotten."""
    for name in ("_fingerprint", "_file", "_model", "_plugin", "_model_files"):
        getattr(fingerprints, name).cache_clear()
    loaded_sources._present.cache_clear()


def again(folder: Path, **settings: Any) -> RunResult:
    """A run as a new process sees it."""
    forget()
    return run(load_suite(folder / "suite.toml"), folder / "run", jobs=1, **settings)


def test_exactly_the_touched_cells_run_again(folder: Path) -> None:
    first = again(folder)
    assert first.counts == {"ok": 4}
    assert again(folder, rerun="stale").asked == 0
    touched = {
        "sysid_helper_of_test.py": 2,
        "mine.py": 2,
        "meshes/part.obj": 2,
        "meshes/link.stl": 2,
        "env/site-packages/sysid_dist_of_test-1.0.dist-info/METADATA": 2,
    }
    for name, count in touched.items():
        file = folder / name
        text = file.read_bytes()
        file.write_bytes(text.replace(b"1.0", b"1.1") if b"1.0" in text else text + b"\n")
        note = again(folder).notes
        assert any(f"{count} rows are from other code" in sentence for sentence in note), name
        assert again(folder, rerun="stale").asked == count, name
        assert again(folder, rerun="stale").asked == 0, name


@pytest.mark.parametrize("name", ["arm.xml", "mine.py", "sysid_helper_of_test.py"])
def test_what_is_gone_is_not_stale(folder: Path, name: str) -> None:
    first = again(folder)
    (folder / name).unlink()
    forget()
    result = run(folder / "run", jobs=1, rerun="stale")
    assert (result.asked, result.notes) == (0, ())
    assert result.counts == first.counts
