"""What depends on the robot alone, kept by a worker between its experiments."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from sysid_bench.evaluation.crosscheck import CrossCheck, crosscheck
from sysid_bench.harness.canonical import canonical
from sysid_bench.identifiability.structural import structural_base
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import BaseMap

KEPT = 16
"""Robots with payloads that a worker keeps: a few megabytes each."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A loaded robot with its payload, cross-checked once."""

    robot: RobotModel

    @cached_property
    def check(self) -> CrossCheck:
        """The verdict of the two engines."""
        return crosscheck(self.robot)

    @cached_property
    def _bases(self) -> dict[tuple[str, ...], BaseMap]:
        return {}

    def base(self, parameters: tuple[str, ...]) -> BaseMap:
        """The base parameters of a task."""
        if parameters not in self._bases:
            self._bases[parameters] = structural_base(self.robot, parameters)
        return self._bases[parameters]


def subject(
    source: str,
    payload: str | Mapping[str, Any],
    robots_dir: str | None,
    folder: str | None,
    free_base: bool | None = None,
) -> Subject:
    """The robot called `source` with a payload, loaded at most once per worker; `free_base`
    overrides its manifest."""
    return _subject(source, canonical(payload), robots_dir, folder, free_base)


@lru_cache(maxsize=KEPT)
def _subject(
    source: str,
    payload: str,
    robots_dir: str | None,
    folder: str | None,
    free_base: bool | None,
) -> Subject:
    import json

    manifest = find_manifest(
        source, *(None if p is None else Path(p) for p in (robots_dir, folder))
    )
    return Subject(load_robot(manifest, parse_payload(json.loads(payload)), free_base))
