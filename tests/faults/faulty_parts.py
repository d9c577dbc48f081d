"""Faulty parts of experiments, one of each kind of plug-in but methods. `act` selects what
happens."""

import ctypes
import os
import signal
import time
from pathlib import Path
from typing import Any, ClassVar

from sysid_bench.experiments.tasks.definitions import RobotTask
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.signals.log_readers.tables import DelimitedText
from sysid_bench.signals.log_table import LogTable
from sysid_bench.signals.pipelines import Raw
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.types import Metric


def perform(act: str) -> None:
    match act:
        case "crash":
            ctypes.string_at(0)
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "hang":
            time.sleep(3600)
        case "raise":
            raise ValueError(act)


class _Part:
    def __init__(self, act: str = "") -> None:
        self.act = act


class Excitation(_Part):
    def design(self, problem: Any, rng: Any) -> Any:
        perform(self.act)


class Effect(_Part):
    def prepare(self, robot: Any) -> Any:
        perform(self.act)


class ModelError(_Part):
    def apply(self, robot: Any, rng: Any) -> Any:
        perform(self.act)
        return robot


class SensorError(_Part):
    def prepare(self, robot: Any, rng: Any) -> None:
        perform(self.act)


class Pipeline(_Part):
    ideal_rates = False

    def process(self, recording: Any, joints: Any) -> Any:
        perform(self.act)
        return Raw().process(recording, joints)


class SoundPipeline(Pipeline):
    pass


class Simulation(_Part):
    def design_rate(self, recording: float) -> float:
        return recording

    def run(self, *arguments: Any) -> Any:
        perform(self.act)
        return Inverse().run(*arguments)


class SoundSimulation(Simulation):
    pass


class SoundTask(RobotTask):
    act: ClassVar[str] = ""

    def unknowns(self, *arguments: Any) -> Task:
        perform(self.act)
        return super().unknowns(*arguments)


class CrashTask(SoundTask):
    act = "crash"


class KillTask(SoundTask):
    act = "kill"


class RaiseTask(SoundTask):
    act = "raise"


class HangTask(SoundTask):
    act = "hang"


class Reader(_Part):
    suffixes: ClassVar[tuple[str, ...]] = ()

    def read(self, path: Path) -> LogTable:
        perform(self.act)
        return DelimitedText().read(path)


def metric(act: str = "") -> Metric:
    def compute(cell: Any) -> float:
        perform(act)
        return 1.0

    return Metric("mine", "Mine", compute=compute)
