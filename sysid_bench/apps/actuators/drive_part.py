"""Parts of recordings of actuators: samples of a log, with the robot that moved in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sysid_bench.apps.actuators.rollout import test_end
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.process_log import lock_manifest, payload_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_checks import check_findings
from sysid_bench.signals.log_description import LogDescription


@dataclass(frozen=True, eq=False)
class DrivePart:
    """Samples `rows` of a log, with the robot that moved in it."""

    log: Log
    robot: RobotModel
    rows: slice

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.log.description.source.name

    @property
    def times(self) -> tuple[float, float]:
        """First and last time (s)."""
        first, last, _ = self.rows.indices(len(self.log.recording))
        return first / self.log.recording.rate, last / self.log.recording.rate

    def fit_part(self, share: float) -> "DrivePart":
        """Return the samples that are fitted: the first `share` of the log."""
        return replace(self, rows=slice(0, int(share * len(self.log.recording))))

    def test_part(self, share: float) -> "DrivePart":
        """Return the samples that are judged: those after the fitted `share`, or with a share of 1
        all of a test recording."""
        count = len(self.log.recording)
        first = 0 if share == 1.0 else int(share * count)
        return replace(self, rows=slice(first, max(test_end(count), first + 1)))


def read_part(log: LogDescription, manifest: Manifest, accept: Sequence[str]) -> DrivePart:
    """Return all samples of a log; raises UsageError for contradictions that `accept` does not
    name."""
    robot = load_robot(manifest, payload_of(log))
    found = read_log(log, robot)
    check_findings(found.findings, accept, str(log.source))
    return DrivePart(found, robot, slice(None))


def drive_manifest(manifest: Manifest, logs: Sequence[LogDescription]) -> Manifest:
    """Return the manifest of a robot whose joints without a log are locked, with a floating base
    where the first log records its motion."""
    whole = load_robot(manifest)
    if logs[0].base is not None and not whole.floating:
        manifest = replace(manifest, free_base=True)
        whole = load_robot(manifest)
    return lock_manifest(manifest, whole, logs, takes_base=True)


def known_delay(parts: Sequence[DrivePart]) -> float | None:
    """Return the stated delay (s), zero for measured torques; None where it is unknown.

    Raises UsageError where the recordings differ in it.
    """
    stated = {0.0 if p.log.commands is None else p.log.commands.delay for p in parts}
    if len(stated) > 1:
        raise UsageError(
            "The recordings state different delays (tau.pd.delay); identify them one by one, or "
            "write delay = 'profile' in all of them."
        )
    return stated.pop()
