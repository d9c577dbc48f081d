"""Verdicts on `init log` of raw public recordings: right without an edit, refused, or wrong.

    SYSID_BENCH_DATA=... python -m reports.make.raw_recordings

Right: the description reads the signals that the description of the data set does. Refused: no
torques are read, and the first doubt names what the files do not state. Prints a Markdown table.
"""

import os
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Final

import numpy as np

from sysid_bench import init_log
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.signals.log_description import read_description
from sysid_bench.signals.log_guess import GAINS_OF_FILE
from sysid_bench.signals.log_samples import Samples, read_samples

GAIN, GAINS, TORQUE = "currents, or torques of motors", "write kp and kd", "without torques"

RECORDINGS: Final[dict[str, tuple[str, str]]] = {
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
    # Currents, whose gains are in the controller's own columns.
    "ur10e/ur-20_02_10-30sec_12harm.csv": ("ur10e/fourier-30s", ""),
    "ur10e/ur-20_02_12-40sec_12harm.csv": ("ur10e/fourier-40s", ""),
    "ur10e/ur-20_02_19_14harm50sec.csv": ("ur10e/fourier-50s", ""),
    "ur10e/ur-20_02_19_14harm50secLoad.csv": ("ur10e/fourier-50s-loaded", ""),
    "ur10e/ur-19_10_01-13_51_41.csv": ("ur10e/short", ""),
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
"""Files of a recording -> the motion that describes it, and what `init log` says that it lacks,
"" where the files state all that is needed."""

GAIN_ERROR: Final = 0.05
"""Largest difference of gains: the data set takes those of its joints at rest."""


def verdict(files: str, target: Path) -> str:
    """Write the description to `target`; return right, "refused: " or "started: " with the
    reason, or "wrong: " with the differences."""
    motion, lacks = RECORDINGS[files]
    name, _, motion = motion.partition("/")
    source = f"dataset:{name}"
    data = os.environ["SYSID_BENCH_DATA"]
    result = init_log([Path(data, file) for file in files.split()], source, target)
    if result.next.startswith("complete tau"):
        doubt = result.doubts[0]
        return f"refused: {lacks}" if lacks and lacks in doubt else f"wrong: refused, {doubt}"
    if lacks and any(GAINS_OF_FILE in doubt for doubt in result.doubts):
        return f"started: {lacks}; those of the model file stand there as a start"
    robot = load_robot(find_manifest(source))
    got = read_description(target)
    samples = read_samples(got, robot)
    if lacks or not set(robot.torque_rows) & set(got.joints):
        return f"wrong: read, and it lacks {lacks or 'the joints'}"
    if not motion or "double" in name:  # described by the columns that were measured
        measured = {str(part.columns[0]) for part in got.signals.values()}
        other = [column for column in measured if "filt" in column or "con" in column]
        return f"wrong: {other} are not measured" if other else "right"
    described = read_description(Path(f"{source}/{motion}"))
    wanted = read_samples(replace(described, rows=None, share=1.0), robot)
    order = [list(got.joints).index(joint) for joint in described.joints]
    found = [signal for signal in wanted.signals if not is_same(signal, samples, wanted, order)]
    if samples.signals.keys() != wanted.signals.keys():
        found.append("the signals")
    return f"wrong: {', '.join(found)}" if found else "right"


def is_same(signal: str, samples: Samples, wanted: Samples, order: list[int]) -> bool:
    """True for equal numbers, torques of currents apart from an error of each gain."""
    x, y = samples.signals[signal][:, order], wanted.signals[signal]
    ratio = np.ones(x.shape[1])
    if signal == "tau":
        size = np.nansum(y * y, axis=0)
        ratio[size > 0] = (np.nansum(x * y, axis=0) / np.maximum(size, 1e-300))[size > 0]
        if (np.abs(ratio - 1.0) > GAIN_ERROR).any():
            return False
    return bool(np.allclose(x, y * ratio, rtol=1e-7, atol=1e-7, equal_nan=True))


def main() -> None:
    """Print a line for each recording, and the counts."""
    print("| recording | data set | verdict |\n| --- | --- | --- |")
    found = []
    for files, (motion, _) in RECORDINGS.items():
        first, *more = files.split()
        found.append(verdict(files, Path(mkdtemp()) / "a.toml"))
        also = f" and {len(more)} more" if more else ""
        print(f"| {first}{also} | {motion} | {found[-1]} |", flush=True)
    words = [text.partition(":")[0] for text in found]
    counts = ", ".join(
        f"{words.count(word)} {word}" for word in ("right", "refused", "started", "wrong")
    )
    print(f"\n{len(found)} recordings: {counts}")


if __name__ == "__main__":
    main()
