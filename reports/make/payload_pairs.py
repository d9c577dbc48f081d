"""Payloads of known mass from pairs of recordings without and with it: error and interval of each.

    python reports/make/payload_pairs.py [ESTIMATOR]

Loads on a scale are those of data sets (`[[payload]]`), against every recording without a load of
the same robot, with ten unknowns and, where the set states the place of the load, with the mass
alone. Then pairs of two recordings without a load, whose mass is
zero."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any, Final

import sysid_bench
from sysid_bench import package_folders
from sysid_bench.errors import SysidBenchError
from sysid_bench.models.data_sets import SCHEME, DataSet, find_dataset
from sysid_bench.signals.log_description import LogDescription, log_description

STATED: Final = {"mass": 1.0}
"""Statement of a load where there is none: its numbers are not used."""


@dataclass(frozen=True)
class Pair:
    """Recordings without and with a load of `mass` (kg); `given`: its place is known."""

    name: str
    robot: str
    empty: str
    loaded: LogDescription
    mass: float
    given: bool = False


def _motion(data: str, motion: str, **more: Any) -> LogDescription:
    return log_description({"use": f"{SCHEME}{data}/{motion}", **more}, Path())


def known_pairs(name: str, data: DataSet) -> Iterator[Pair]:
    """Loads on a scale."""
    for pair in data.payload:
        stated = data.motions[pair.loaded].get("payload", {})
        empty = [m for m in data.motions if "payload" not in data.motions[m]]
        for motion in empty:
            for given in (False, True) if "com" in stated else (False,):
                label = f"{name} {motion}{', place given' if given else ''}"
                loaded = _motion(name, pair.loaded)
                yield Pair(label, SCHEME + name, motion, loaded, pair.mass, given)


def empty_pairs(name: str, data: DataSet) -> Iterator[Pair]:
    """Pairs of recordings without a load, one of which is taken for loaded."""
    motions = [m for m in (*data.train, *data.test) if "payload" not in data.motions[m]]
    if "pd" in data.log.get("tau", {}):  # no torque was measured
        return
    for one, other in permutations(motions[:3], 2):
        loaded = _motion(name, other, payload=STATED)
        yield Pair(f"{name} {one} {other}, nothing", SCHEME + name, one, loaded, 0.0)


def judged(pair: Pair, estimator: str) -> tuple[str, bool | None]:
    """The line of a pair, and whether its interval holds the mass; None without an interval."""
    name = pair.robot.removeprefix(SCHEME)
    # A load that is stated where there is none contradicts the gains.
    stated = find_dataset(name).described.accept
    accept = (*stated, "velocity", "gain", "current", "gravity", "columns")
    try:
        found = sysid_bench.identify(
            pair.robot, log=[_motion(name, pair.empty), pair.loaded], task="payload",
            estimator=estimator, position_given=pair.given, accept=accept,
        )["payload"]  # fmt: skip
    except SysidBenchError as error:
        return f"{pair.name:45} {pair.mass:7.3f}  {type(error).__name__}: {str(error)[:90]}", None
    ends = found["interval"] if pair.given else found["intervals"].get("mass", [None])[0]
    if ends is None:
        return f"{pair.name:45} {pair.mass:7.3f}  the mass is not identifiable", None
    low, high = ends
    held = low <= pair.mass <= high
    off = found["mass"] - pair.mass
    share = f"{100 * off / pair.mass:+6.1f} %" if pair.mass else 8 * " "
    return (
        f"{pair.name:45} {pair.mass:7.3f} {found['mass']:8.4f} {share} [{low:.4f}, {high:.4f}] "
        f"{'held' if held else 'MISSED'}",
        held,
    )


def main(estimator: str = "wls") -> None:
    """Print a line for each pair, then the counts of each kind."""
    sets: Mapping[str, DataSet] = {
        name: find_dataset(name).described for name in package_folders.dataset_files()
    }
    for title, pairs_of in (("weighed loads", known_pairs), ("no load", empty_pairs)):
        counted: list[bool] = []
        for name, data in sets.items():
            for pair in pairs_of(name, data):
                line, held = judged(pair, estimator)
                print(line, flush=True)
                counted += [] if held is None else [held]
        print(f"{title}: {sum(counted)} of {len(counted)} held at 95 %", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
