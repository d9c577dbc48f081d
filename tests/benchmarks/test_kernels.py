"""The regressor itself: both kernels against the memory's limit, Pinocchio and other peers."""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.instruction_sets import VARIABLE, usable_levels
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_c import KernelSelection, layout_of, select_kernel
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array, Trajectory
from tests.benchmarks import peers
from tests.robots import named_robot, relative_gap, states, urdf_robot

Compare = Callable[..., dict[str, float]]
Line = Callable[..., None]

LOOP = Path(__file__).parents[2] / ".benchmarks"
ROBOTS = {
    "xarm7": lambda: named_robot("xarm7"),
    "ur5": lambda: named_robot("ur5"),
    "talos": lambda: urdf_robot("talos_data/robots/talos_reduced.urdf", free_base=True),
    "icub": lambda: urdf_robot("icub_description/robots/icub.urdf", free_base=True),
}
HUMANOIDS = ("talos", "icub")


class Subject:
    """A robot, a motion that fills more than the caches, and both kernels' ways to Y."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.humanoid = name in HUMANOIDS
        self.robot: RobotModel = ROBOTS[name]()
        self.motion: Trajectory = states(self.robot, 3000 if self.humanoid else 20000)
        self.names = peers.own_columns(self.robot)
        self.Y: Array = np.empty((len(self.motion), self.robot.nv, len(self.names)))
        self._columns: dict[KernelSelection, Regression] = {}

    @property
    def columns(self) -> Regression:
        """The regressor; it stays with the kernel that it met first, so each has its own."""
        if select_kernel() not in self._columns:
            self._columns[select_kernel()] = regression(self.robot, self.names)
        return self._columns[select_kernel()]

    def dense(self) -> None:
        """Y with its zeros, by the kernel of this process."""
        self.columns.dense(self.motion, self.Y)

    def rows(self) -> None:
        """Y without its zeros, block by block, as a fold sees it."""
        for block in self.columns.blocks(self.motion):
            del block

    def few(self, count: int) -> Trajectory:
        """A part of the motion, for slow peers."""
        m = self.motion
        return Trajectory(m.t[:count], m.q[:count], m.v[:count], m.a[:count])

    @property
    def kind(self) -> str:
        return "humanoid" if self.humanoid else "arm"


@pytest.fixture(scope="module", params=ROBOTS)
def subject(request: pytest.FixtureRequest) -> Subject:
    return Subject(request.param)


@pytest.fixture(params=["numpy", "compiled"])
def kernel(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Each kernel in turn the one of this process."""
    monkeypatch.setenv(VARIABLE, request.param)
    select_kernel.cache_clear()
    if request.param == "compiled" and select_kernel().library is None:
        reason = select_kernel().reason
        monkeypatch.undo()
        select_kernel.cache_clear()
        pytest.skip(reason)
    yield request.param
    monkeypatch.undo()
    select_kernel.cache_clear()


def test_against_memory(subject: Subject, compare: Compare, line: Line) -> None:
    """The same bytes, written and nothing else."""
    if select_kernel().library is None:
        pytest.skip(select_kernel().reason)
    memset = ctypes.CDLL(None).memset
    where, size = ctypes.c_void_p(subject.Y.ctypes.data), ctypes.c_size_t(subject.Y.nbytes)
    # Not zeros: processors have a way of their own for those, which is no measure of memory.
    seconds = compare({"memset": lambda: memset(where, 1, size), "dense": subject.dense}, 31)
    must, aim = (1.6, 1.3) if subject.humanoid else (2.5, 2.0)
    name, dense = f"{subject.name} ({subject.kind})", seconds["dense"]
    line(
        f"C kernel, dense / memset of the same bytes, {name}", dense / seconds["memset"], must, aim
    )


def test_against_pinocchio(subject: Subject, kernel: str, compare: Compare, line: Line) -> None:
    in_cpp = peers.pinocchio_in_cpp(subject.robot, subject.motion, LOOP)
    seconds = compare(
        {
            "dense": subject.dense,
            "rows": subject.rows,
            "C++": in_cpp,
            "Python": peers.pinocchio_in_python(subject.robot, subject.motion),
        },
        7,
    )
    same = [c for c in range(subject.Y.shape[2]) if c % 10 < 4]  # in both: mass and first moments
    if not subject.humanoid:  # a free base is turned between the two
        subject.dense()
        assert relative_gap(subject.Y[..., same], in_cpp()[..., same]) < 1e-11
    name, dense, rows = f"{subject.name} ({subject.kind})", seconds["dense"], seconds["rows"]
    if kernel == "numpy":
        line(
            f"NumPy kernel, dense / Pinocchio's C++ loop, {name}", dense / seconds["C++"], 1.3, 1.0
        )
        line(f"NumPy kernel, rows / Pinocchio's C++ loop, {name}", rows / seconds["C++"], 1.3, 1.0)
        return
    must, aim = (3.5, 5.0) if subject.humanoid else (5.0, 8.0)
    line(f"Pinocchio's C++ loop / C kernel, dense, {name}", seconds["C++"] / dense, must, aim, True)
    line(f"Pinocchio's C++ loop / C kernel, rows, {name}", seconds["C++"] / rows)
    line(f"Pinocchio from Python / C kernel, dense, {name}", seconds["Python"] / dense)


def test_one_sample_a_call(subject: Subject, compare: Compare, line: Line) -> None:
    """As an online estimator calls it: one sample through Python, arguments bound once."""
    if select_kernel().library is None:
        pytest.skip(select_kernel().reason)
    few = subject.few(200)
    sample, samples = subject.columns.sample(), list(zip(few.q, few.v, few.a, strict=True))

    def ours() -> None:
        for q, v, a in samples:
            sample(q, v, a)

    peer = peers.pinocchio_in_python(subject.robot, few)
    seconds = compare({"ours": ours, "Pinocchio": peer}, 15)
    name = f"{subject.name} ({subject.kind})"
    line(f"one sample through Python, {name}", seconds["ours"] / len(few) * 1e6, 5, 5, unit="µs")
    ratio = seconds["Pinocchio"] / seconds["ours"]
    line(f"Pinocchio from Python / one sample through Python, {name}", ratio, 1, 2, True)


@pytest.mark.parametrize(
    ("peer", "arm", "humanoid"),
    [("idyntree", 100, 20), ("per_sample_mujoco", 300, 130), ("figaroh", 20, None)],
)
def test_against_others(
    subject: Subject, peer: str, arm: float, humanoid: float | None, compare: Compare, line: Line
) -> None:
    if humanoid is None and subject.humanoid:
        pytest.skip(f"{peer} takes one degree of freedom per body, and no free base")
    if select_kernel().library is None:
        pytest.skip(select_kernel().reason)
    count = 100 if subject.humanoid else 500
    run = getattr(peers, peer)(subject.robot, subject.few(count))
    seconds = compare({"peer": run, "ours": subject.dense}, 3)
    if peer == "per_sample_mujoco":
        assert relative_gap(run(), subject.columns.dense(subject.few(count)).Y) < 1e-9
    ratio = seconds["peer"] / count / (seconds["ours"] / len(subject.motion))
    must = humanoid if subject.humanoid else arm
    line(f"{peer} / C kernel, {subject.name} ({subject.kind})", ratio, must, None, True)


def test_instruction_sets(subject: Subject, compare: Compare, line: Line) -> None:
    from sysid_bench.regressors import kernel_c as compiled

    if select_kernel().library is None:
        pytest.skip(select_kernel().reason)
    dll = select_kernel().library.dll  # type: ignore[union-attr]
    levels = usable_levels(dll)
    program = layout_of(subject.columns)
    functions = {
        level: lambda level=level: compiled.Library(dll, level).dense(
            program, subject.motion, subject.Y
        )
        for level in levels
    }
    seconds = compare(functions, 5)
    for level in levels[1:]:
        line(
            f"C kernel, {level} / {levels[0]}, {subject.name}", seconds[level] / seconds[levels[0]]
        )
