"""Sources of data of one recorded robot: its recordings, and replays by plants, on which the same
methods are compared."""

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sysid_bench.apps.twins.agreement import Errors, torque_errors
from sysid_bench.apps.twins.commands.identify_twin import identify_robot, identify_twin
from sysid_bench.apps.twins.commands.transfer import CEILING, NULL, TWIN, source_label
from sysid_bench.apps.twins.recorded_robot import Posed, RecordedRobot, residual_of
from sysid_bench.apps.twins.replay import Replay, replay_rate
from sysid_bench.errors import EstimationError, SysidBenchError
from sysid_bench.harness.suite.plugin_entries import with_plant_file
from sysid_bench.models.robot import RobotModel

Tests = list[Errors]
"""Errors of each test."""


@dataclass(frozen=True, eq=False)
class TransferSource:
    """Errors of each source by draw and test, why sources failed, and the CPU time (s)."""

    errors: dict[str, list[Tests]]
    reasons: dict[str, str]
    seconds: float


@dataclass(frozen=True, eq=False)
class Sources:
    """Sources of one robot: `methods` are compared on `draws` of each that has noise."""

    recorded: RecordedRobot
    methods: tuple[str, ...]
    truths: tuple[str, ...]
    draws: int
    seed: int

    def errors(self, levels: Sequence[str]) -> "TransferSource":
        """Return the errors of the recordings, of plants by level and of twins."""
        start = time.process_time()
        found, reasons = {CEILING: [self._of(self.recorded.problems)]}, dict[str, str]()
        for truth in self.truths:
            try:
                with tempfile.TemporaryDirectory() as folder:
                    place = Path(folder) / "twin.toml"
                    robot = identify_robot(self.recorded.problems, truth, place)
            except SysidBenchError as error:
                reasons[f"all with {truth}"] = str(error).partition(". ")[0]
                continue
            for source in (*levels, NULL, TWIN):
                label = source_label(source, truth)
                try:
                    found[label] = list(self._replays(source, truth, robot))
                except SysidBenchError as error:
                    reasons[label] = f"{_setting(source)}{str(error).partition('. ')[0]}"
        return TransferSource(found, reasons, time.process_time() - start)

    def _replays(self, source: str, truth: str, robot: RobotModel) -> Iterator[Tests]:
        plant, rate = self._plant(source, truth, robot)
        for draw in range(self.draws):
            yield self._of(self.recorded.replay(plant, rate, self.draws * self.seed + draw))

    def _plant(self, source: str, truth: str, robot: RobotModel) -> tuple[Replay, float]:
        """The plant of a source and the rate (Hz) of its replays."""
        if source not in (TWIN, NULL):
            # Levels know nothing of the recordings but the motion and its rate.
            rate = self.recorded.problems.source.training[0].recording.rate
            return Replay(robot, with_plant_file({"use": source}, None)), replay_rate(rate)
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "twin.toml"
            twin = identify_twin(self.recorded, truth, place, null=source == NULL)
        return twin.replay_plant, twin.rate

    def _of(self, posed: Posed) -> Tests:
        """Errors of each method by test; of the only test, by its halves."""
        by_method: dict[str, list[float]] = {}
        for method in self.methods:
            try:
                tests = residual_of(posed, method)
            # A method that fails has no error here, and its pairs are left out (`verdict_counts`).
            except EstimationError:
                continue
            if len(tests) == 1:
                (one,), middle = tests, len(tests[0].e) // 2
                # A difference is real where it exceeds the spread between tests: of a single test,
                # its halves stand for two.
                tests = [
                    replace(one, e=one.e[half], torque=one.torque[half], t=one.t[half])
                    for half in (slice(None, middle), slice(middle, None))
                ]
            by_method[method] = [torque_errors([test]) for test in tests]
        count = min(map(len, by_method.values()), default=0)
        return [{m: tests[k] for m, tests in by_method.items()} for k in range(count)]


def _setting(source: str) -> str:
    """The simulation of a level, which errors do not name."""
    if source in (TWIN, NULL):
        return ""
    written: Any = with_plant_file({"use": source}, None).get("simulation", "inverse")
    name = written["use"] if isinstance(written, Mapping) else written
    return f"with its simulation {name!r}: "
