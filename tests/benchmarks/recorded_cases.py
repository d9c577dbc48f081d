"""Recorded robots with measured torque: their logs and what their fits need (cases.toml)."""

import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from sysid_bench.experiments.recorded.prepare import LogOptions
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.signals.log_description import LogDescription, read_description

FOLDER: Final = Path(__file__).parent / "recorded_levels"


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded robot: settings from cases.toml, and logs in `folder`."""

    name: str
    settings: Mapping[str, Any]
    folder: Path

    @property
    def options(self) -> LogOptions:
        """Settings of the fit, for recorded and simulated logs alike."""
        pipeline = self.settings.get("pipeline", {"use": "parallel"})
        return LogOptions(pipeline=pipeline, terms=self.manifest.terms)

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest of the robot in `folder`, or of one that the package has."""
        named = self.settings.get("robot")
        return find_manifest(named or str(self.folder / "robot.toml"))

    def logs(self, use: str) -> list[LogDescription]:
        """The descriptions of the "train" or "test" logs."""
        return [read_description(file) for file in sorted(self.folder.glob(f"{use}*.toml"))]


def cases(names: Sequence[str], out: Path) -> Iterator[Case]:
    """Yield the named cases, or all, with their files in a folder below `out`."""
    data = os.environ["SYSID_BENCH_DATA"]
    table = tomllib.loads((FOLDER / "cases.toml").read_text(encoding="utf-8"))
    for name in names or table:
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        for file in (FOLDER / name).iterdir():
            text = file.read_text(encoding="utf-8").replace("$SYSID_BENCH_DATA", data)
            text = text.replace("$REPOSITORY", str(FOLDER.parents[2]))
            (folder / file.name).write_text(text, encoding="utf-8")
        yield Case(name, table[name], folder)
