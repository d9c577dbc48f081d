"""Laws of provenance: a fingerprint changes with what a number depends on, and with that alone."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from harness_world import NAMES, small

from sysid_bench import version_fields
from sysid_bench.harness import fingerprint as fingerprints
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.fingerprint import cell_fingerprint, fingerprint
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.version_fields import environment

CACHES = (
    *(
        (fingerprints, name)
        for name in ("_fingerprint", "_file", "_model", "_plugin", "_model_files")
    ),
    *((version_fields, name) for name in ("source_hash", "_versions")),
)


def forget() -> None:
    for module, name in CACHES:
        getattr(module, name).cache_clear()


@pytest.fixture(autouse=True)
def _new_process() -> None:
    """What is read once per process is forgotten."""
    forget()


def test_the_environment_is_plain_and_complete() -> None:
    found = json.loads(json.dumps(environment()))
    assert set(found) == {
        "python", "platform", "cpu", "cores", "instructions", "blas", "versions", "git",
    }  # fmt: skip
    assert set(found["versions"]) == set(version_fields.PACKAGES)
    assert found["cpu"]
    assert found["blas"]


def test_looking_imports_nothing_heavy() -> None:
    code = (
        "import sys; from sysid_bench.harness.fingerprint import *; "
        "from sysid_bench.version_fields import *; environment();"
        "fingerprint([], ['numpy:array']);"
        "print([m for m in ('mujoco', 'pinocchio', 'pandas', 'clarabel', 'scipy', 'sympy') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_fingerprint_follows_models_plugins_and_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    model, part, plugin = tmp_path / "a.xml", tmp_path / "b.xml", tmp_path / "mine.py"
    package = tmp_path / "mylab_of_test"
    package.mkdir()
    files = [model, part, plugin, package / "__init__.py", package / "helper.py"]
    for file in files:
        file.write_text("# one")
    model.write_text('<mujoco><include file="b.xml"/></mujoco>')
    plugins = [f"file:{plugin}:Mine", "mylab_of_test.methods:Mine"]
    seen = {fingerprint([model], plugins)}
    for file in files:
        file.write_text(file.read_text() + " ")
        assert fingerprint([model], plugins) in seen  # read once per process
        forget()
        seen.add(fingerprint([model], plugins))
    monkeypatch.setattr(version_fields, "PACKAGES", ("sysid-bench", "numpy"))
    forget()
    seen.add(fingerprint([model], plugins))
    assert len(seen) == len(files) + 2
    (tmp_path / "unrelated.py").write_text("")
    forget()
    assert fingerprint([model], reversed(plugins)) in seen


MODELS = {
    "arm.xml": '<mujoco><compiler meshdir="parts"/><asset><mesh file="{}"/></asset></mujoco>',
    "assets.xml": "<mujoco><compiler assetdir='parts'/><asset><mesh\nfile='{}'/></asset></mujoco>",
    "beside.xml": '<mujoco><asset><mesh file="parts/{}"/></asset></mujoco>',
    "package.urdf": '<robot name="r"><mesh filename="package://parts/{}" scale="1 1 1"/></robot>',
    "file.urdf": '<robot name="r"><mesh filename = "parts/{}"/></robot>',
    "outer.xml": '<mujoco><compiler meshdir="parts"/><include file="inner.xml"/></mujoco>',
}
INNER = '<mujoco><asset><mesh file="{}"/></asset></mujoco>'


@pytest.mark.parametrize("mesh", ["a.stl", "a.STL", "a.obj", "a.msh", "a.dae", "a b.stl", "h.bin"])
@pytest.mark.parametrize("name", MODELS)
def test_a_fingerprint_follows_meshes(tmp_path: Path, name: str, mesh: str) -> None:
    """Inertias of a body without <inertial> come from its mesh; pictures change no number."""
    (tmp_path / "parts").mkdir()
    model = tmp_path / name
    model.write_text(MODELS[name].format(mesh))
    (tmp_path / "inner.xml").write_text(INNER.format(mesh))
    found = []
    for content in (b"one", b"two", b"one"):
        (tmp_path / "parts" / mesh).write_bytes(content)
        forget()
        found.append(fingerprint([model], ()))
    assert found[0] == found[2] != found[1]


def cell_of(folder: Path, body: str = "", estimators: str = "") -> Cell:
    text = small(body, estimators=estimators or '[[estimator]]\nuse = "file:mine.py:Mine"\n')
    text = text.replace('use = "ur5"', 'use = "file:arm.urdf"')
    return cells_of_suite(parse_suite(text, "suite.toml", folder, NAMES), NAMES).cells[0]


def test_a_cell_depends_on_its_model_and_on_every_plugin_file(tmp_path: Path) -> None:
    every = ("arm.urdf", "mine.py", "motion.py", "motion.csv")
    for name in every:
        (tmp_path / name).write_text(name)
    held_out = '["file:motion.py:Motion", { use = "fourier", file = "motion.csv" }]'
    cell = cell_of(tmp_path, f"[defaults]\nheld_out = [{held_out}]")
    seen = {cell_fingerprint(cell, None, tmp_path)}
    for name in every:
        (tmp_path / name).write_text("changed")
        forget()
        seen.add(cell_fingerprint(cell, None, tmp_path))
    assert len(seen) == 5
    (tmp_path / "arm.urdf").unlink()
    forget()
    assert cell_fingerprint(cell, None, tmp_path) == ""


def test_a_generated_robot_has_a_fingerprint(tmp_path: Path) -> None:
    text = 'schema = 1\nname = "s"\n[[robot]]\nuse = "{}"\n[[estimator]]\nuse = "ols"\n'
    for robot in ("random:7", "random:four-bar:7"):
        suite = parse_suite(text.format(robot), "suite.toml", tmp_path)
        assert cell_fingerprint(cells_of_suite(suite).cells[0], None, tmp_path)


def test_a_fingerprint_follows_versions_of_python_and_not_their_patches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.xml").write_text("<mujoco/>")
    found = []
    for version in ((3, 12, 1), (3, 12, 9), (3, 13, 1), (4, 12, 1)):
        monkeypatch.setattr(fingerprints, "sys", SimpleNamespace(version_info=version))
        forget()
        found.append(fingerprint([tmp_path / "a.xml"], ()))
    assert found[0] == found[1]
    assert len(set(found)) == 3
    assert all(len(one) == 16 for one in found)


@pytest.mark.parametrize("gone", [0, 1, 2])
def test_a_model_that_is_gone_leaves_no_fingerprint(gone: int, tmp_path: Path) -> None:
    """At once, whatever this process has read before."""
    files = [tmp_path / name for name in ("a.xml", "b.xml", "c.xml")]
    for file in files:
        file.write_text("<mujoco/>")
    assert fingerprint(files, ())
    files[gone].unlink()
    assert fingerprint(files, ()) == ""


LOG = """file = "{}.csv"
rate = "50 Hz"
joints = ["j1"]
q = {{ columns = [1] }}
tau = {{ columns = [2] }}
"""
RECORDED = """schema = 1
name = "recorded"
[[log]]
robot = "file:arm.urdf"
train = ["run.toml"]
test = ["other.toml"]
[[estimator]]
use = "ols"
"""


def test_a_recorded_cell_depends_on_its_recordings(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("<robot/>")
    for name in ("run", "other"):
        (tmp_path / f"{name}.csv").write_text("1,2\n" * 9)
        (tmp_path / f"{name}.toml").write_text(LOG.format(name))
    suite = parse_suite(RECORDED, "suite.toml", tmp_path, NAMES)
    (cell,) = cells_of_suite(suite, NAMES).cells
    seen = {cell_fingerprint(cell, None, tmp_path)}
    for name in ("run.toml", "run.csv", "other.toml", "other.csv", "arm.urdf"):
        with (tmp_path / name).open("a") as file:
            file.write("\n")
        forget()
        seen.add(cell_fingerprint(cell, None, tmp_path))
    assert len(seen) == 6
    assert "" not in seen
