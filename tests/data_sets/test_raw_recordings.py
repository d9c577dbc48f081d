"""What `init log` makes of raw public recordings, against the descriptions of the data sets: right
without an edit where the file states all that is needed, else refused with what it lacks."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench import init_log
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_samples import read_samples

DATA = os.environ.get("SYSID_BENCH_DATA", "")
GAIN, GAINS, TORQUE = "currents, or torques of motors", "write kp and kd", "without torques"

RECORDINGS: dict[str, tuple[str, str]] = {
    "ur10_cb3/ur10_exciting_trajectory.db3": ("ur10/first", ""),
    "ur10/ur10_exciting_trajectory.csv": ("ur10/first", ""),
    "fer/panda_exciting_trajectory.db3": ("fer/first", ""),
    "fer/panda_exciting_trajectory.csv": ("fer/first", ""),
    "panda_gaz/exciting_traj_positions.txt panda_gaz/exciting_traj_velocity.txt "
    "panda_gaz/exciting_traj_torques.txt panda_gaz/exciting_traj_time.txt": ("panda/first", ""),
    "double_pendulum/design_A.0_20220812_061705.csv": ("double_pendulum_a/", ""),
    "double_pendulum/design_A.0_20220812_060143.csv": ("double_pendulum_a/", ""),
    "double_pendulum/design_A.0_20220812_063536_friccomp.csv": ("double_pendulum_a/", ""),
    "double_pendulum/design_C.0_20220914_00.csv": ("double_pendulum_c/", ""),
    "double_pendulum/design_C.1_20230629_154220.csv": ("double_pendulum_c/", ""),
    **{f"go2/run_{n}.npz": (f"go2/run-{n}", "") for n in range(6)},
    "aliengo/run_0.npz": ("aliengo/", ""),
    # The gains of drives, servos and gears stand in none of these files.
    "formats_generated/aloha_episode_0.hdf5": ("go2/run-0", GAINS),
    "formats_generated/lerobot_v2": ("go2/run-0", GAINS),
    "formats_generated/lerobot_v3": ("go2/run-0", GAINS),
    "so101_sage/multisine/state_motor.csv so101_sage/multisine/control.csv": (
        "so101/multisine",
        GAINS,
    ),
    "so101_sage/large_amplitude/state_motor.csv so101_sage/large_amplitude/control.csv": (
        "so101/large-amplitude",
        GAINS,
    ),
    "ur10e/ur-20_02_10-30sec_12harm.csv": ("ur10e/fourier-30s", GAIN),
    "ur10e/ur-20_02_19_14harm50secLoad.csv": ("ur10e/fourier-50s-loaded", GAIN),
    "ur10e/ur-19_10_01-13_51_41.csv": ("ur10e/short", GAIN),
    "kr300/traj_A.mat": ("kr300/A", GAIN),
    "kr300/traj_C.mat": ("kr300/C", GAIN),
    "kr300/traj_A.parquet": ("kr300/A", GAIN),
    "tiago/tiago_position.csv tiago/tiago_velocity.csv tiago/tiago_effort.csv": (
        "tiago/first",
        GAIN,
    ),
    **{
        " ".join(f"ur5_2013/{folder}/log_{s}.csv" for s in ("q_actual", "qd_actual", "i_actual")): (
            f"ur5/movement-{n}",
            GAIN,
        )
        for n, folder in (
            (1, "Movement_No1"),
            (6, "Movement_No6_Acc_slow_Verify_Model"),
            (8, "Movement_No8_Singularity_Free_1"),
        )
    },
    # Coordinates of motors, and a transmission that no file states.
    "tx40/pos_read_data.csv tx40/curr_data.csv": ("tx40/part-1", GAIN),
    "dvrk/psm_train.csv": ("dvrk_psm/2018", GAIN),
    "dvrk/mtm_train.csv": ("dvrk_mtm/", TORQUE),
}
"""Files of a recording -> the motion that describes it, and what `init log` says that it lacks."""


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize("files", RECORDINGS)
def test_a_raw_recording_is_right_or_refused(
    files: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not DATA:
        pytest.skip("SYSID_BENCH_DATA is not set")
    monkeypatch.setenv("SYSID_BENCH_DATA", DATA)
    motion, lacks = RECORDINGS[files]
    name, _, motion = motion.partition("/")
    source = f"dataset:{name}"
    target = tmp_path / "a.toml"
    result = init_log([Path(DATA, file) for file in files.split()], source, target)
    if lacks:
        assert lacks in result.doubts[0]
        assert result.next.startswith("complete tau in ")
        return
    robot = load_robot(find_manifest(source))
    got = read_description(target)
    samples = read_samples(got, robot)
    assert set(robot.torque_rows) & set(got.joints)
    if not motion or "double" in name:  # described by the columns that were measured
        measured = {part.columns[0] for part in got.signals.values()}
        assert not [column for column in measured if "filt" in str(column) or "con" in str(column)]
        return
    wanted = read_samples(
        replace(read_description(Path(f"{source}/{motion}")), rows=None, share=1.0), robot
    )
    known = list(got.joints)
    order = [known.index(joint) for joint in read_description(Path(f"{source}/{motion}")).joints]
    assert samples.signals.keys() == wanted.signals.keys()
    for signal, x in wanted.signals.items():
        np.testing.assert_allclose(
            samples.signals[signal][:, order], x, rtol=1e-7, atol=1e-7, err_msg=signal
        )
