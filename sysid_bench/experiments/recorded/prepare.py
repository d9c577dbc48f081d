"""Recordings and what is asked of them: from descriptions to problems, for the command line and for
suites alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.recorded.locked_joints import locked_manifest
from sysid_bench.experiments.recorded.prepared_logs import PreparedLogs, build_problems
from sysid_bench.experiments.recorded.preprocess import Preprocessing, process_log
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.signals.log_checks import refuse_findings
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.processing import processing_of

FILTER: Final = "butter 4 10 Hz zero-phase"
"""Robots move below it: on a UR10e, cut-offs of 3 to 20 Hz changed the error by less than 0.3 of
7.5 % (measured)."""

SLOW: Final = 30.0
"""Hz; at lower rates that filter would touch the motion itself, and is left out."""

TERMS: Final = ("viscous", "coulomb", "offset")
"""What real joints have, where the robot's manifest says nothing."""


@dataclass(frozen=True)
class LogOptions:
    """`terms` None: the robot's own. `filter` None: FILTER, or none at low rates. `derivatives`
    None: from v where every log has v. `moving`: rows slower than this (rad/s, m/s) are left out.
    `candidates`, `position_given`: see `pose_logs`. `accept`: contradictions that may pass."""

    task: str = "robot"
    terms: tuple[str, ...] | None = None
    filter: str | None = None
    derivatives: str | None = None
    moving: float = 0.0
    candidates: tuple[str, ...] = ()
    position_given: bool = False
    accept: tuple[str, ...] = ()


def prepare_logs(
    manifest: Manifest,
    training: Sequence[LogDescription],
    tests: Mapping[str, LogDescription],
    asked: LogOptions,
) -> PreparedLogs:
    """The problems of training and test logs, joints locked that no log lists.

    Raises UsageError for files or words that cannot be, and for contradictions in the data that
    `asked.accept` does not name.
    """
    every = [*training, *tests.values()]
    manifest = locked_manifest(manifest, load_robot(manifest), every)
    treatment = _treatment(every, asked)
    read = [process_log(description, manifest, treatment) for description in every]
    for one in read:
        refuse_findings(one.log.findings, asked.accept, str(one.log.description.source))
    robot = read[0].robot
    terms = _own_terms(robot.manifest.terms, robot.rows) if asked.terms is None else asked.terms
    testing = dict(zip(tests, read[len(training) :], strict=True))
    return build_problems(
        asked.task, terms, read[: len(training)], testing, treatment, asked.candidates,
        asked.position_given,
    )  # fmt: skip


def _treatment(logs: Sequence[LogDescription], asked: LogOptions) -> Preprocessing:
    slowest = min((log.rate for log in logs if log.rate is not None), default=np.inf)
    spec: dict[str, Any] = {
        "filter": asked.filter or (FILTER if slowest > SLOW else "none"),
        "derivatives": asked.derivatives
        or ("from v" if all(log.v is not None for log in logs) else "from q"),
    }
    return Preprocessing(processing_of(spec), asked.moving, spec["filter"], spec["derivatives"])


def _own_terms(own: tuple[str, ...], rows: tuple[str, ...]) -> tuple[str, ...]:
    """The manifest's terms, those of joints that stand still left out."""
    kept = tuple(
        term for term in own if "." not in term or any(term.startswith(f"{row}.") for row in rows)
    )
    return kept or TERMS
