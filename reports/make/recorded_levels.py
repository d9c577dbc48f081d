"""Do the levels L0 to L4 predict the errors of real robots? Recorded motions, replayed.

    SYSID_BENCH_DATA=... python -m reports.make.recorded_levels [--out FOLDER] [ROBOT ...]

For each robot of recorded_levels.toml:

1. WLS with the pipeline `parallel` is fitted to the recorded training logs and judged on the
   recorded test logs: the real errors, against measured torque.
2. `lmi` gives feasible viscous and Coulomb friction, offset, spring and armature from the training
   logs. With them and the inertias of its file the robot becomes a plant.
3. The plant of each level replays the recorded training and test motions. What its sensors read is
   written as logs, which go through step 1 with the same settings: the simulated errors, against
   measured torque, too.

Prints one Markdown table for all rows and one for moving rows, and writes them to FOLDER.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Final

import numpy as np
from scipy.signal import butter, sosfiltfilt

import sysid_bench
from reports.make.recorded_cases import Case, cases
from sysid_bench.errors import SysidBenchError
from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.recorded.prepare import prepare_recordings
from sysid_bench.experiments.recorded.process_log import lock_manifest
from sysid_bench.experiments.simulated.noise_free import noise_free_part
from sysid_bench.experiments.simulated.record import record
from sysid_bench.experiments.spec import ExperimentSpec, normal_noise
from sysid_bench.harness.suite.plugin_entries import with_plant_file
from sysid_bench.identification.identify import identify
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import build
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import LogDescription, read_description
from sysid_bench.simulation.motor_load import mass_matrix
from sysid_bench.types import Recording

LEVELS: Final = ("L0", "L1", "L2", "L3", "L4")
SEED: Final = 14
MOTION_BAND: Final = 10.0
"""Hz: recorded positions are commanded without what lies above, which is noise."""
MOTION_RATE: Final = 100.0
"""Hz: rate of motion files."""
CONTROL_RATE: Final = 1000.0
"""Rate (Hz) of the levels' control loop, which rates of recordings divide."""
ROTOR: Final = 0.05
"""Least inertia of a rotor over that of its joint, where neither fit nor file has one: on the last
joints the fit cannot tell a rotor from its link."""


@dataclass(frozen=True)
class Errors:
    """Held-out torque errors on all rows and on moving rows."""

    all: float
    moving: float


def errors_of(
    case: Case,
    training: Sequence[LogDescription],
    tests: Sequence[LogDescription],
    choose: tuple[str, ...] = (),
) -> Errors:
    """The errors of WLS, fitted to training logs and judged on test logs; `choose`: terms of
    coupled drives that cross-validation within the training logs may add."""
    named = {test.source.stem: test for test in tests}
    options = replace(case.options, candidates=choose)
    posed = prepare_recordings(case.manifest, training, named, options)
    beta = identify(build("estimator", {"use": "wls"}), posed.problem, posed.experiment).beta
    assert beta is not None
    parts = (posed.held_out, posed.held_out_moving)
    return Errors(*(float(RowErrors(list(p.values()), beta).torque_error or 0.0) for p in parts))


def feasible_terms(case: Case) -> dict[str, dict[str, float]]:
    """Joint terms of a feasible fit to the training logs, by joint and name."""
    found = sysid_bench.identify(
        case.robot, log=case.logs("train"), estimator="lmi", pipeline=case.options.pipeline,
        terms=case.options.terms, accept=case.described.accept,
    )  # fmt: skip
    return {
        joint: {name: float(term["value"]) for name, term in terms.items()}
        for joint, terms in found.joints.items()
    }


def plant_robot(case: Case) -> RobotModel:
    """The robot with the inertias of its file and the terms of the feasible fit."""
    logs = [*case.logs("train"), *case.logs("test")]
    manifest = lock_manifest(case.manifest, load_robot(case.manifest), logs)
    bare = load_robot(manifest)
    inertia = dict(zip(bare.rows, np.diag(mass_matrix(bare.mj)), strict=True))
    joints = dict(manifest.joints)
    for name, terms in feasible_terms(case).items():
        if name not in bare.rows:
            continue
        own = {key: x for key, x in terms.items() if key in JointTerms.model_fields}
        if "armature" in own and bare.coupling is None:
            rotor = float(bare.joint_terms.armature[bare.rows.index(name)])
            own["armature"] = max(own["armature"], rotor, ROTOR * float(inertia[name]))
        before = joints[name].model_dump() if name in joints else {}
        joints[name] = JointTerms.model_validate(before | own)
    return load_robot(replace(manifest, joints=joints))


def level_of(name: str, robot: RobotModel) -> dict[str, Any]:
    """The plant of a level; coupled joints have no elastic transmission."""
    plant: dict[str, Any] = with_plant_file({"use": name}, None)
    if robot.coupling is not None:
        plant["effects"] = [e for e in plant["effects"] if not is_elastic(e)]
    return plant


def is_elastic(effect: Any) -> bool:
    """True for the effect that coupled joints do not support."""
    return isinstance(effect, Mapping) and effect["use"] == "elastic-joints"


def write_motion(file: Path, recorded: Recording, robot: RobotModel) -> None:
    """Write recorded positions below MOTION_BAND, with even times, as a motion file."""
    names = [robot.rows[dof] for dof in robot.torque_dofs]
    q = recorded.q[
        :, [joint.qadr for name in names for joint in robot.joints if joint.name == name]
    ]
    if recorded.rate > 2.5 * MOTION_BAND:
        q = sosfiltfilt(butter(2, MOTION_BAND, fs=recorded.rate, output="sos"), q, axis=0)
    q = q[:: max(1, int(recorded.rate / MOTION_RATE))]
    t = np.arange(len(q)) * max(1, int(recorded.rate / MOTION_RATE)) / recorded.rate
    rows = np.column_stack([t, q])
    np.savetxt(file, rows, delimiter=",", header=",".join(["t", *names]), comments="", fmt="%.12g")


def simulated_log(case: Case, robot: RobotModel, level: str, log: LogDescription) -> LogDescription:
    """The log of a level's plant on the motion of a recorded log."""
    recorded = read_log(log, load_robot(replace(case.manifest, locked=robot.manifest.locked)))
    folder = case.folder / level
    folder.mkdir(exist_ok=True)
    motion = folder / f"{log.source.stem}-motion.csv"
    write_motion(motion, recorded.recording, robot)
    rate = round(recorded.recording.rate)
    spec = spec_of(case, level_of(level, robot), motion.name, rate_of_simulation(rate))
    raw = simulated(spec, LoadedRobot(robot, folder))
    return write_log(folder / log.source.stem, raw, rate, robot)


def rate_of_simulation(rate: int) -> float:
    """The rate (Hz) of a simulated recording: that of the log where it divides CONTROL_RATE, else
    CONTROL_RATE, or a quarter of it for slow logs, which are interpolated."""
    if CONTROL_RATE % rate == 0:
        return float(rate)
    return CONTROL_RATE if rate > CONTROL_RATE / 4 else CONTROL_RATE / 4


def spec_of(case: Case, plant: Mapping[str, Any], motion: str, rate: float) -> ExperimentSpec:
    """The simulated experiment of a level on a motion file, named without its folder: seeds depend
    on the name."""
    simulation = plant["simulation"]
    simulation = {"use": simulation} if isinstance(simulation, str) else dict(simulation)
    return ExperimentSpec(
        seed=SEED,
        robot=case.name,
        payload="none",
        task="robot",
        terms=case.options.terms,
        plant={
            key: x for key, x in plant.items() if key not in ("simulation", "noise", "pipeline")
        },
        prior="none",
        excitation={"use": "file", "file": motion, "limits": "mark"},
        held_out=(),
        simulation=simulation,
        rate=rate,
        noise=normal_noise(plant["noise"]),
        signals={},
        repeat=0,
    )


def simulated(spec: ExperimentSpec, loaded: LoadedRobot) -> Recording:
    """What the sensors of a simulated experiment read."""
    return record(spec, noise_free_part(spec, loaded).simulated).raw


def write_log(stem: Path, raw: Recording, rate: int, robot: RobotModel) -> LogDescription:
    """Write a recording at `rate` (Hz) as CSV with its description."""
    names = [robot.rows[dof] for dof in robot.torque_dofs]
    q = raw.q[:, [joint.qadr for name in names for joint in robot.joints if joint.name == name]]
    t = raw.t[0] + np.arange(int((raw.t[-1] - raw.t[0]) * rate + 1.000001)) / rate
    signals = np.hstack([q, raw.tau])
    if abs(raw.rate - rate) > 1e-6 * rate and raw.rate > rate:
        signals = np.stack([np.interp(t, raw.t, x) for x in signals.T], axis=1)
    else:
        t, rate = raw.t, round(raw.rate)
    np.savetxt(stem.with_suffix(".csv"), signals, delimiter=",", fmt="%.12g")
    n = len(names)
    columns = [list(range(1, n + 1)), list(range(n + 1, 2 * n + 1))]
    stem.with_suffix(".toml").write_text(
        f'file   = "{stem.name}.csv"\nrate   = "{rate} Hz"\njoints = {json.dumps(names)}\n'
        f"q      = {{ columns = {columns[0]} }}\ntau    = {{ columns = {columns[1]} }}\n",
        encoding="utf-8",
    )
    return read_description(stem.with_suffix(".toml"))


def compared(case: Case, levels: Sequence[str]) -> Iterator[tuple[str, Errors]]:
    """Yield ("real", errors), then those of each level."""
    training, tests = case.logs("train"), case.logs("test")
    coupled = case.described.choose  # drives that the plant does not couple
    yield "real", errors_of(case, training, tests, coupled)
    robot = plant_robot(case)
    for level in levels:
        logs = [
            [simulated_log(case, robot, level, log) for log in use] for use in (training, tests)
        ]
        yield level, errors_of(case, logs[0], logs[1])


def markdown(rows: Mapping[str, Mapping[str, Errors]], which: str, levels: Sequence[str]) -> str:
    """One table of errors and of their ratios to the real ones."""
    head = ["robot", "real", *levels, *(f"{level} / real" for level in levels)]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    for name, found in rows.items():
        values = {key: getattr(errors, which) for key, errors in found.items()}
        real = values["real"]
        shown = [f"{values[key]:.3g}" if key in values else "-" for key in ("real", *levels)]
        shown += [f"{values[key] / real:.2g}" if key in values else "-" for key in levels]
        lines.append(f"| {name} | " + " | ".join(shown) + " |")
    return "\n".join(lines)


def main() -> None:
    """Compare the named robots, or all, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--levels", nargs="+", default=list(LEVELS))
    given = parser.parse_args()
    out = given.out or Path(mkdtemp())
    rows: dict[str, dict[str, Errors]] = {}
    for case in cases(given.robots, out):
        rows[case.name] = {}
        try:
            for key, errors in compared(case, given.levels):
                rows[case.name][key] = errors
                print(case.name, key, f"{errors.all:.4g} {errors.moving:.4g}", flush=True)
        except SysidBenchError as error:
            print(f"{case.name}: {error}", flush=True)
    for which in ("all", "moving"):
        table = f"{which} rows\n\n{markdown(rows, which, given.levels)}\n"
        (out / f"{which}.md").write_text(table, encoding="utf-8")
        print(table)


if __name__ == "__main__":
    main()
