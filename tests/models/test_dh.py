"""Laws of Denavit-Hartenberg tables: the robot stands where the product of the transforms says, in
either convention, and its torques do not depend on where parameters are taken."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sysid_bench.commands.init_robot import init_robot
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.experiments.tasks.task import unknown_bodies
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.dh_robot import mjcf_of
from sysid_bench.models.dh_table import DhTable, read_expression, read_table
from sysid_bench.models.load import load_robot
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Array
from tests.closeness import subspace_distance
from tests.robots import robot_of, states

HEAD = "link,joint,prev,a,alpha,d,theta,mass,com,size\n"
BOX = "1.5,0.01 -0.02 0.03,0.05 0.08 0.1"


def random_table(seed: int, folder: Path, tree: bool = True) -> Path:
    """Six rows, turning and sliding, with a branch, a fixed frame and one that follows two."""
    rng = np.random.default_rng(seed)
    lines: list[str] = []
    moving: list[str] = []
    for i in range(1, 7):
        a, d = rng.uniform(-0.3, 0.3, 2)
        alpha, theta = rng.choice(["0", "pi/2", "-pi/2", "0.3", "-40*deg"], 2)
        kind = rng.choice(["R", "R", "P"]) if i != 3 or not tree else "F"
        before = i - 1 if i != 5 or not tree else 2
        prev = "base" if i == 1 else str(before)
        own = f"q{i}"
        if i == 6 and tree:
            own = f"0.5*{moving[0]} - 2*{moving[1]}"
        if kind != "F":
            moving.append(f"q{i}")
        angle = f"{own} + {theta}" if kind == "R" else theta
        length = f"{own} + {d:.3f}" if kind == "P" else f"{d:.3f}"
        lines.append(f"{i},{kind},{prev},{a:.3f},{alpha},{length},{angle},{BOX}\n")
    path = folder / f"table{seed}.csv"
    path.write_text(HEAD + "".join(lines))
    return path


def _R(axis: int, angle: float) -> Array:
    T = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    T[i, i] = T[j, j] = c
    T[i, j], T[j, i] = (-s, s) if axis != 1 else (s, -s)
    return T


def _shift(axis: int, by: float) -> Array:
    T = np.eye(4)
    T[axis, 3] = by
    return T


def frames_of(table: DhTable, q: dict[str, float], modified: bool) -> dict[str, Array]:
    """DH frames (4, 4) in the base by the textbook's products."""
    out: dict[str, Array] = {}
    for row in table.rows:
        theta = row.theta.constant + sum(c * q[n] for n, c in row.theta.coefficients.items())
        d = row.d.constant + sum(c * q[n] for n, c in row.d.coefficients.items())
        turn, bend = _R(2, theta) @ _shift(2, d), _shift(0, row.a) @ _R(0, row.alpha)
        before = np.eye(4) if row.prev is None else out[row.prev]
        out[row.link] = before @ (bend @ turn if modified else turn @ bend)
    return out


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("modified", [False, True])
def test_links_stand_where_the_products_say(seed: int, modified: bool, tmp_path: Path) -> None:
    table = read_table(random_table(seed, tmp_path))
    for frames in ("link", "joint"):
        convention = "modified" if modified else "standard"
        robot = robot_of(mjcf_of(table, "r", convention, frames))  # type: ignore[arg-type]
        motion = states(robot, 5, seed)
        data = mujoco.MjData(robot.mj)
        for sample in motion.q:
            q = {f"q{j.name[1:]}": float(sample[j.qadr]) for j in robot.joints}
            wanted = frames_of(table, q, modified)
            data.qpos[:] = sample
            mujoco.mj_forward(robot.mj, data)
            for row in table.rows:
                if row.kind == "F":
                    continue
                body = data.body(f"link{row.link}")
                T = wanted[row.link]
                np.testing.assert_allclose(body.xmat.reshape(3, 3), T[:3, :3], atol=1e-12)
                at_joint = frames == "joint" and row.kind == "R" and not modified
                before = np.eye(4) if row.prev is None else wanted[row.prev]
                origin = before[:3, 3] if at_joint else T[:3, 3]
                np.testing.assert_allclose(body.xpos, origin, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_torques_do_not_depend_on_where_parameters_are_taken(seed: int, tmp_path: Path) -> None:
    table = read_table(random_table(seed, tmp_path))
    one, other = (
        robot_of(mjcf_of(table, "r", "standard", frames, base=(0.3, -0.8, 2.0)))
        for frames in ("joint", "link")
    )
    assert one.torque_rows == other.torque_rows
    assert one.coupling is not None
    motion = states(one, 10, seed)
    tau = [
        Inverse().run(plant_of(r), motion, np.zeros((10, len(r.torque_rows))))[0].tau
        for r in (one, other)
    ]
    np.testing.assert_allclose(tau[0], tau[1], rtol=0, atol=1e-10 * np.abs(tau[0]).max())


def test_the_folder_that_init_writes_is_a_robot(tmp_path: Path) -> None:
    answer = init_robot(random_table(1, tmp_path), tmp_path / "new", "mine", massless=["5"])
    robot = load_robot(tmp_path / "new" / "robot.toml")
    assert answer["joints"] == list(robot.torque_rows)
    assert answer["following"] == ["j6"]
    assert answer["warnings"] == []
    assert robot.manifest.massless == ("link5",)
    assert (tmp_path / "new" / "dh.csv").read_text() == (tmp_path / "table1.csv").read_text()
    with pytest.raises(UsageError, match="already holds a robot"):
        init_robot(tmp_path / "table1.csv", tmp_path / "new")


@pytest.mark.parametrize("name", ["dvrk_psm", "dvrk_mtm"])
def test_shipped_models_are_what_their_tables_give(name: str) -> None:
    robot = load_robot(name)
    dh, file = robot.manifest.dh, robot.manifest.manifest_file
    assert dh is not None
    assert file is not None
    table = read_table(file.parent / dh.table)
    massless = [body.removeprefix("link") for body in robot.manifest.massless]
    text = mjcf_of(table, name, dh.convention, dh.frames, dh.base, massless=massless)
    assert robot.manifest.path.read_text() == text


WRONG = [
    ("1,R,base,0,0,0,q1\n1,R,1,0,0,0,q1\n", "two links"),
    ("1,R,7,0,0,0,q1\n", "'7', which is not above"),
    ("1,S,base,0,0,0,q1\n", "R, P or F"),
    ("1,R,base,0,0,q1,q1\n", "column d"),
    ("1,R,base,0,0,0,q2\n2,R,1,0,0,0,q1\n", "follows"),
    ("1,R,base,0,0,0,2*q1\n", "plus a constant"),
    ("1,R,base,0,0,0,q1*q1\n", "not linear"),
    ("1,R,base,__import__('os'),0,0,q1\n", "column a"),
    ("1,R,base,1/0,0,0,q1\n", "column a"),
    ("1,R,base,(-1)**0.5,0,0,q1\n", "cannot be read"),
    ("1,R,base,b2,0,0,q1\n", "'b2'"),
    ("1',R,base,0,0,0,q1\n", "letters and digits"),
    ("1,R,base,0,0,0,q1,-2,0 0 0,1 1 1\n", "mass"),
    ("1,R,base,0,0,0,q1,1,0 0,1 1 1\n", "three numbers"),
    ("", "no rows"),
]


@pytest.mark.parametrize(("rows", "reported"), WRONG, ids=[reported for _, reported in WRONG])
def test_wrong_tables_are_one_sentence(rows: str, reported: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(HEAD + rows)
    with pytest.raises(SysidBenchError) as error:
        mjcf_of(read_table(path))
    assert reported in str(error.value)


def test_expressions() -> None:
    reported = read_expression(
        "-2*(a + 0.5)*q1 + q2/4 - a**2", {"a": 0.5}, frozenset({"q1", "q2"}), ""
    )
    assert (reported.constant, dict(reported.coefficients)) == (-0.25, {"q1": -2.0, "q2": 0.25})


@pytest.mark.parametrize(
    ("name", "base", "massless"),
    [("dvrk_psm", (0, -np.pi / 2, 0), ("4", "5", "6", "b1", "b2")), ("dvrk_mtm", (0, 0, 0), ())],
)
def test_closed_loops_follow_the_couplings_of_the_paper(
    name: str, base: tuple[float, float, float], massless: tuple[str, ...], tmp_path: Path
) -> None:
    """Fontanelli et al. (2017), eq. (3), and the constant couplings of the other arm, out of closed
    kinematic chains; the same base parameters are reported."""
    constant = load_robot(name)
    assert constant.manifest.manifest_file is not None
    table = constant.manifest.manifest_file.parent / "dh_loop.csv"
    init_robot(table, tmp_path / "loop", base=base, massless=massless)
    loop = load_robot(tmp_path / "loop" / "robot.toml")
    assert loop.torque_rows == constant.torque_rows
    assert loop.coupling is not None
    assert constant.coupling is not None
    motion = states(loop, 100)
    G = loop.coupling.G(motion.q)[:, [loop.rows.index(row) for row in constant.rows]]
    wanted = constant.coupling.G(constant.mj.qpos0[None])
    np.testing.assert_allclose(G, np.broadcast_to(wanted, G.shape), rtol=0, atol=1e-11)
    asked = [c for body in unknown_bodies(constant) for c in body.columns]
    one, other = (structural_base(robot, tuple(asked)) for robot in (loop, constant))
    assert one.rank == other.rank
    assert subspace_distance(one.K.T, other.K.T) < 1e-8
