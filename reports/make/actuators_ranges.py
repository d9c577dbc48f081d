"""Coverage of the ranges of new files, as Markdown: `python -m reports.make.actuators_ranges
[SET...]`.

Each file of a set is left out in turn; the 90 % ranges of `identify --task actuators` with the
others hold its own values, or do not: all values, those on a bound among them. `go2`, `so101`:
recordings below the folder of the variable SYSID_BENCH_DATA. `units`: three simulated legs with
three files each, of which the deviations between legs and between files are known.
"""

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.evaluation.intervals import at_level
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, MODEL, RATE, Case

LEVEL: Final = 0.9
MOTIONS: Final = ("multisine", "large_amplitude", "friction_gravity", "backlash_detection")
ACCEPT: Final = ["worse", "gain", "sign", "direction", "robot", "units", "velocity"]
UNITS: Final = 3
FILES: Final = 3
BETWEEN: Final = {"units": 0.2, "files": 0.05}
"""Relative deviations of the values of simulated legs."""


@dataclass(frozen=True)
class Set:
    """Files of one type of robot, and what else is unknown."""

    model: Path
    logs: tuple[Any, ...]
    also: tuple[str, ...] = ()


def main() -> None:
    """Print a line for each set and kind of value."""
    data, chosen = Path(os.environ["SYSID_BENCH_DATA"]), sys.argv[1:] or ["go2", "so101", "units"]
    print(f"| set | files | values | on a bound | {100 * LEVEL:.0f} % ranges hold |")
    print("| --- | ---: | --- | ---: | ---: |")
    notes: list[str] = []
    with TemporaryDirectory() as folder:
        for name in chosen:
            one = {"go2": _go2, "so101": _so101, "units": _units}[name](data, Path(folder))
            for line in _lines(name, one, notes):
                print(line, flush=True)
    print("".join(f"\n{note}" for note in notes))


def identified(one: Set, logs: Sequence[Any], test: Any) -> ActuatorsResult:
    """The answer to some files, each as a whole, since they are tested on another one."""
    with at_level(LEVEL):
        result = sysid_bench.identify(
            one.model, task="actuators", log=list(logs), also=one.also, accept=ACCEPT, test=[test]
        )
    assert isinstance(result, ActuatorsResult)
    return result


def _lines(name: str, one: Set, notes: list[str]) -> Iterator[str]:
    held: dict[str, list[bool]] = {term: [] for term in UNKNOWNS}
    bound: dict[str, list[bool]] = {term: [] for term in UNKNOWNS}
    for k, log in enumerate(one.logs):
        others = [x for i, x in enumerate(one.logs) if i != k]
        ranges = identified(one, others, log).files
        assert ranges is not None
        own = identified(one, [log], others[0]).joints
        for joint, values in own.items():
            for term in UNKNOWNS:
                low, high = (ranges["joints"][joint][term][end] for end in ("low", "high"))
                reach = 1e-9 * abs(high)  # rounding of a value on its bound
                held[term].append(low - reach <= values[term] <= high + reach)
                bound[term].append(term in values["at_bound"])
    every = [(term, held[term], bound[term]) for term in UNKNOWNS]
    whole = [x for term in UNKNOWNS for x in held[term]], [x for t in UNKNOWNS for x in bound[t]]
    for term, inside, on_bound in [*every, ("all", *whole)]:
        shares = f"{100 * np.mean(on_bound):.0f} % | {100 * np.mean(inside):.0f} %"
        yield f"| {name} | {len(one.logs)} | {term} | {shares} |"
    units = (identified(one, one.logs, one.logs[0]).files or {}).get("units")
    if units:
        texts = [f"{term} {_median(units, term)}" for term in UNKNOWNS[:3]]
        notes.append(
            f"{name}: median deviation between robots, and between files of one, in % of the "
            f"mean truth (planted {100 * BETWEEN['units']:.0f} and {100 * BETWEEN['files']:.0f}): "
            f"{', '.join(texts)}."
        )


def _median(units: Mapping[str, Any], term: str) -> str:
    truth = TRUTH[UNKNOWNS.index(term)]
    pairs = [
        100 * np.median([x[term][f"between_{kind}"] for x in units.values()]) / truth
        for kind in ("units", "files")
    ]
    return f"{pairs[0]:.0f} and {pairs[1]:.0f}"


def _go2(data: Path, folder: Path) -> Set:
    logs = tuple(leg_log(data / "go2", folder, run) for run in range(6))
    return Set(data / "go2" / "go2.xml", logs)


def leg_log(data: Path, folder: Path, run: int) -> Path:
    """The description of a run of a legged robot."""
    with np.load(data / f"run_{run}.npz") as found:
        joints, kp, kd = (found[name].tolist() for name in ("joints", "kp", "kd"))
    file = folder / f"{data.name}-{run}.toml"
    file.write_text(
        f'file = {json.dumps(str(data / f"run_{run}.npz"))}\nrate = "200 Hz"\n'
        f"joints = {json.dumps(joints)}\n"
        'q = { columns = "q", unit = "rad" }\nv = { columns = "v", unit = "rad/s" }\n'
        f'tau = {{ pd = {{ q_des = "q_des", kp = {kp}, kd = {kd}, delay = "profile" }} }}\n',
        encoding="utf-8",
    )
    return file


def _so101(data: Path, folder: Path) -> Set:
    model = data / "robots" / "robotstudio_so101__so101.xml"
    logs = tuple(servo_log(data, folder, model, motion) for motion in MOTIONS)
    return Set(model, logs, ("gain",))


def servo_log(data: Path, folder: Path, model: Path, motion: str) -> Path:
    """The description of a motion of a servo arm, as `init log` writes it."""
    file = folder / f"{motion}.toml"
    sysid_bench.init_log(sorted((data / "so101_sage" / motion).glob("*.csv")), model, file)
    # Positions of the gripper are shares of its range, and its rates are not.
    lines = file.read_text(encoding="utf-8").splitlines()
    file.write_text("\n".join(x for x in lines if not x.startswith("v = ")), encoding="utf-8")
    return file


TRUTH: Final[Array] = np.array([0.02, 0.12, 0.2, 0.0])


@dataclass(frozen=True)
class Unit(Case):
    """A recording of one of several legs."""

    unit: int = 0

    @property
    def values(self) -> Array:
        """True values (3, 4)."""
        legs, files = np.random.default_rng([7, self.unit]), np.random.default_rng([8, self.seed])
        shape = (len(JOINTS), 4)
        of_unit, of_file = legs.normal(size=shape), files.normal(size=shape)
        factor = 1.0 + BETWEEN["units"] * of_unit + BETWEEN["files"] * of_file
        return np.asarray(TRUTH * np.maximum(factor, 0.2))


def _units(data: Path, folder: Path) -> Set:
    model = folder / "leg.xml"
    model.write_text(MODEL, encoding="utf-8")
    logs = []
    for seed in range(UNITS * FILES):
        commands = Unit(seed, delay=0.005, disturbance=0.03, unit=seed // FILES).commands()
        arrays = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
        pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
        keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
        logs.append(sysid_bench.log_of(arrays, {**keys, "serial": f"no. {seed // FILES}"}))
    return Set(model, tuple(logs))


if __name__ == "__main__":
    main()
