"""Recorded robots with measured torque: data sets, and their halves (recorded_levels.toml)."""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from sysid_bench.experiments.recorded.prepare import LogOptions
from sysid_bench.models.data_sets import SCHEME, DataSet, find_dataset
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.signals.log_description import LogDescription, read_description

HALVES: Final = Path(__file__).parent / "recorded_levels.toml"


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded robot, the half that it belongs to, and a folder for its simulated logs."""

    name: str
    half: str
    folder: Path

    @property
    def robot(self) -> str:
        """Source of the robot."""
        return SCHEME + self.name

    @property
    def described(self) -> DataSet:
        """The data set."""
        return find_dataset(self.name).described

    @property
    def options(self) -> LogOptions:
        """Settings of the fit, for recorded and simulated logs alike."""
        pipeline = self.described.pipeline or {"use": "parallel"}
        return LogOptions(pipeline=pipeline, terms=self.manifest.terms)

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest of the robot."""
        return find_manifest(self.robot)

    def logs(self, use: str) -> list[LogDescription]:
        """The descriptions of the "train" or "test" logs, under the names train, or train1, ..."""
        motions = self.described.train if use == "train" else self.described.test
        stems = [use] if len(motions) == 1 else [f"{use}{k + 1}" for k in range(len(motions))]
        return [
            replace(
                read_description(Path(f"{self.robot}/{motion}")),
                source=self.folder / f"{stem}.toml",
            )
            for stem, motion in zip(stems, motions, strict=True)
        ]


def cases(names: Sequence[str], out: Path) -> Iterator[Case]:
    """Yield the named cases, or all, with a folder for each below `out`."""
    halves = tomllib.loads(HALVES.read_text(encoding="utf-8"))
    for name in names or halves:
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        yield Case(name, halves[name], folder)
