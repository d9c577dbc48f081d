"""Regressions planted in a copy of the package: gate and pytest name the cells, exit code 1."""

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.instruction_sets import VARIABLE
from tests.other_package import python_with

from .conftest import small_suite

ROOT = Path(__file__).parents[2]
TILTED, RUBBING = "tilted", "rubbing"
MODEL = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
 <body><joint name="j1" axis="0 0 1" range="-2 2"/>
  <inertial mass="3" pos="0.1 0 0" diaginertia="0.02 0.03 0.03"/>
  <body name="arm" pos="0.3 0 0"><joint name="j2" axis="{axis}" range="-2 2"/>
   <inertial mass="1.5" pos="0.1 0 0.02" diaginertia="0.01 0.02 0.02"/>
  </body></body></worldbody></mujoco>
"""
ROBOTS = {TILTED: ("0.003 0 1", []), RUBBING: ("0 1 0", ["viscous", "coulomb"])}
"""Axis of the second joint and joint terms: an axis that is nearly parallel to the first one has a
singular value of the regressor between 1e-5 and 1e-4 of the largest."""


@dataclass(frozen=True)
class Regression:
    """A text of a file, below the package or a robot, that becomes another one."""

    file: str
    before: str
    after: str
    robot: str
    sign: str


REGRESSIONS = {
    "wrong sign in the friction column": Regression(
        "sysid_bench/regressors/regression.py", '"fc": lambda q, v, a: np.sign(v)',
        '"fc": lambda q, v, a: -np.sign(v)', RUBBING, "parameter_error",
    ),
    "rank threshold ten times larger": Regression(
        "sysid_bench/identifiability/base_map.py", "RANK_TOLERANCE: Final = 1e-5",
        "RANK_TOLERANCE: Final = 1e-4", TILTED, "rank",
    ),
    "inertia changed by 1 %": Regression(
        "robots/rubbing/arm.xml", "0.01 0.02 0.02", "0.01 0.02 0.0202", RUBBING, "parameters",
    ),
}  # fmt: skip


def python_of(folder: Path) -> Path:
    """Python that imports the copy of the package in a folder; made once for each."""
    place = folder / ".python"
    return place / "bin" / "python" if place.is_dir() else python_with(folder, place)


def execute(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A module of Python with the copied package, and with the kernel that is Python itself: the
    compiled one would not change with its source."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    return subprocess.run(
        [str(python_of(folder)), "-m", *words], cwd=folder, text=True, capture_output=True,
        timeout=300, env={**kept, "PYTHONPATH": str(folder), VARIABLE: "numpy"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package, two robots, a suite and its baseline."""
    folder = tmp_path_factory.mktemp("sound")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "sysid_bench", folder / "sysid_bench", ignore=ignored)
    for name in ("suites", "data"):
        (folder / name).symlink_to(ROOT / name)
    for name, (axis, terms) in ROBOTS.items():
        (folder / "robots" / name).mkdir(parents=True)
        (folder / "robots" / name / "arm.xml").write_text(MODEL.format(axis=axis))
        keys = f'name = "{name}"\nfile = "arm.xml"\nterms = {json.dumps(terms)}\n'
        (folder / "robots" / name / "robot.toml").write_text(
            f"{keys}[joints.all]\nviscous = 0.3\ncoulomb = 0.2\n" if terms else keys
        )
    (folder / "s.toml").write_text(small_suite(tuple(ROBOTS), estimators=("ols",)))
    assert execute(folder, "sysid_bench", "run", "s.toml", "-o", "first").returncode == 0
    words = ("baseline", "save", "first", "-o", "b.json")
    assert execute(folder, "sysid_bench", *words).returncode == 0
    return folder


@pytest.mark.long
@pytest.mark.parametrize("name", REGRESSIONS)
def test_a_regression_is_caught_by_gate_and_by_pytest(
    sound: Path, tmp_path: Path, name: str
) -> None:
    planted = REGRESSIONS[name]
    folder = tmp_path / "changed"
    shutil.copytree(
        sound, folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", ".python")
    )
    file = folder / planted.file
    text = file.read_text()
    assert text.count(planted.before) == 1
    file.write_text(text.replace(planted.before, planted.after))
    execute(folder, "sysid_bench", "run", "s.toml", "-o", "later")
    words = ("gate", "later", "--baseline", "b.json")
    done = execute(folder, "sysid_bench", *words, "--json")
    assert done.returncode == 1, done.stdout + done.stderr
    answer = json.loads(done.stdout)
    named = {change["cell"].split()[0] for change in answer["failures"]}
    named |= {change["robot"] for change in answer["parameters"]}
    assert named == {planted.robot}
    metrics = {change["metric"] for change in answer["failures"]}
    assert planted.sign in metrics or (planted.sign == "parameters" and answer["parameters"])
    installed = entry_points(group="pytest11", name="sysid-bench")
    plugin = [] if installed else ["-p", "sysid_bench.pytest_cells"]
    tests = ("--sysid-suite", "s.toml", "--sysid-baseline", "b.json")
    done = execute(folder, "pytest", *plugin, "-q", *tests)
    assert done.returncode == 1, done.stdout + done.stderr
    failed = set(re.findall(r"^FAILED s\.toml::(\w+)\[", done.stdout, re.MULTILINE))
    assert failed == {planted.robot}


@pytest.mark.long
def test_another_library_is_named_and_does_not_fail(sound: Path, tmp_path: Path) -> None:
    text = (sound / "b.json").read_text()
    other = tmp_path / "other.json"
    other.write_text(text.replace('"numpy": "', '"numpy": "0'))
    done = execute(sound, "sysid_bench", "gate", "first", "--baseline", str(other))
    assert done.returncode == 0, done.stdout
    assert re.search(r"differs: .*numpy 0\S+ -> ", done.stdout)


@pytest.mark.long
def test_a_kernel_that_is_twice_as_slow_is_named(sound: Path, tmp_path: Path) -> None:
    """Every block of the regressor is computed twice; the ratios are those of parts of one run."""
    folder = tmp_path / "changed"
    shutil.copytree(
        sound, folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", ".python")
    )
    (folder / "t.toml").write_text(many_repeats(small_suite(tuple(ROBOTS))))
    file, call = folder / "sysid_bench/regressors/regression.py", "values = self._values(span)"
    text = file.read_text()
    assert text.count(call) == 1
    verdicts = {}
    for name, planted in (("first", call), ("slow", f"self._values(span); {call}")):
        file.write_text(text.replace(call, planted))
        done = execute(folder, "sysid_bench", "run", "t.toml", "-o", f"{name}-times", "-j", "1")
        assert done.returncode == 0, done.stderr
        if name == "first":
            words = ("baseline", "save", "first-times", "-o", "t.json", "--times")
            assert execute(folder, "sysid_bench", *words).returncode == 0
        words = ("gate", f"{name}-times", "--baseline", "t.json", "--times", "--json")
        done = execute(folder, "sysid_bench", *words)
        speeds = json.loads(done.stdout)["speeds"]
        slower = {entry["part"] for entry in speeds if entry["verdict"] == "slower"}
        verdicts[name] = done.returncode, slower
    assert verdicts == {"first": (0, set()), "slow": (1, {"kernel"})}


def many_repeats(suite: str) -> str:
    """A suite of `small_suite` with noise alone and ten repeats: load only adds to times, and the
    least of ten is near the time without it."""
    return suite.replace("repeats = 2", "repeats = 10").replace("{}, ", "")


REPEATING = """
from dataclasses import dataclass
import numpy as np
from sysid_bench.types import Estimate

@dataclass(frozen=True)
class Fit:
    def solve(self, problem):
        for _ in range({count}):
            beta = np.linalg.lstsq(problem.W, problem.b, rcond=None)[0]
        return Estimate(beta)
"""
"""Work, not seconds: a machine that slows down slows it as it does the other parts."""


@pytest.mark.long
def test_a_method_that_is_twice_as_slow_is_named(tmp_path: Path) -> None:
    """CPU times as ratios within one run, so that the load of the machine does not matter."""
    suite = small_suite(("scara", "ur5"), estimators=("ols", "wls", "file:fit.py:Fit"))
    (tmp_path / "t.toml").write_text(many_repeats(suite))
    verdicts = {}
    for name, count in (("first", 60), ("again", 60), ("slow", 120)):
        (tmp_path / "fit.py").write_text(REPEATING.format(count=count))
        sysid_bench.run(tmp_path / "t.toml", tmp_path / name, jobs=1)
        if name == "first":
            sysid_bench.baseline_save(tmp_path / name, tmp_path / "b.json", times=True)
        answer = sysid_bench.gate(tmp_path / name, tmp_path / "b.json", times=True)
        slower = {entry["part"] for entry in answer.speeds if entry["verdict"] == "slower"}
        verdicts[name] = answer.ok, slower
    assert verdicts == {"first": (True, set()), "again": (True, set()), "slow": (False, {"Fit"})}
