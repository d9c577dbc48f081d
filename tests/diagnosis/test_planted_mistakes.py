"""Mistakes planted in recordings of real robots: the right cause first, no absurd factor, and no
refusal of what can be used."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from reports.make.mistakes_to_plant import HARMLESS, MISTAKES
from reports.make.planted_mistakes import Bench, Case, cases_of, line
from reports.make.recordings_to_diagnose import recorded_motions, recorded_subjects, with_tool
from sysid_bench.commands.diagnose import diagnose
from sysid_bench.signals.log_description import description_of

pytestmark = pytest.mark.usefixtures("data_folder")

PARTS = 7
"""Of the mistakes in each recording one in seven, of all recordings each: a minute."""


@cache
def planted() -> tuple[Case, ...]:
    """A part of the mistakes in one recording of each data set, with a tool and without in turn."""

    def cases() -> Iterator[Case]:
        for k, one in enumerate(recorded_subjects()):
            # Training motions of even sets and test motions of odd ones, or the other way round.
            if k % 4 in (0, 3):
                is_loaded = k % 3 == 0
                yield from cases_of(
                    Bench(with_tool(one) if is_loaded else one, is_loaded), k, PARTS
                )

    return tuple(cases())


@pytest.mark.long
def test_the_right_cause_is_named_first() -> None:
    # Recordings that contradict their model themselves are counted apart, as in the page.
    harmful = [case for case in planted() if case.is_harmful and "pendulum_c" not in case.recording]
    decidable = [case for case in harmful if not case.undecidable]
    missed = "\n".join(line(case) for case in decidable if not case.named)
    assert len(decidable) > 50
    assert len(decidable) >= 0.85 * len(harmful)
    assert np.mean([case.named for case in decidable]) >= 0.85, missed


@pytest.mark.long
def test_no_factor_is_absurd() -> None:
    absurd = [line(case) for case in planted() if case.absurd]
    assert len(absurd) <= 1, absurd


@pytest.mark.long
def test_harmless_changes_are_not_refused() -> None:
    refused = [line(case) for case in planted() if case.is_harmless and case.refused]
    assert not refused


@pytest.mark.long
def test_a_recording_without_a_mistake_is_not_refused() -> None:
    """All motions of all data sets, tests too."""
    refused = {
        name
        for name, motion in recorded_motions()
        if not diagnose(f"dataset:{name}/{motion}", f"dataset:{name}").ok
    }
    assert refused <= {"double_pendulum_c"}


@pytest.mark.parametrize("motion", ["multisine"])
def test_sizes_of_currents_of_servos_are_no_torques(data_folder: Path, motion: str) -> None:
    servos = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    given = {
        "file": str(data_folder / "so101_sage" / motion / "state_motor.csv"),
        "time": {"column": "timestamp", "unit": "us"},
        "joints": list(servos),
        "q": {"columns": "positions"},
        "tau": {"columns": "torques"},
    }
    found = diagnose(description_of(given, Path("run.toml")), "dataset:so101")
    (first,) = (one for one in found.findings if one["severity"] == "error")
    assert (first["name"], tuple(first["joints"])) == ("magnitude", servos)


@pytest.mark.parametrize("kind", ["torque without sign, all", "torque = current", "no velocities"])
def test_some_mistakes_in_one_recording(kind: str) -> None:
    one = next(iter(recorded_subjects("ur10e")))
    (mistake,) = (one for one in (*MISTAKES, *HARMLESS) if one.name == kind)
    case = Bench(one).case(mistake, 1)
    assert case.named or (case.is_harmless and not case.refused), line(case)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "kind", "joint"),
    [
        ("dvrk_mtm/rest", "direction of q and v", "j5"),
        ("ur10/rest", "torque of a motor, 1:50, one", "shoulder_pan_joint"),
    ],
)
def test_a_mistake_that_shows_behind_a_tool_alone_is_named(
    name: str, kind: str, joint: str
) -> None:
    (one,) = (one for one in recorded_subjects(name.partition("/")[0]) if one.name == name)
    (mistake,) = (one for one in MISTAKES if one.name == kind)
    bench = Bench(with_tool(one), loaded=True)
    case = bench.case(mistake, one.training.joints.index(joint))
    assert case.named, line(case)
    assert not case.absurd
