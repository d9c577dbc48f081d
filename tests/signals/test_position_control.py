"""Commanded torque of logs without measured torque: holds, delays, gains, limits, mistakes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.position_control import mean_of_held
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, leg
from tests.closeness import assert_close

N, RATE = 400, 100.0


def motion() -> dict[str, Array]:
    """Recorded signals of three joints."""
    rng = np.random.default_rng(2)
    t = np.arange(N)[:, None] / RATE
    q = 0.3 * np.sin(2.0 * t + np.arange(3))
    v = 0.6 * np.cos(2.0 * t + np.arange(3))
    return {"q": q, "v": v, "q_des": q + 0.02 * rng.normal(size=(N, 3))}


def read(data: Mapping[str, Array] | None = None, **pd: Any) -> Log:
    """A log whose torque is that of a position controller."""
    controller = {"q_des": "q_des", "kp": 20.0, "kd": 0.5} | pd
    keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
    return read_log(log_of(motion() if data is None else data, keys), leg())


def test_means_of_held_commands_are_those_of_a_fine_grid() -> None:
    rng, fine = np.random.default_rng(0), 1000
    x = rng.normal(size=(60, 2))
    held = np.repeat(x, fine, axis=0)
    for shift in (0.0, 0.3, 0.5, 1.0, 2.75):
        found = mean_of_held(x, shift)
        for k in (10, 30, 55):
            end = round((k + 0.5 - shift) * fine)
            np.testing.assert_allclose(found[k], held[end - fine : end].mean(axis=0), atol=1e-2)


def test_the_torque_of_a_log_is_that_of_its_controller() -> None:
    data, kp, kd = motion(), [20.0, 20.0, 40.0], [1.0, 1.0, 2.0]
    wanted = np.ones((N, 3)) * [0.1, 0.0, -0.2]
    extra = {**data, "v_des": wanted, "ff": 3.0 * wanted}
    log = read(extra, kp=kp, kd=kd, v_des="v_des", feedforward="ff")
    error = mean_of_held(data["q_des"], 0.0) - data["q"]
    tau = kp * error + kd * (wanted - data["v"]) + 3.0 * wanted
    np.testing.assert_allclose(log.recording.tau, tau, atol=1e-9)


def test_a_delay_of_whole_samples_moves_the_commands() -> None:
    data = motion()
    moved = {**data, "q_des": np.roll(data["q_des"], 2, axis=0)}
    late, early = read(delay="20 ms").recording.tau, read(moved).recording.tau
    np.testing.assert_allclose(late[5:], early[5:], atol=1e-9)
    assert np.abs(late - read().recording.tau).max() > 0.1


def test_an_unknown_delay_is_a_finding() -> None:
    findings = [f for f in read(delay="profile").findings if f.name == "delay"]
    assert len(findings) == 1
    assert "counts as zero" in findings[0].text
    assert not findings[0].contradiction
    assert not any(f.name == "delay" for f in read(delay="5 ms").findings)


def test_a_slower_controller_holds_its_commands() -> None:
    data = motion()
    stairs = {**data, "q_des": np.repeat(data["q_des"][::4], 4, axis=0)}
    slow, held = read(rate="25 Hz").recording.tau, read(stairs).recording.tau
    np.testing.assert_allclose(slow, held, atol=1e-9)


@pytest.mark.parametrize("lost", [0, 200, N - 1], ids=["first", "middle", "last"])
@pytest.mark.parametrize("signal", ["q", "v", "q_des", "v_des", "stiff"])
def test_a_lost_sample_costs_its_own_row_alone(signal: str, lost: int) -> None:
    ones = np.ones((N, 3))
    data = {**motion(), "stiff": 20.0 * ones, "v_des": 0.3 * ones}
    damaged = {**data, signal: data[signal].copy()}
    damaged[signal][lost] = np.nan
    settings = {"kp": "stiff", "v_des": "v_des", "delay": "20 ms"}
    found, whole = read(damaged, **settings), read(data, **settings)
    assert [f.count for f in found.findings if f.name == "non-finite"] == [1]
    tau = np.full((N, 3), np.nan)
    first = 1 if lost == 0 else 0  # the grid begins with the first valid sample
    tau[first : first + len(found.recording)] = found.recording.tau
    used = np.setdiff1d(np.arange(N), [*range(lost - 1, lost + 5), 0, N - 1])
    np.testing.assert_allclose(tau[used], whole.recording.tau[used], atol=1e-9)
    assert np.isfinite(found.recording.tau).all()
    assert found.commands is not None
    assert np.isfinite(found.commands.torque(0.02)).all()
    # The command before is held, and not left out of the count of samples of a delay.
    if signal == "q_des" and lost == 200:
        held = {**data, "q_des": data["q_des"].copy()}
        held["q_des"][lost] = held["q_des"][lost - 1]
        rows = np.setdiff1d(np.arange(N), [lost])
        of_held = read(held, **settings).recording.tau
        np.testing.assert_allclose(tau[rows], of_held[rows], atol=1e-9)


def test_limits_clip_and_gains_may_be_columns() -> None:
    assert np.abs(read(limit=0.5).recording.tau).max() == pytest.approx(0.5)
    data = motion()
    varying = {**data, "stiff": np.where(np.arange(N) < 200, 20.0, 10.0)[:, None] * np.ones(3)}
    half = read(varying, kp="stiff").recording.tau
    varying |= {f"k{j}": column for j, column in enumerate(varying["stiff"].T)}
    listed = read(varying, kp=["k0", "k1", "k2"]).recording.tau
    np.testing.assert_array_equal(listed, half)
    np.testing.assert_allclose(half[:200], read().recording.tau[:200], atol=1e-9)
    np.testing.assert_allclose(half[201:], read(kp=10.0).recording.tau[201:], atol=1e-9)


def test_repeated_positions_stay_in_the_commands_as_recorded() -> None:
    data = motion()
    data["q"][50] = data["q"][49]
    log = read(data)
    assert log.commands is not None
    assert_close(log.commands.q[50], data["q"][49])
    assert np.abs(log.recording.q[50] - data["q"][49]).max() > 1e-4


@pytest.mark.parametrize(
    ("pd", "said"),
    [
        ({"delay": "profil"}, "Did you mean 'profile'"),
        ({"delay": "-5 ms"}, "must not be negative"),
        ({"kp": [20.0, 20.0]}, "2 numbers"),
        ({"kp": 0.0}, "must be positive"),
        ({"limit": -1.0}, "must be positive"),
        ({"rate": 0.0}, "must be positive"),
        ({"q_dse": "q_des"}, "q_des"),
        ({"q_des": "q_dse"}, "Did you mean 'q_des'"),
        ({"kp": {"columns": "q", "unit": "rad"}}, "has no unit"),
    ],
)
def test_mistakes_are_answered_with_what_there_is(pd: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read(**pd)


def test_a_torque_is_measured_or_commanded() -> None:
    data = motion()
    for tau in ({}, {"columns": "q", "pd": {"q_des": "q_des", "kp": 1, "kd": 0}}):
        with pytest.raises(UsageError, match="no torque was measured"):
            log_of(data, {"joints": list(JOINTS), "rate": RATE, "tau": tau})
    both = {"pd": {"q_des": "q_des", "kp": 1.0, "kd": 0.0}, "unit": "N m"}
    with pytest.raises(UsageError, match="pd stands alone"):
        log_of(data, {"joints": list(JOINTS), "rate": RATE, "tau": both})


def test_a_transmission_is_refused() -> None:
    keys = {
        "joints": list(JOINTS), "rate": RATE, "transmission": np.eye(3).tolist(),
        "tau": {"pd": {"q_des": "q_des", "kp": 20.0, "kd": 0.5}},
    }  # fmt: skip
    with pytest.raises(UsageError, match="does not pass a transmission"):
        read_log(log_of(motion(), keys), load_robot(leg().manifest))
