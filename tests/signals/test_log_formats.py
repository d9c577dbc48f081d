"""Formats of recorders: each gives the numbers of its source bit for bit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from rosbags import rosbag1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sysid_bench import extras
from sysid_bench.apps.conformance.log_reader_checks import JOINT_STATE, WRITERS
from sysid_bench.commands.init_log import init_log
from sysid_bench.errors import UsageError
from sysid_bench.reporting.recording import record
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_reader import read_table, recorded_files
from sysid_bench.types import CellData, Trajectory
from tests.robots import named_robot
from tests.signals.logs import recorded

STORE = get_typestore(Stores.LATEST)


def joint_state(names: list[str], signals: dict[str, Any], stamp: int) -> bytes:
    """A message with the joints in this order; `signals` by joint."""
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    parts = [np.array([signals[name][k] for name in names]) for k in range(3)]
    message = types[JOINT_STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
        name=names,
        position=parts[0],
        velocity=parts[1],
        effort=parts[2],
    )
    return bytes(STORE.serialize_cdr(message, JOINT_STATE))


def write_bag(folder: Path, plugin: StoragePlugin, topics: dict[str, list[bytes]]) -> Path:
    with Writer(folder, version=9, storage_plugin=plugin) as bag:
        for topic, messages in topics.items():
            connection = bag.add_connection(topic, JOINT_STATE, typestore=STORE)
            for i, raw in enumerate(messages):
                bag.write(connection, 10**18 + 5_000_000 * i, raw)
    return folder


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("seed", range(3))
def test_joint_states_in_any_order_are_sorted_by_name(
    plugin: StoragePlugin, seed: int, tmp_path: Path
) -> None:
    rng = np.random.default_rng(seed)
    names = [f"j{k}" for k in range(4)]
    numbers = rng.normal(size=(50, 4, 3))
    messages = [
        joint_state(list(rng.permutation(names)), dict(zip(names, row, strict=True)), 5_000_000 * i)
        for i, row in enumerate(numbers)
    ]
    bag = write_bag(tmp_path / "bag", plugin, {"/joint_states": messages})
    inner = next(file for file in bag.iterdir() if file.suffix != ".yaml")
    for path in (bag, inner):
        table = read_table(path)
        for k, signal in enumerate(("position", "velocity", "effort")):
            np.testing.assert_array_equal(table.columns([signal]), numbers[:, :, k])
        np.testing.assert_array_equal(table.columns(["j2_effort"])[:, 0], numbers[:, 2, 2])
        np.testing.assert_array_equal(table.columns(["t"])[:, 0], np.arange(50) * 5_000_000 * 1e-9)
    assert set(recorded_files(bag)) == {*bag.iterdir()}


def test_bags_of_ros_1_are_read(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    types, numbers = store.types, np.random.default_rng(0).normal(size=(50, 3, 2))
    with rosbag1.Writer(tmp_path / "run.bag") as bag:
        topic = bag.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for i, (q, v, tau) in enumerate(numbers):
            header = types["std_msgs/msg/Header"](
                seq=i,
                stamp=types["builtin_interfaces/msg/Time"](
                    sec=i // 200, nanosec=i % 200 * 5_000_000
                ),
                frame_id="",
            )
            message = types[JOINT_STATE](
                header=header, name=["b", "a"], position=q, velocity=v, effort=tau
            )
            raw = store.serialize_ros1(message, JOINT_STATE)
            bag.write(topic, 10**18 + 5_000_000 * i, bytes(raw))
    table = read_table(tmp_path / "run.bag")
    for k, signal in enumerate(("position", "velocity", "effort")):
        np.testing.assert_array_equal(table.columns([signal]), numbers[:, k, ::-1])
    np.testing.assert_allclose(np.diff(table.columns(["t"])[:, 0]), 0.005, rtol=1e-9)


def write_mcap(file: Path, encoding: str, schema: tuple[str, bytes], messages: list[bytes]) -> None:
    """An MCAP file of a recorder that is not of ROS."""
    writer = pytest.importorskip("mcap.writer").Writer(str(file))
    writer.start(profile="", library="another")
    kind = writer.register_schema(schema[0], encoding, schema[1])
    channel = writer.register_channel("/arm", encoding, kind)
    for i, data in enumerate(messages):
        writer.add_message(channel, 10**18 + 5_000_000 * i, data, 10**18 + 5_000_000 * i)
    writer.finish()


@pytest.mark.parametrize("by_name", [True, False])
def test_messages_in_json_are_read(by_name: bool, tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).normal(size=(60, 2, 2))
    messages = []
    for q, tau in numbers.tolist():
        fields: dict[str, Any] = {"name": ["j2", "j1"], "position": q, "effort": tau}
        if not by_name:
            joints = zip(("j2", "j1"), q, tau, strict=True)
            fields = {"arm": [{"name": n, "position": x, "effort": y} for n, x, y in joints]}
        messages.append(json.dumps(fields).encode())
    write_mcap(tmp_path / "run.mcap", "json", ("Arm", b"{}"), messages)
    table = read_table(tmp_path / "run.mcap")
    column = "j2_effort" if by_name else "arm:j2.effort"
    np.testing.assert_array_equal(table.columns([column])[:, 0], numbers[:, 1, 0])
    np.testing.assert_allclose(np.diff(table.columns(["t"])[:, 0]), 0.005, rtol=1e-9)
    data = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(UsageError, match="MCAP file that can be read"):
        read_table(tmp_path / "cut.mcap")
    write_mcap(tmp_path / "other.mcap", "flatbuffer", ("Arm", b""), messages)
    with pytest.raises(UsageError, match="'flatbuffer'; json, protobuf"):
        read_table(tmp_path / "other.mcap")


def test_messages_in_protobuf_are_read_by_their_descriptors(tmp_path: Path) -> None:
    pb2 = pytest.importorskip("google.protobuf.descriptor_pb2")
    pool = pytest.importorskip("google.protobuf.descriptor_pool").DescriptorPool()
    factory = pytest.importorskip("google.protobuf.message_factory")
    inner = pb2.FileDescriptorProto(name="joint.proto", package="lab", syntax="proto3")
    joint = inner.message_type.add(name="Joint")
    joint.field.add(name="name", number=1, type=9, label=1)
    joint.field.add(name="position", number=2, type=1, label=1)
    outer = pb2.FileDescriptorProto(name="arm.proto", package="lab", syntax="proto3")
    outer.dependency.append("joint.proto")
    arm = outer.message_type.add(name="Arm")
    arm.field.add(name="joints", number=1, type=11, label=3, type_name=".lab.Joint")
    arm.field.add(name="torques", number=2, type=1, label=3)
    for part in (inner, outer):
        pool.AddSerializedFile(part.SerializeToString())
    kind = factory.GetMessageClass(pool.FindMessageTypeByName("lab.Arm"))
    numbers = np.random.default_rng(0).normal(size=(60, 2, 2))
    messages = []
    for q, tau in numbers.tolist():
        joints = [{"name": n, "position": x} for n, x in zip(("a", "b"), q, strict=True)]
        messages.append(kind(joints=joints, torques=tau).SerializeToString())
    schema = pb2.FileDescriptorSet(file=[outer, inner]).SerializeToString()
    write_mcap(tmp_path / "run.mcap", "protobuf", ("lab.Arm", schema), messages)
    table = read_table(tmp_path / "run.mcap")
    names = ["joints:a.position", "joints:b.position", "torques:1", "torques:2"]
    np.testing.assert_array_equal(table.columns(names), numbers.reshape(60, 4))


def test_topics_and_joints_that_are_not_clear_are_asked_for(tmp_path: Path) -> None:
    arm = {"a": (1.0, 2.0, 3.0)}
    both = {**arm, "gripper": (4.0, 5.0, 6.0)}
    one = [joint_state(["a"], arm, 0), joint_state(["gripper"], both, 0)]
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, {"/left": one, "/right": one[:1]})
    with pytest.raises(UsageError, match=r"which topic\? .*/left .*topic = '\.\.\.'"):
        read_table(bag)
    with pytest.raises(UsageError, match=r"joints a, others gripper.*joint = "):
        read_table(bag, {"use": "rosbag2", "topic": "/left"})
    table = read_table(bag, {"use": "rosbag2", "topic": "/left", "joint": "gripper"})
    np.testing.assert_array_equal(table.columns(["gripper_position"]), [[4.0]])


def test_several_episodes_are_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    WRITERS["meta/info.json"](folder)
    info = folder / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"total_episodes": 2}))
    with pytest.raises(UsageError, match="holds 2 episodes; choose one"):
        read_table(folder)
    with pytest.raises(UsageError, match="no episode 1"):
        read_table(folder, {"use": "lerobot", "episode": 1})
    table = read_table(folder, {"use": "lerobot", "episode": 0})
    assert table.rate == 100
    assert "observation.state.j2" in table.names


def test_a_group_of_hdf5_and_data_in_other_files(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["long/q"], file["short/q"] = np.arange(9.0), np.arange(4.0)
        file.create_dataset("away", (9,), float, external=[(str(tmp_path / "raw"), 0, 72)])
    table = read_table(path, {"use": "hdf5", "group": "short"})
    np.testing.assert_array_equal(table.columns(["q"])[:, 0], np.arange(4.0))
    with pytest.raises(UsageError, match="'away' lies in another file"):
        read_table(path)
    with pytest.raises(UsageError, match="no group 'middle'; at its top are"):
        read_table(path, {"use": "hdf5", "group": "middle"})


def test_matlab_73_is_read_as_hdf5(tmp_path: Path) -> None:
    path, q = tmp_path / "run.mat", np.random.default_rng(0).normal(size=(2, 30))
    with h5py.File(path, "w", userblock_size=512) as file:
        file["rec/q"], file["t"] = q, np.arange(30.0)[:, None]
        file["title"] = np.frombuffer(b"x" * 30, dtype=np.uint8).astype(np.uint16)
        file["title"].attrs["MATLAB_class"] = np.bytes_(b"char")
    with path.open("r+b") as written:
        written.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    table = read_table(path)
    np.testing.assert_array_equal(table.columns(["rec.q"]), q.T)
    assert "title" not in table.names


@pytest.mark.parametrize("seed", range(3))
def test_own_recordings_come_back(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    t, rows = np.arange(60) / 100, ("shoulder", "wrist 1", "a/b")
    x = rng.normal(size=(60, 3))
    cell = CellData(
        {"id": "a" * 64, "robot": "two", "status": "ok"}, Trajectory(t, x, x, x), x, 2 * x, rows,
        np.ones(2), np.zeros((3, 2)), ("m", "h"), None, None,
    )  # fmt: skip
    path = record(cell, tmp_path / "cell.rrd", max_hz=1000)
    table = read_table(path, {"use": "rerun", "entity": "torque"})
    np.testing.assert_array_equal(table.columns(["t"])[:, 0], np.round(t * 1e9) * 1e-9)
    np.testing.assert_array_equal(table.columns(["torque/shoulder/measured"])[:, 0], x[:, 0])
    values = np.sort(table.values[:, 1:], axis=1)
    np.testing.assert_array_equal(values, np.sort(np.hstack([x, 2 * x]), axis=1))
    with pytest.raises(UsageError, match="timeline = "):
        read_table(path, {"use": "rerun", "timeline": "tick"})
    bare = record(replace(cell, predicted=None), tmp_path / "bare.rrd", max_hz=1000)
    assert read_table(bare).values.shape == (60, 4)


@pytest.mark.parametrize("robot", ["ur5", "scara"])
def test_an_own_recording_is_a_log(robot: str, tmp_path: Path) -> None:
    """Positions, velocities and torques of hinges and slides come back under their joints."""
    log = recorded(named_robot(robot), period=2.0)
    model = named_robot(robot)
    places = {joint.dofs[0]: (joint.qadr, joint.vadr) for joint in model.joints}
    cell = CellData(
        {"id": "a" * 64, "robot": robot, "status": "ok"},
        Trajectory(log.t, log.q, log.v, log.v), log.tau, 2 * log.tau, log.joints,
        np.ones(2), np.zeros((3, 2)), ("m", "h"), None, None, joints=places,
    )  # fmt: skip
    path = record(cell, tmp_path / "cell.rrd", max_hz=1000)
    init_log(path, robot)
    read = read_log(read_description(tmp_path / "cell.toml"), model).recording
    np.testing.assert_allclose(read.q, log.q, atol=1e-6)
    assert read.v is not None
    np.testing.assert_allclose(read.v, log.v, atol=1e-5 * np.abs(log.v).max())
    np.testing.assert_allclose(read.tau, log.tau, atol=1e-5 * np.abs(log.tau).max())


@pytest.mark.parametrize(("suffix", "library"), [(".h5", "h5py"), (".mcap", "rosbags")])
def test_an_absent_library_is_one_sentence(
    suffix: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(module: str) -> Any:
        raise ModuleNotFoundError(module)

    path = tmp_path / f"run{suffix}"
    WRITERS[suffix](path)
    monkeypatch.setattr(extras, "import_module", absent)
    with pytest.raises(UsageError, match=rf"needs {library}.*sysid-bench\[logs\]"):
        read_table(path)


def test_a_folder_that_is_no_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"metadata\.yaml.*meta/info\.json"):
        read_table(tmp_path)


@pytest.mark.data
@pytest.mark.parametrize(
    ("bag", "text"),
    [
        ("ur10_cb3/ur10_exciting_trajectory.db3", "ur10/ur10_exciting_trajectory.csv"),
        ("fer/panda_exciting_trajectory.db3", "fer/panda_exciting_trajectory.csv"),
    ],
)
def test_original_bags_equal_their_csv(bag: str, text: str, data_folder: Path) -> None:
    got, wanted = read_table(data_folder / bag), read_table(data_folder / text)
    for name in wanted.names:
        x, y = got.columns([name]), wanted.columns([name])
        # Equal to the digits that the CSV has.
        np.testing.assert_allclose(x, y, rtol=5e-9, atol=1e-8, err_msg=name)
    assert len(wanted.names) >= 19


@pytest.mark.data
@pytest.mark.parametrize(
    ("path", "q", "v"),
    [
        ("lerobot_v2", "observation.state", "observation.velocity"),
        ("lerobot_v3", "observation.state", "observation.velocity"),
        ("aloha_episode_0.hdf5", "observations/qpos", "observations/qvel"),
        (
            "robomimic_demo.hdf5",
            "data/demo_0/obs/robot0_joint_pos",
            "data/demo_0/obs/robot0_joint_vel",
        ),
    ],
)
def test_generated_formats_are_equal_bit_for_bit(
    path: str, q: str, v: str, data_folder: Path
) -> None:
    source = read_table(data_folder / "go2" / "run_0.npz")
    got = read_table(data_folder / "formats_generated" / path)
    np.testing.assert_array_equal(got.columns([q]), source.columns(["q"]))
    np.testing.assert_array_equal(got.columns([v]), source.columns(["v"]))
    assert got.rate in (200.0, None if "aloha" in path else 200.0)
