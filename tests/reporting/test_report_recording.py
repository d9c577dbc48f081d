"""Laws of recordings: whole files, true numbers, thin enough, any robot visible."""

import os
import subprocess
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.reporting.recording import (
    TIMELINE,
    _joint_colour,
    record,
    summary,
)
from sysid_bench.reporting.scene import MESH_BUDGET, scene_of
from sysid_bench.reporting.signal_figures import difference_figure
from sysid_bench.reporting.view import rerun_tool, view
from sysid_bench.types import CellData, Shape, Trajectory

ONE, ORIGIN = np.array([1.0, 0, 0, 0]), np.zeros(3)
SOLIDS = (
    Shape(0, "box", (0.1, 0.2, 0.3), ORIGIN, ONE),
    Shape(0, "sphere", (0.1,), ORIGIN, ONE),
    Shape(1, "cylinder", (0.1, 0.2), ORIGIN, ONE),
    Shape(1, "capsule", (0.1, 0.2), ORIGIN, ONE),
    Shape(2, "ellipsoid", (0.1, 0.2, 0.3), ORIGIN, ONE),
)
TRIANGLE = "solid t\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid t\n"  # noqa: E501


def verified(path: Path) -> str:
    """Why `rerun rrd verify` refuses a file; empty where it does not."""
    command = [str(rerun_tool()), "rrd", "verify", str(path)]
    environment = {**os.environ, "XDG_CONFIG_HOME": str(path.parent / "config")}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env=environment
    )
    return "" if done.returncode == 0 else done.stderr


def column(path: Path, entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
    """(times in s, values) of one component of a recording, sorted by time."""
    from rerun.chunk import RrdReader

    times, values = [], []
    for chunk in RrdReader(path).stream().filter(content=entity, is_static=False).to_chunks():
        batch = chunk.to_record_batch()
        name = next((n for n in batch.schema.names if n.endswith(component)), None)
        if name is not None:
            times.append(batch.column(TIMELINE).cast("int64").to_numpy() * 1e-9)
            values.append(np.array(batch.column(name).to_pylist(), dtype=float))
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], np.concatenate(values)[order].squeeze()


def entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {str(chunk.entity_path) for chunk in RrdReader(path).stream().to_chunks()}


@pytest.mark.parametrize("shapes", [(), SOLIDS, SOLIDS[:2]])
def test_a_recording_is_whole(evidence: CellData, tmp_path: Path, shapes: Any) -> None:
    path = record(replace(evidence, shapes=shapes), tmp_path / "cell.rrd")
    assert [file.name for file in tmp_path.iterdir()] == ["cell.rrd"]
    assert path.stat().st_size < 500_000
    assert verified(path) == ""
    path.write_bytes(path.read_bytes()[:-200])
    assert verified(path) != ""  # the check can fail


def test_signals_come_back_exactly(evidence: CellData, tmp_path: Path) -> None:
    path = record(evidence, tmp_path / "cell.rrd", max_hz=1000)
    assert evidence.predicted is not None
    times, measured = column(path, "/torque/shoulder/measured", "Scalars:scalars")
    np.testing.assert_allclose(times, evidence.motion.t, atol=1e-9)
    np.testing.assert_array_equal(measured, evidence.measured[:, 0])
    _, residual = column(path, "/residual/elbow", "Scalars:scalars")
    np.testing.assert_array_equal(residual, (evidence.measured - evidence.predicted)[:, 1])


@pytest.mark.parametrize("max_hz", [1, 7, 50, 64, 200, 1e6])
def test_a_recording_is_thinned_to_the_rate(
    evidence: CellData, tmp_path: Path, max_hz: float
) -> None:
    path = record(evidence, tmp_path / "cell.rrd", max_hz)
    times, measured = column(path, "/torque/shoulder/measured", "Scalars:scalars")
    assert np.diff(times).min() >= 1 / max_hz - 1e-6
    assert np.diff(times).max() <= max(1 / max_hz, 1 / 200) + 1 / 200
    samples = np.searchsorted(evidence.motion.t, times - 1e-6)
    np.testing.assert_array_equal(measured, evidence.measured[samples, 0])


def test_bodies_stand_where_the_evidence_has_them(evidence: CellData, tmp_path: Path) -> None:
    path = record(evidence, tmp_path / "cell.rrd", max_hz=1000)
    assert evidence.positions is not None
    assert evidence.quaternions is not None
    _, places = column(path, "/robot/elbow", "Transform3D:translation")
    np.testing.assert_allclose(places, evidence.positions[:, 1], atol=1e-6)
    _, turns = column(path, "/robot/elbow", "Transform3D:quaternion")
    np.testing.assert_allclose(turns, evidence.quaternions[:, 1][:, [1, 2, 3, 0]], atol=1e-6)


def test_names_may_hold_anything(evidence: CellData, tmp_path: Path) -> None:
    names = ("a/b c.d", "", "机器人")
    path = record(replace(evidence, rows=names, bodies=names), tmp_path / "cell.rrd")
    assert verified(path) == ""
    bodies = {p for p in entities(path) if p.startswith("/robot/") and not p.endswith("/joint")}
    assert len(bodies) == 3


@pytest.mark.parametrize("file", ["absent.stl", "shape.msh", "huge.stl"])
def test_a_robot_without_its_meshes_is_drawn_with_sticks(
    evidence: CellData, tmp_path: Path, file: str
) -> None:
    if file != "absent.stl":
        (tmp_path / file).write_bytes(bytes(MESH_BUDGET + 1 if file == "huge.stl" else 10))
    mesh = Shape(0, "mesh", (1.0, 1.0, 1.0), ORIGIN, ONE, str(tmp_path / file))
    dressed = replace(evidence, shapes=(mesh,))
    assert scene_of(dressed).bodies_without_shape == [0, 1, 2]
    assert scene_of(dressed).complaints
    path = record(dressed, tmp_path / "cell.rrd")
    assert "/sticks" in entities(path)
    assert path.stat().st_size < 500_000


def test_meshes_that_can_be_read_are_drawn(evidence: CellData, tmp_path: Path) -> None:
    file = tmp_path / "triangle.stl"
    file.write_text(TRIANGLE)
    mesh = [Shape(i, "mesh", (0.1, 0.1, 0.1), ORIGIN, ONE, str(file)) for i in range(3)]
    dressed = replace(evidence, shapes=tuple(mesh))
    assert scene_of(dressed).bodies_without_shape == []
    path = record(dressed, tmp_path / "cell.rrd")
    assert "/sticks" not in entities(path)
    assert "/robot/shoulder/shape0" in entities(path)


def test_what_is_absent_is_left_out(evidence: CellData, tmp_path: Path) -> None:
    bare = replace(
        evidence, predicted=None, estimate=None, base=None, positions=None, quaternions=None,
        bodies=(), parents=(), singular_values=np.array([]), gap_map=np.zeros((0, 0)),
    )  # fmt: skip
    path = record(bare, tmp_path / "cell.rrd")
    assert verified(path) == ""
    assert not [p for p in entities(path) if p.startswith(("/residual", "/robot", "/gap"))]


def test_the_summary_holds_every_base_parameter(evidence: CellData) -> None:
    text = summary(evidence, ["no mesh"])
    assert evidence.base is not None
    assert all(name in text for name in evidence.base.names)
    assert "no mesh" in text
    assert r"fake \| arm" in text


def test_the_summary_names_the_plant_and_the_pipeline(evidence: CellData) -> None:
    text = summary(replace(evidence, row={**evidence.row, "plant": "L3", "pipeline": "parallel"}))
    assert "| plant | L3 |" in text
    assert "| pipeline | parallel |" in text


def test_colours_of_joints_are_distinct() -> None:
    colours = [_joint_colour(i) for i in range(40)]
    pairs = [np.abs(np.subtract(a, b)).sum() for a, b in combinations(colours, 2)]
    assert min(pairs) > 20


@pytest.mark.parametrize("gap", [0.0, np.nan, 1e-15])
def test_the_map_of_differences_is_drawn_for_any_of_them(evidence: CellData, gap: float) -> None:
    picture = difference_figure(replace(evidence, gap_map=np.full_like(evidence.gap_map, gap)))
    assert picture.startswith(b"\x89PNG")
    assert picture == difference_figure(
        replace(evidence, gap_map=np.full_like(evidence.gap_map, gap))
    )


def test_a_recording_that_cannot_be_made_leaves_nothing(evidence: CellData, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="positive"):
        record(evidence, tmp_path / "cell.rrd", max_hz=0)
    motion = evidence.motion
    shorter = Trajectory(motion.t[1:], motion.q[1:], motion.v[1:], motion.a[1:])
    with pytest.raises(UsageError, match="400 samples, the motion 399"):
        record(replace(evidence, motion=shorter), tmp_path / "cell.rrd")
    with pytest.raises(IndexError):
        record(replace(evidence, rows=("a", "b", "c", "d")), tmp_path / "cell.rrd")
    assert not list(tmp_path.iterdir())


def test_an_absent_recording_opens_no_viewer(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        view(tmp_path / "absent.rrd")


def _has_vulkan() -> bool:
    folders = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
    return any(any(folder.glob("*.json")) for folder in folders)


def test_no_view_of_the_layout_reports_an_error(
    evidence: CellData, nine_joints: CellData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rerun.experimental import ViewerClient

    if not hasattr(ViewerClient, "open"):
        pytest.skip("needs a newer rerun-sdk, whose viewer can be asked for what it shows")
    if not _has_vulkan():
        pytest.skip("no Vulkan driver is installed: the viewer cannot draw without a display")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    switch_off = [str(rerun_tool()), "analytics", "disable"]
    subprocess.run(switch_off, capture_output=True, timeout=60, check=False)
    try:
        client = ViewerClient.spawn(headless=True, port=free_port(), executable_path=switch_off[0])
    except (RuntimeError, OSError) as error:
        pytest.skip(f"the headless viewer does not start here: {str(error)[:200]}")
    try:
        for number, shown in enumerate((evidence, replace(nine_joints, shapes=SOLIDS))):
            row = {**shown.row, "id": f"c{number}", "robot": f"robot {number}"}
            path = record(replace(shown, row=row), tmp_path / f"{number}.rrd")
            client.open(path.as_uri())
            client.set_time(TIMELINE, duration=0.5, play_state="paused")
            client.save_screenshot(str(tmp_path / f"{number}.png"))  # every view has been drawn
            views = client.get_state().views
            assert len(views) == len(shown.rows) + 5
            assert [v.reports for v in views if v.reports] == []
    finally:
        client.quit()


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
