"""Laws of logs from several files, presets, numbers in memory and damaged time stamps."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench import identify, log_of
from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_keys import preset_keys
from sysid_bench.signals.log_source import merge_sources
from sysid_bench.signals.time_base import check_times
from tests.robots import named_robot

from .logs import RATE, Recorded, World, recorded, write
from .test_log import found, refused


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return named_robot("scara")


@pytest.fixture(scope="module")
def log(robot: RobotModel) -> Recorded:
    return recorded(robot)


@pytest.fixture
def world(robot: RobotModel, tmp_path: Path) -> World:
    return World(robot, tmp_path)


def split(folder: Path, log: Recorded, shift: float, rate: float, origin: float = 0.0) -> Path:
    """A recording in two files whose clocks differ: q at 200 Hz, v and tau at `rate`."""
    later = np.arange(log.t[0] + 0.01, log.t[-1] - 0.01, 1 / rate)
    v = np.stack([np.interp(later, log.t, x) for x in log.v.T], axis=1)
    tau = np.stack([np.interp(later, log.t, x) for x in log.tau.T], axis=1)
    frame = pd.DataFrame(log.q, columns=[f"q_{j}" for j in log.joints])
    frame.insert(0, "t", log.t + origin)
    frame.to_csv(folder / "q.csv", index=False)
    names = [f"{s}_{j}" for s in ("v", "tau") for j in log.joints]
    frame = pd.DataFrame(np.hstack([v, tau]), columns=names)
    frame.insert(0, "stamp", (later + origin - shift) * 1e3)
    frame.to_parquet(folder / "tau.parquet")
    other = {
        "file": "tau.parquet",
        "time": {"column": "stamp", "unit": "ms"},
        "offset": f"{shift} s",
    }
    signals: dict[str, Any] = {
        s: {"columns": [f"{s}_{j}" for j in log.joints]} for s in ("q", "v", "tau")
    }
    return write(folder, log, file=["q.csv", other], rate=None, time="t", **signals)


@pytest.mark.parametrize(("shift", "rate"), [(0.0, 200.0), (3.5, 500.0), (-0.25, 1000.0)])
def test_files_are_joined_by_name_and_time(
    world: World, shift: float, rate: float, log: Recorded, tmp_path: Path
) -> None:
    path = split(tmp_path, log, shift, rate)
    made = merge_sources(read_description(path))
    inside = np.isin(log.t, made.t)
    assert inside.sum() == len(made.t) >= len(log.t) - 6
    columns = {s: made.table.columns([f"{s}_{j}" for j in log.joints]) for s in ("q", "v", "tau")}
    np.testing.assert_array_equal(columns["q"], log.q[inside])
    np.testing.assert_allclose(columns["v"], log.v[inside], atol=0.02 * np.abs(log.v).max())
    np.testing.assert_allclose(columns["tau"], log.tau[inside], atol=0.02 * np.abs(log.tau).max())
    got = world.read_file(path)
    (finding,) = [f for f in got.findings if f.name == "joined"]
    assert "linear for signals" in finding.text
    assert finding.count == len(log.t) - got.samples
    assert {file.name for file in got.description.files} == {"q.csv", "tau.parquet"}


def test_a_command_holds_its_last_value(log: Recorded, tmp_path: Path) -> None:
    path = split(tmp_path, log, 0.0, 20.0)
    held = path.read_text().replace('"tau_spin"]', '"tau_spin"]\nresample = "previous"')
    assert held != path.read_text()
    path.write_text(held)
    made = merge_sources(read_description(path))
    stored = pd.read_parquet(tmp_path / "tau.parquet")
    tau = made.table.columns(["tau_shoulder"])[:, 0]
    at = np.searchsorted(stored["stamp"].to_numpy() * 1e-3, made.t + 1e-9, side="right") - 1
    assert (tau == stored["tau_shoulder"].to_numpy()[at]).mean() > 0.95
    assert set(tau) <= set(stored["tau_shoulder"])


def test_files_that_cannot_be_joined_are_refused(
    world: World, log: Recorded, tmp_path: Path
) -> None:
    path = split(tmp_path, log, 0.0, 200.0)
    text = path.read_text()
    wrong = {
        "do not overlap in time.*offset": text.replace('offset = "0.0 s"', 'offset = "99 s"'),
        "time = the column": text.replace('time = "t"', 'rate = "200 Hz"'),
        "No column is called 'tau_x'": text.replace('"tau_spin"', '"tau_x"'),
        "of which file": text.replace('"tau_spin"', "3"),
    }
    for reported, changed in wrong.items():
        assert changed != text
        path.write_text(changed)
        with pytest.raises(UsageError, match=reported):
            world.read_file(path)
    frame = pd.read_parquet(tmp_path / "tau.parquet")
    frame["q_spin"] = 0.0
    frame.to_parquet(tmp_path / "tau.parquet")
    path.write_text(text)
    with pytest.raises(UsageError, match=r"q\.csv and tau\.parquet both have a column 'q_spin'"):
        world.read_file(path)


# --- Time stamps ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_wild_stamp_costs_its_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.choice([1.0, 1.0, 1.0, 2.0, 3.0], 2000)) / RATE
    at = rng.choice(2000, 20, replace=False)
    wild = t.copy()
    wild[at] = rng.choice([1e12, -1e9, 0.0, 1e293, 3.0], 20) + rng.normal(size=20)
    kept, findings = check_times(wild)
    lost = np.flatnonzero(~np.isfinite(kept))
    # A number drawn near the right time may stay, or cost a neighbour.
    assert len(lost) <= 25
    assert np.isin(at[np.abs(wild[at] - t[at]) > 1.0], lost).all()
    assert (np.diff(kept[np.isfinite(kept)]) > 0).all()
    assert sum(finding.count for finding in findings) == len(lost)
    assert not any(finding.contradiction for finding in findings)


def test_corrupt_first_rows_cost_themselves(world: World, log: Recorded) -> None:
    t = log.t.copy()
    t[:9] = [1e293, -4e8, 7e200, 0.0, 5e12, -1.0, 3e30, 2e9, 1e99]
    got = world.read(replace(log, t=t), time=1, rate=None)
    assert found(got)["time"] <= 9
    assert len(got.recording.t) >= len(log.t) - 12


@pytest.mark.parametrize("seed", range(4))
def test_rounded_stamps_are_refused_with_the_rate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rate, step = rng.uniform(50, 500), rng.choice([0.1, 0.05])
    t = (np.arange(3000) + rng.normal(scale=0.05, size=3000)) / rate + 7.0
    _, (finding,) = check_times(np.round(t / step) * step)
    assert finding.contradiction
    assert f"rounded to {step:g} s" in finding.text
    told = float(finding.edit.split("'")[1].removesuffix(" Hz"))
    assert told == pytest.approx(rate, rel=0.01)
    # A clock that now and then stands still is none of these.
    still = np.sort(t)
    at = np.sort(rng.choice(np.arange(1, 3000), 900, replace=False))
    for row in at:
        still[row] = still[row - 1]
    assert not any("rounded" in one.text for one in check_times(still)[1])


def test_a_clock_that_was_set_back_gives_rows_and_exchanged_rows_lose_none(
    world: World, log: Recorded
) -> None:
    t, N = log.t.copy(), len(log.t)
    at = 2 * N // 3
    t[at:] -= t[at] - t[0]
    _, (finding,) = check_times(t)
    assert finding.edit.startswith(f"rows = [1, {at}]")
    assert check_times(t[5:], before=5)[1][0].edit.startswith(f"rows = [6, {at}]")
    order = np.arange(N)
    for row in range(10, N - 10, N // 40):
        order[[row, row + 1]] = order[[row + 1, row]]
    exchanged = replace(log, t=log.t[order], q=log.q[order], v=log.v[order], tau=log.tau[order])
    got = world.read(exchanged, time=1, rate=None)
    assert "lost" not in found(got)
    assert found(got)["time"] >= 38
    assert "sort the rows" in next(one.edit for one in got.findings if one.name == "time")


def test_stamps_in_milliseconds_are_named(world: World, log: Recorded) -> None:
    got = world.read(replace(log, t=log.t * 1e3), time=1, rate=None)
    assert "step by 5 s" in refused(got, ("rate", "units", "velocity"))
    got = world.read(replace(log, t=log.t * 1e3), time=1)
    assert "a rate of 200 Hz is declared" in refused(got)


def test_stamps_in_two_columns_are_added(world: World, log: Recorded, tmp_path: Path) -> None:
    names = [f"{s}_{j}" for s in ("q", "v", "tau") for j in log.joints]
    frame = pd.DataFrame(np.hstack([log.q, log.v, log.tau]), columns=names)
    whole = np.floor(log.t)
    frame["sec"], frame["nanosec"] = whole, np.round((log.t - whole) * 1e9)
    frame.to_csv(tmp_path / "run.csv", index=False)
    signals: dict[str, Any] = {
        s: {"columns": [f"{s}_{j}" for j in log.joints]} for s in ("q", "v", "tau")
    }
    time = {"column": ["sec", "nanosec"], "unit": ["s", "ns"]}
    path = world.write(log, name="two", file="run.csv", time=time, rate=None, **signals)
    world.same(world.read_file(path), log, atol=1e-6)


# --- Presets -------------------------------------------------------------------------------------

_NAMES = {
    "ur-rtde": ("timestamp", "actual_q_{}", "actual_qd_{}", "actual_current_{}"),
    "libfranka": ("time", "state.q[{}]", "state.dq[{}]", "state.tau_J[{}]"),
    "kuka-sunrise": ("", "axisQMsr_LBR_iiwa_7_R800_1[{}]", "", "axisTauMsr_LBR_iiwa_1[{}]"),
    "kuka-fri": ("time", "mp{}", "", "mt{}"),
}


def preset_file(folder: Path, log: Recorded, name: str) -> None:
    """A file as the recorder of a preset writes it, its columns in reverse order."""
    time, q, v, tau = _NAMES[name]
    unit = {"libfranka": 1e3}.get(name, 1.0)
    frame = pd.DataFrame({time: log.t * unit}) if time else pd.DataFrame()
    if not time:
        whole = np.floor(log.t)
        frame["ZeitInSec"], frame["ZeitInNanoSec"] = whole, np.round((log.t - whole) * 1e9)
    scale = 180 / np.pi if name == "kuka-sunrise" else 1.0
    for j in reversed(range(len(log.joints))):
        frame[q.format(j)] = log.q[:, j] * scale
        frame[tau.format(j)] = log.tau[:, j]
        if v:
            frame[v.format(j)] = log.v[:, j]
        frame[f"target_{j}"] = 0.0
    frame.to_csv(folder / "run.csv", index=False)


@pytest.mark.parametrize("name", preset_keys())
def test_a_preset_reads_the_file_of_its_recorder(name: str, tmp_path: Path) -> None:
    arm = named_robot("ur5")
    log = recorded(arm, period=2.0)
    preset_file(tmp_path, log, name)
    path = tmp_path / "run.toml"
    gain = "tau = { gain = [1, 1, 1, 1, 1, 1] }\n" if name == "ur-rtde" else ""
    joints = f"joints = {list(log.joints)}\n".replace("'", '"')
    path.write_text(f'file = "run.csv"\npreset = "{name}"\n{joints}{gain}')
    got = World(arm, tmp_path).read_file(path)
    np.testing.assert_allclose(got.recording.tau, log.tau, atol=1e-6 * np.abs(log.tau).max())
    np.testing.assert_allclose(got.recording.q, log.q, atol=1e-6)
    # Without its name the preset is proposed, and never taken silently.
    path.write_text(f'file = "run.csv"\nrate = "200 Hz"\n{joints}')
    with pytest.raises(UsageError, match=f"q is missing.*preset = '{name}'"):
        World(arm, tmp_path).read_file(path)
    path.write_text(
        f'file = "run.csv"\nrate = "200 Hz"\n{joints}q.columns = "a"\ntau.columns = "b"'
    )
    with pytest.raises(UsageError, match=f"preset = '{name}'"):
        World(arm, tmp_path).read_file(path)


def test_wrong_presets_and_patterns_are_refused(world: World, log: Recorded) -> None:
    with pytest.raises(UsageError, match="'ur-rtde'"):
        world.read(log, preset="ur-rtd")
    for pattern, reported in {
        "q_(": "not a regular expression",
        "(q)?.*": "not a regular expression",
        ".*": "must name each of the joints",
        "q_s.*": "must name each of the joints",
        r"x(\d+)": "no column matches",
    }.items():
        with pytest.raises(UsageError, match=reported):
            world.read(log, q={"columns": [], "match": pattern})


def test_a_pattern_of_names_follows_the_joints(world: World, log: Recorded, tmp_path: Path) -> None:
    world.write(log)
    frame = pd.read_csv(tmp_path / "run.csv")
    frame[frame.columns[::-1]].to_csv(tmp_path / "turned.csv", index=False)
    for pattern in ("{}_.*", "{}_(.*)"):
        match: dict[str, Any] = {
            s: {"columns": [], "match": pattern.format(s)} for s in ("q", "v", "tau")
        }
        world.same(world.read(log, **match, file="turned.csv"), log)


@pytest.mark.parametrize("shift", [0.0, 0.0013])
def test_signals_with_clocks_of_their_own(
    world: World, shift: float, log: Recorded, tmp_path: Path
) -> None:
    for n, (name, x) in enumerate({"q": log.q, "v": log.v, "tau": log.tau}.items()):
        # Files end at other rows, and the clocks of the others run beside that of q.
        t = log.t + n * shift
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, x])[: len(t) - 7 * n], fmt="%.17g")
    columns = list(range(2, 2 + len(log.joints)))
    parts: dict[str, Any] = {
        s: {"file": f"{s}.csv", "columns": columns, "time": 1} for s in ("q", "v", "tau")
    }
    got = world.read_file(write(tmp_path, log, file=None, rate=None, **parts))
    assert found(got)["joined"] == 2
    assert {file.name for file in got.description.files} == {"q.csv", "v.csv", "tau.csv"}
    count = len(got.recording)
    assert abs(count - (len(log.t) - 14)) <= 1  # tau ends first
    wanted = np.stack([np.interp(log.t, log.t + 2 * shift, x) for x in log.tau.T], axis=1)
    difference = got.recording.tau - wanted[:count]
    assert np.abs(difference[3:-3]).max() < 1e-9 * np.abs(wanted).max()
    parts["tau"]["time"] = {"column": 1, "file": "v.csv"}
    path = write(tmp_path, log, file=None, rate=None, **parts)
    with pytest.raises(UsageError, match="check time of this signal"):
        world.read_file(path)


# --- Numbers in memory ---------------------------------------------------------------------------


def same_answer(got: Any, wanted: Any, rel: float = 1e-9) -> None:
    for key in ("rmse_train", "rank", "condition"):
        assert got[key] == pytest.approx(wanted[key], rel=rel)


def test_frames_and_arrays_give_the_answer_of_the_file(world: World, log: Recorded) -> None:
    options: dict[str, Any] = {"filter": "none", "derivatives": "from v", "estimator": "ols"}
    wanted = identify("scara", log=world.write(log), **options)
    arrays: dict[str, Any] = {"q": log.q, "v": log.v, "tau": log.tau}
    described = log_of(arrays, {"joints": log.joints, "rate": RATE})
    same_answer(identify("scara", log=described, **options), wanted)
    frame = pd.DataFrame({"t": log.t})
    for signal, word in (("q", "position"), ("v", "velocity"), ("tau", "effort")):
        for joint, x in zip(log.joints, arrays[signal].T, strict=True):
            frame[f"{joint}_{word}"] = x
    answer = identify("scara", log=frame, test=frame, **options)
    same_answer(answer, wanted)
    assert [part["log"] for part in answer["logs"]] == ["log", "test"]
    dated = frame.drop(columns="t").set_index(
        np.datetime64("2026-01-01", "ns") + np.round(log.t * 1e9).astype("timedelta64[ns]")
    )
    same_answer(identify("scara", log=[dated], **options), wanted, rel=1e-6)


def test_numbers_that_are_not_a_log_are_refused(log: Recorded) -> None:
    with pytest.raises(UsageError, match=r"which joints\? .*log_of"):
        log_of({"q": log.q, "tau": log.tau})
    with pytest.raises(UsageError, match="tau is missing"):
        log_of({"q": log.q}, {"joints": log.joints, "rate": 200})
    with pytest.raises(UsageError, match="file is for recorded files"):
        log_of({"q": log.q, "tau": log.tau}, {"joints": log.joints, "file": "run.csv"})
    with pytest.raises(UsageError, match="got list"):
        log_of([1.0, 2.0])
    with pytest.raises(UsageError, match="no array of numbers"):
        log_of({"q": ["a", "b"]}, {"joints": ["a"]})


def test_stamps_that_no_recorder_writes_are_refused(world: World, log: Recorded) -> None:
    with pytest.raises(UsageError, match="unit of time"):
        world.read(replace(log, t=1e-300 * log.t), time=1, rate=None)
