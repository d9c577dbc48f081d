"""Laws of staleness: what a row has really read decides, and what is gone decides nothing."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.experiments import third_party as loaded_sources
from sysid_bench.harness import fingerprint as fingerprints
from sysid_bench.harness.fingerprint import other_code
from sysid_bench.harness.run import RunResult, run
from sysid_bench.harness.stored_run import RunFolder
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
    stored = RunFolder.open(folder / "run")
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
        assert other_code(stored, stored.row_counts()) == count, name
        assert again(folder, rerun="stale").asked == count, name
        assert other_code(stored, stored.row_counts()) == 0, name
        assert again(folder, rerun="stale").asked == 0, name


@pytest.mark.parametrize("name", ["arm.xml", "mine.py", "sysid_helper_of_test.py"])
def test_what_is_gone_is_not_stale(folder: Path, name: str) -> None:
    first = again(folder)
    (folder / name).unlink()
    forget()
    result = run(folder / "run", jobs=1, rerun="stale")
    assert (result.asked, result.notes) == (0, ())
    assert result.counts == first.counts


# --- What a row has loaded ------------------------------------------------------------------------

LAYOUTS: dict[str, dict[str, str]] = {
    "declared": {"top_level.txt": "other_name_of_test\nmod_of_test\n", "RECORD": "unused.py,,\n"},
    "a module": {"RECORD": "data_of_test/x.csv,,\nmod_of_test.py,sha256=x,9\n"},
    "a package": {"RECORD": "mod_of_test/__init__.py,,\nmod_of_test/a.py,,\n"},
    "an extension": {"RECORD": "mod_of_test.cpython-311-x86_64-linux-gnu.so,,\n"},
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("folder_name", ["site-packages", "dist-packages"])
def test_a_module_is_known_by_the_version_of_its_distribution(
    layout: str, folder_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = tmp_path / folder_name
    info = installed / "My_Dist.of_test-2.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: My_Dist.of_test\nVersion: 2.1\n")
    for name, text in LAYOUTS[layout].items():
        (info / name).write_text(text)
    monkeypatch.syspath_prepend(installed)
    loaded_sources._owners.cache_clear()
    known = [(name, str(installed / "x.py")) for name in ("mod_of_test", "mod_of_test.a.b")]
    for modules in (known, known[:1], known[1:]):
        assert loaded_sources.loaded_sources(modules) == {"My_Dist.of_test": "2.1"}
    other = ("data_of_test", str(installed / "data_of_test" / "x.py"))
    assert loaded_sources.loaded_sources([other]) == {}
    loaded_sources._owners.cache_clear()


def test_own_code_its_requirements_and_the_standard_library_are_no_sources(tmp_path: Path) -> None:
    """They are in every fingerprint, by their version or their content."""
    mine, gone = tmp_path / "mine.py", tmp_path / "gone.py"
    mine.write_text("one")
    modules = [(m.__name__, str(m.__file__)) for m in (np, pytest, struct, loaded_sources, Path)
               if hasattr(m, "__file__")]  # fmt: skip
    assert loaded_sources.loaded_sources(modules) == {}
    found = loaded_sources.loaded_sources([*modules, ("b", str(mine)), ("a", str(gone))])
    assert [*found] == sorted(map(str, (mine, gone)))
    assert found[str(gone)] == "absent"
    assert loaded_sources.stale_sources(found) == []
    mine.write_text("other")
    loaded_sources._present.cache_clear()
    assert loaded_sources.stale_sources(found) == [str(mine)]
    gone.write_text("is back")
    loaded_sources._present.cache_clear()
    assert loaded_sources.stale_sources(found) == [str(gone), str(mine)]
    mine.unlink()
    loaded_sources._present.cache_clear()
    assert loaded_sources.stale_sources({str(mine): found[str(mine)]}) == []
    assert loaded_sources.stale_sources({"numpy": np.__version__, "no_such": "1"}) == []
    assert loaded_sources.stale_sources({"numpy": "0.1"}) == ["numpy"]
