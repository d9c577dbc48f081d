"""Verb `online`: a payload from a stream of samples; streams that are none."""

import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import Payload
from sysid_bench.regressors.regression import regression
from sysid_bench.signals import stream
from sysid_bench.types import Array, Trajectory

LOAD = Payload("load", 1.5, (0.02, -0.03, 0.08), (4e-3, 5e-3, 6e-3, 0.0, 0.0, 0.0))
FRICTION = (2.0, 0.7, 0.3)
"""Viscous and Coulomb friction and offset of each joint, N m s, N m, N m."""


def recorded(name: str, seed: int, seconds: float, rate: float) -> tuple[Array, Array, Array]:
    """t, q and tau of a robot with the load, with errors of encoders and torques."""
    robot, rng = load_robot(name, LOAD), np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / rate)
    q, v, a = np.zeros((3, len(t), robot.nv))
    for j in range(robot.nv):
        for w in 2 * np.pi * rng.uniform(0.1, 0.7, 4):
            size, phase = rng.uniform(0.1, 0.5) / max(w, 1.0), rng.uniform(0, 6)
            q[:, j] += size * np.sin(w * t + phase)
            v[:, j] += size * w * np.cos(w * t + phase)
            a[:, j] -= size * w**2 * np.sin(w * t + phase)
    columns = regression(robot, robot.inertial_columns)
    tau = columns.torque(Trajectory(t, q, v, a), robot.phi.ravel())
    tau += np.column_stack([FRICTION[0] * v + FRICTION[1] * np.sign(v) + FRICTION[2]])
    tau += robot.joint_terms.armature * a + 0.2 * rng.normal(size=v.shape)
    return t, q + 1e-6 * rng.normal(size=q.shape), tau


def csv(rows: tuple[str, ...], t: Array, q: Array, tau: Array) -> str:
    names = ["t", *(f"{row}.{x}" for x in ("q", "tau") for row in rows)]
    table = np.column_stack([t, q, tau])
    return "\n".join([",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in table), ""])


def json_lines(t: Array, q: Array, tau: Array) -> str:
    rows = zip(t.tolist(), q.tolist(), tau.tolist(), strict=True)
    return "".join(json.dumps({"t": x, "q": y, "tau": z}) + "\n" for x, y, z in rows)


@pytest.mark.parametrize(("name", "seed"), [("ur5", 0), ("xarm7", 1), ("z1", 2)])
def test_the_payload_and_the_friction_lie_within_their_deviations(
    name: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "IDLE", 0.1)
    file = tmp_path / "run.csv"
    file.write_text(csv(load_robot(name).rows, *recorded(name, seed, 12.0, 500.0)))
    seen: list[sysid_bench.OnlineResult] = []
    found = sysid_bench.online(name, str(file), report=seen.append)
    assert len(seen) == 12
    assert found.mass_std < 0.1
    assert abs(found.mass - LOAD.mass) < 4 * found.mass_std
    for x, true, std in zip(found.com, LOAD.com, found.com_std, strict=True):
        assert abs(x - true) < 4 * std
    terms = [terms[term] for terms in found.joints.values() for term in ("fv", "fc", "offset")]
    away = [(x - true) / s for (x, s), true in zip(terms, FRICTION * 9, strict=False)]
    assert np.abs(away).max() < 4.5
    assert np.sqrt(np.mean(np.square(away))) < 1.8
    # Deviations shrink as samples come in.
    assert seen[0].mass_std > seen[3].mass_std > found.mass_std


@pytest.mark.long
def test_deviations_are_those_of_the_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over thirty motions, with noise that is white: 95 % lie within 1.96 of them."""
    monkeypatch.setattr(stream, "IDLE", 0.05)
    file, away = tmp_path / "s.jsonl", list[float]()
    for seed in range(30):
        file.write_text(json_lines(*recorded("ur5", 100 + seed, 20, 250)))
        found = sysid_bench.online("ur5", str(file))
        away += [(found.mass - LOAD.mass) / found.mass_std]
        away += [
            (x - true) / std
            for x, true, std in zip(found.com, LOAD.com, found.com_std, strict=True)
        ]
        for terms in found.joints.values():
            for (x, std), true in zip(terms.values(), FRICTION, strict=True):
                away.append((x - true) / std)
    assert 0.92 < np.mean(np.abs(away) < 1.96) < 0.99
    assert 0.8 < np.sqrt(np.mean(np.square(away))) < 1.1


def test_a_shell_reads_standard_input_and_prints_lines_of_json() -> None:
    text = json_lines(*recorded("ur5", 3, 4.0, 200.0))
    command = [sys.executable, "-m", "sysid_bench", "online", "ur5", "-"]
    done = subprocess.run(command, input=text, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == 5
    assert lines[-1]["mass"] == pytest.approx(LOAD.mass, abs=4 * lines[-1]["mass_std"])
    result = sysid_bench.OnlineResult(**{key: lines[-1][key] for key in lines[-1]})
    assert result.summary().count(" kg ") == 1
    assert "shoulder_pan_joint fv " in result.summary()
    silent = subprocess.run(command, input="", capture_output=True, text=True)
    assert silent.returncode == 4


def test_a_socket_and_a_file_that_grows_are_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "IDLE", 0.3)
    lines = json_lines(*recorded("ur5", 4, 2.0, 200.0)).splitlines(keepends=True)
    expected = [json.loads(line)["t"] for line in lines]
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = server.accept()
        with connection:
            for line in lines:
                connection.sendall(line.encode())

    threading.Thread(target=serve).start()
    address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    assert [t for t, _, _ in stream.stream_samples(address, SIX)] == expected
    server.close()
    with pytest.raises(UsageError, match=address):
        list(stream.stream_samples(address, SIX))
    file = tmp_path / "grows.jsonl"
    file.touch()

    def write() -> None:
        with file.open("a") as out:
            for k, line in enumerate(lines):
                out.write(line[:20])
                if k % 100 == 0:
                    out.flush()
                    time.sleep(0.05)
                out.write(line[20:])

    threading.Thread(target=write).start()
    assert [t for t, _, _ in stream.stream_samples(str(file), SIX)] == expected


SIX = "abcdef"
GOOD = '{"t": 0.1, "q": [0, 0], "tau": [0, 0]}\n'
BAD = {
    "falls": GOOD + GOOD,
    "not finite": GOOD.replace("[0, 0]}", "[0, NaN]}"),
    "is cut": GOOD + GOOD[:12],
    "is not a sample": GOOD + "\n",
    "'tau'": '{"t": 0.1, "q": [0, 0]}\n',
    "4 numbers": GOOD.replace("[0, 0]}", "[0]}"),
    "no column b.tau": "t,a.q,b.q,a.tau\n0,0,0,0\n",
    "could not convert": "t,a.q,b.q,a.tau,b.tau\n0,0,x,0,0\n",
    "65536 bytes or more": GOOD + "[" * 200_000 + "\n",
    "has 65536 bytes": GOOD + GOOD[:-2] + " " * 100_000,
    "index out of range": "t,a.q,b.q,a.tau,b.tau\n0,0,0\n",
}


@pytest.mark.parametrize("words", BAD)
def test_a_line_that_is_no_sample_is_named(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "IDLE", 0.05)
    file = tmp_path / "bad.txt"
    file.write_text(BAD[words])
    with pytest.raises(UsageError, match=f"Line [123] of .*{words}"):
        list(stream.stream_samples(str(file), "ab"))


def test_a_stream_without_a_window_has_no_centre(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "IDLE", 0.05)
    file = tmp_path / "short.jsonl"
    for text in ("", json.dumps({"t": 0, "q": [0] * 6, "tau": [0] * 6}) + "\n"):
        file.write_text(text)
        found = sysid_bench.online("ur5", str(file))
        assert (found.samples, found.mass) == (0, 0.0)
        assert np.isnan([*found.com, *found.com_std]).all()
        assert "nothing is estimated" in found.summary()


@pytest.mark.parametrize("source", ["no/such/file", "ros2:/joint_states", "tcp://nowhere"])
def test_a_stream_that_is_not_there_is_an_error(source: str) -> None:
    with pytest.raises(UsageError, match=source):
        list(stream.stream_samples(source, "ab"))


@pytest.mark.long
def test_seven_joints_at_1_khz_take_a_tenth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "IDLE", 0.05)
    file = tmp_path / "run.csv"
    file.write_text(csv(load_robot("xarm7").rows, *recorded("xarm7", 1, 20.0, 1000.0)))
    start = time.process_time()
    sysid_bench.online("xarm7", str(file), report=lambda result: None)
    seconds = time.process_time() - start
    print(f"CPU time / time of the stream: {seconds / 20.0:.3f}")
    assert seconds < 0.1 * 20.0
