"""Laws of the log importer: whatever the file looks like, the same signals come out; what is wrong
is counted, and what cannot be is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log
from sysid_bench.signals.log_checks import check_findings
from tests.closeness import assert_close
from tests.robots import named_robot

from .logs import RATE, Recorded, World, recorded

SLIDER = """<mujoco><worldbody><body><joint name="turn" axis="0 0 1"/><geom size=".1" mass="1"/>
<body pos="0 .2 0"><joint name="slide" type="slide" axis="1 0 0" range="-.3 .3" limited="true"/>
<geom size=".1" mass="2"/><body pos="0 0 .3"><joint name="tip" axis="0 1 0"/>
<geom pos=".1 0 0" size=".05" mass=".5"/></body></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    file = tmp_path_factory.mktemp("slider") / "slider.xml"
    file.write_text(SLIDER)
    return load_robot(file)


@pytest.fixture(scope="module")
def log(robot: RobotModel) -> Recorded:
    return recorded(robot)


@pytest.fixture
def world(robot: RobotModel, tmp_path: Path) -> World:
    return World(robot, tmp_path)


def found(got: Log) -> dict[str, int]:
    return {finding.name: finding.count for finding in got.findings}


def refused(got: Log, accepted: tuple[str, ...] = ()) -> str:
    with pytest.raises(UsageError) as error:
        check_findings(got.findings, accepted, "run.toml")
    return str(error.value)


@pytest.mark.parametrize("kind", ["csv", "csv bare", "csv ;", "txt", "npz", "mat", "parquet"])
@pytest.mark.parametrize("timed", [False, True])
def test_every_format_gives_the_same_signals(
    world: World, kind: str, timed: bool, log: Recorded
) -> None:
    time = 1 if kind in ("csv", "csv bare", "csv ;", "txt") else "t"
    changed: dict[str, Any] = {"time": time, "rate": None} if timed else {}
    got = world.read(log, kind, **changed)
    world.same(got, log)
    assert got.findings == ()
    assert got.measured_rate == pytest.approx(RATE, rel=0.01)


def test_columns_may_be_named_in_any_order(world: World, log: Recorded) -> None:
    q = {"columns": ["q_tip", " q_turn ", "q_slide"]}
    v = {"columns": [7, 5, 6]}
    tau = {"columns": ["tau_tip", "tau_turn", "tau_slide"]}
    joints = ["tip", "turn", "slide"]
    world.same(world.read(log, q=q, v=v, tau=tau, joints=joints), log)


def test_units_gains_ratios_and_offsets(world: World, log: Recorded) -> None:
    ratio = np.array([100.0, 1.0, -48.0])
    kt = np.array([0.07, 2.5, 0.05])
    degrees = np.array([180 / np.pi, 1e3, 180 / np.pi])
    zero = np.array([0.3, -0.1, 1.0])
    motor = replace(
        log,
        q=(log.q - zero) * ratio * degrees,
        v=log.v * ratio * degrees,
        tau=log.tau / ratio / kt * 1e3,
    )
    got = world.read(
        motor,
        q={"unit": ["deg", "mm", "deg"], "ratio": ratio.tolist(), "offset": zero.tolist()},
        v={"unit": ["deg/s", "mm/s", "deg/s"], "ratio": ratio.tolist()},
        tau={"unit": "mA", "gain": kt.tolist(), "ratio": ratio.tolist()},
    )
    world.same(got, log)


@pytest.mark.parametrize("ratio", [1.0, -8.0])
def test_turns_of_an_encoder_are_added_again(world: World, log: Recorded, ratio: float) -> None:
    """Of hinges; a slide stays as it is."""
    shown = log.q * ratio
    shown[:, ::2] %= 2 * np.pi
    q = {"unwrap": True, "ratio": ratio, "offset": 0.5}
    got = world.read(replace(log, q=shown), v=None, q=q).recording.q - 0.5
    turns = (got[:, [joint.qadr for joint in world.robot.joints]] - log.q) * ratio / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[:1]) * np.ones(turns.shape), atol=1e-9)
    np.testing.assert_allclose(turns[:, 1], 0.0, atol=1e-9)


def test_a_transmission_keeps_the_power(world: World, log: Recorded) -> None:
    G = np.array([[0.5, 0.0, 0.0], [-0.2, 1.0, 0.3], [0.1, 0.4, -2.0]])
    motor = replace(
        log,
        q=np.linalg.solve(G, log.q.T).T,
        v=np.linalg.solve(G, log.v.T).T,
        tau=log.tau @ G,  # tau_motor = G' tau
    )
    assert_close((motor.tau * motor.v).sum(axis=1), (log.tau * log.v).sum(axis=1))
    world.same(world.read(motor, transmission=G.tolist()), log)


def test_a_coordinate_that_is_no_joint_is_left_out(world: World, log: Recorded) -> None:
    extra = np.sin(log.t)[:, None]
    wide = Recorded(
        (*log.joints, "jaw"),
        log.t,
        np.hstack([log.q, extra]),
        np.hstack([log.v, np.cos(log.t)[:, None]]),
        np.hstack([log.tau, extra]),
    )
    path = world.write(wide, joints=[*log.joints, "-"])
    world.same(world.read_file(path), log)
    with pytest.raises(UsageError, match="jaw"):
        world.read(wide, name="named")


def test_a_flat_list_of_numbers_is_folded(world: World, log: Recorded, tmp_path: Path) -> None:
    for name, x in (("q", log.q), ("v", log.v), ("tau", log.tau)):
        np.savetxt(tmp_path / f"{name}.txt", x.ravel(), fmt="%.17g")
    np.savetxt(tmp_path / "t.txt", log.t * 1e3, fmt="%.17g")
    signals: dict[str, Any] = {
        name: {"file": f"{name}.txt", "per_row": 3, "columns": [1, 2, 3]}
        for name in ("q", "v", "tau")
    }
    time = {"file": "t.txt", "column": 1, "unit": "ms"}
    world.same(world.read(log, rate=None, time=time, file=None, **signals), log)


def test_rows_are_counted_from_one(world: World, log: Recorded) -> None:
    got = world.read(log, rows=[11, 210])
    part = Recorded(log.joints, log.t[10:210], log.q[10:210], log.v[10:210], log.tau[10:210])
    world.same(got, part)
    with pytest.raises(UsageError, match="there are 800 samples"):
        world.read(log, rows=[1, 10**6])


@pytest.mark.parametrize("factor", [0.25, 0.5, 0.9, 1.1, 2.0, 5.0])
def test_a_wrong_rate_is_refused_unless_accepted(
    world: World, factor: float, log: Recorded
) -> None:
    got = world.read(log, rate=f"{factor * RATE} Hz")
    assert got.measured_rate == pytest.approx(RATE, rel=0.02)
    assert "--accept rate" in refused(got)
    check_findings(got.findings, ("rate",), "")
    noisy = replace(log, v=log.v + np.random.default_rng(0).normal(size=log.v.shape) * log.v.std())
    got = world.read(noisy, rate=f"{factor * RATE} Hz", name="noisy")
    assert got.measured_rate == pytest.approx(RATE, rel=0.04)
    assert f"{factor * RATE:g} Hz" in refused(got)


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 1e3])
def test_stamps_against_a_declared_rate(world: World, factor: float, log: Recorded) -> None:
    got = world.read(replace(log, t=log.t * factor), time=1)
    assert "time stamps" in refused(got)


def test_a_velocity_in_other_units_or_of_another_joint_is_refused(
    world: World, log: Recorded
) -> None:
    reported = {
        "degrees": (log.v * 180 / np.pi, "rate"),
        "one": (log.v * np.array([1, 1, 57.3]), "velocity"),
        "sign": (log.v * np.array([1, 1, -1]), "velocity"),
    }
    for name, (v, finding) in reported.items():
        got = world.read(replace(log, v=v), name=name)
        assert finding in refused(got, ("units",)), name
        assert "'tip'" in refused(got) or name == "degrees"


def test_exchanged_columns_are_refused(world: World, log: Recorded) -> None:
    swapped = replace(log, v=log.v[:, [1, 0, 2]])
    reported = refused(world.read(swapped))
    assert f"{log.joints[0]!r} moves as v of joint {log.joints[1]!r}" in reported


def test_positions_in_other_units_are_refused(world: World, log: Recorded) -> None:
    for name, q in (
        ("degrees", log.q * 180 / np.pi),
        ("millimetres", log.q * np.array([1, 1e3, 1])),
    ):
        got = world.read(replace(log, q=q), name=name, v=None)
        assert "--accept units" in refused(got)


def test_a_limit_is_reported_and_passes(world: World, log: Recorded) -> None:
    q = log.q + np.array([0.0, 0.2, 0.0])
    got = world.read(replace(log, q=q))
    assert found(got) == {"limits": int((q[:, 1] > 0.3).sum())}
    check_findings(got.findings, (), "")


def test_held_lost_and_empty_samples_are_counted(world: World, log: Recorded) -> None:
    rng = np.random.default_rng(3)
    at = np.sort(rng.choice(np.arange(20, 780, 10), 40, replace=False))
    held = replace(log, q=log.q.copy(), v=log.v.copy(), tau=log.tau.copy())
    for x in (held.q, held.v, held.tau):
        x[at] = x[at - 1]
    got = world.read(held, name="held")
    assert found(got) == {"held": 40}
    world.same(got, log, atol=0.02)  # bridged, not held: a held q is wrong by a step

    empty = replace(log, q=log.q.copy(), tau=log.tau.copy())
    empty.q[at[:10], 0], empty.tau[at[10:20], 1] = np.nan, 1e293
    got = world.read(empty, name="empty")
    assert found(got) == {"non-finite": 20}
    world.same(got, log, atol=0.02)

    kept = np.setdiff1d(np.arange(len(log.t)), at)
    fewer = Recorded(log.joints, log.t[kept], log.q[kept], log.v[kept], log.tau[kept])
    got = world.read(fewer, name="lost", time=1, rate=None)
    assert found(got) == {"lost": 40}
    world.same(got, log, atol=0.02)
    got = world.read(fewer, name="unstamped")
    quick = int(found(got)["lost"])
    assert 10 <= quick <= 40  # without stamps those of quick motion alone can be seen


def test_stamps_that_jitter_repeat_or_run_backwards(world: World, log: Recorded) -> None:
    rng = np.random.default_rng(0)
    jittered = replace(log, t=log.t + 0.2 / RATE * rng.uniform(-1, 1, len(log.t)))
    got = world.read(jittered, time=1, rate=f"{RATE} Hz")
    assert got.findings == ()
    t = log.t.copy()
    t[100], t[200] = t[99], t[150]
    got = world.read(replace(log, t=t), name="stale", time=1, rate=None)
    assert [f.count for f in got.findings if f.name == "time"] == [1, 1]
    world.same(got, log, atol=0.02)
    t = log.t.copy()
    t[:300] -= 1e9
    with pytest.raises(UsageError, match=r"gap of 1e\+09 s"):
        world.read(replace(log, t=t), name="gap", time=1, rate=None)
    backwards = replace(log, t=log.t[::-1].copy())
    with pytest.raises(UsageError, match="fall: write the rows in the order of time"):
        world.read(backwards, name="backwards", time=1, rate=None)


def test_a_line_that_broke_off_is_reported_a_wrong_one_refused(
    world: World, log: Recorded, tmp_path: Path
) -> None:
    path = world.write(log)
    file = tmp_path / "run.csv"
    text = file.read_text()
    file.write_text(text + "4.0,1.0,0.")
    got = world.read_file(path)
    assert found(got) == {"non-finite": 1}
    world.same(got, log)
    lines = text.splitlines()
    lines[41] = lines[41].replace(",", ",x", 1)
    file.write_text("\n".join(lines))
    with pytest.raises(UsageError, match=r"line 42, column 2: 'x.*' is not a number"):
        world.read_file(path)
    lines[41] = "1.0,2.0"
    file.write_text("\n".join(lines))
    with pytest.raises(UsageError, match="line 42 has 2 columns"):
        world.read_file(path)


@pytest.mark.parametrize("quote", ['"', ""])
@pytest.mark.parametrize("delimiter", [",", ";"])
def test_lists_in_cells_are_arrays_and_words_are_skipped(
    world: World, quote: str, delimiter: str, log: Recorded, tmp_path: Path
) -> None:
    def cell(x: np.ndarray) -> str:
        return f"{quote}{x.tolist()}{quote}"

    lines = [delimiter.join(["type", "stamp", "positions", "velocities", "torques"])]
    for t, *signals in zip(log.t, log.q, log.v, log.tau, strict=True):
        lines.append(delimiter.join(["STATE", str(t * 1e6), *map(cell, signals)]))
    text = "\n".join(lines)
    (tmp_path / "run.csv").write_text(text)
    names = {"q": "positions", "v": "velocities", "tau": "torques"}
    parts: dict[str, Any] = {s: {"columns": name} for s, name in names.items()}
    time = {"column": "stamp", "unit": "us"}
    path = world.write(log, name="lists", file="run.csv", rate=None, time=time, **parts)
    world.same(world.read_file(path), log)
    (tmp_path / "run.csv").write_text(text[:-30])  # inside of the last list
    assert found(world.read_file(path)) == {"non-finite": 1}
    lines[41] = lines[41].replace("[", "[x", 1)
    (tmp_path / "run.csv").write_text("\n".join(lines))
    with pytest.raises(UsageError, match=r"line 42, column 3: 'x.*' is not a number"):
        world.read_file(path)


@pytest.mark.parametrize("kept", range(5))
def test_a_number_that_broke_off_costs_its_line(
    world: World, kept: int, log: Recorded, tmp_path: Path
) -> None:
    columns = np.column_stack([log.t, log.q, log.v, log.tau])
    path = world.write(log, "csv bare")
    np.savetxt(tmp_path / "run.csv", columns, delimiter=",", fmt="%.6f")
    text = (tmp_path / "run.csv").read_text()
    (tmp_path / "run.csv").write_text(text[: len(text) - 7 + kept])
    got = world.read_file(path)
    assert found(got)["non-finite"] == 1
    assert got.samples == len(log.t) - 1


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"rate": None}, "neither rate nor time"),
    ({"rate": "-3 Hz"}, "positive"),
    ({"rate": "3 parsec"}, "parsec"),
    ({"joints": ["turn", "slide", "tpi"]}, "'tip'"),
    ({"joints": ["turn", "slide", "slide"]}, "more than once"),
    ({"joints": ["turn", "slide"]}, "for 2 joints"),
    ({"q": {"columns": ["q_turn", "q_slide", "q_tpi"]}}, "'q_tip'"),
    ({"q": {"columns": [1, 2, 99]}}, "no column 99"),
    ({"q": {"columns": [0, 1, 2]}}, "counted from 1"),
    ({"q": {"unit": "furlong"}}, "furlong"),
    ({"q": {"unit": "rad"}}, "slides"),
    ({"tau": {"unit": "A"}}, "gain"),
    ({"tau": {"gain": [1, 2]}}, "2 numbers"),
    ({"tau": {"ratio": [1, 0, 1]}}, "not zero"),
    ({"tau": {"colums": [1]}}, "tau.columns"),
    ({"tau": None}, "tau is missing"),
    ({"transmission": [[1, 0], [0, 1]]}, "3 rows of 3"),
    ({"transmission": [[1, 0, 0], [0, 1, 0], [1, 1, 0]]}, "no inverse"),
    ({"file": "nowhere.csv"}, "nowhere.csv"),
    ({"file": "run.toml"}, ".parquet"),
    ({"rows": [5, 2]}, "first, last"),
    ({"frequency": "200 Hz"}, "frequency"),
    ({"time": {"column": 1, "unit": "year"}}, "year"),
]


@pytest.mark.parametrize(("changed", "reported"), WRONG, ids=[reported for _, reported in WRONG])
def test_what_cannot_be_is_said_in_a_sentence(
    world: World, changed: dict[str, Any], reported: str, log: Recorded
) -> None:
    with pytest.raises(UsageError) as error:
        world.read(log, **changed)
    assert reported in str(error.value)
    assert "run." in str(error.value) or reported == "nowhere.csv"


def test_words_of_accept() -> None:
    with pytest.raises(UsageError, match="'rate'"):
        check_findings((), ("rtae",), "")


@pytest.mark.data
def test_real_recordings_agree_with_their_rate(data_folder: Path, tmp_path: Path) -> None:
    """The dVRK recorder's 200 Hz, and a declared rate that is none."""
    arm = named_robot("kinova")
    joints = list(arm.rows)
    for rate, right in ((200.0, True), (100.0, False), (400.0, False)):
        text = (
            f"file = '{data_folder / 'dvrk' / 'mtm_train.csv'}'\nrate = '{rate} Hz'\n"
            f"joints = {joints[:1] + ['-'] * 6}\n"
            "q = { columns = [1, 2, 3, 4, 5, 6, 7] }\n"
            "v = { columns = [8, 9, 10, 11, 12, 13, 14] }\n"
            "tau = { columns = [15, 16, 17, 18, 19, 20, 21] }\n"
        )
        path = tmp_path / f"{rate}.toml"
        path.write_text(text)
        got = World(arm, tmp_path).read_file(path)
        assert got.measured_rate == pytest.approx(200.0, rel=0.02)
        assert ("rate" in {f.name for f in got.findings if f.contradiction}) != right
