"""Robots, their cross-checks and base parameters, cached by a worker between experiments."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from sysid_bench.canonical_json import canonical
from sysid_bench.evaluation.crosscheck import Crosscheck, crosscheck
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.plugin_names import build, resolve, resolve_files
from sysid_bench.types import BaseMap

KEPT = 16
"""Robots with payloads in the cache of a worker: a few megabytes each."""


@dataclass(frozen=True, eq=False)
class LoadedRobot:
    """A robot with its payload, cross-checked once; `folder` is the one of the suite, to which
    the files of its plug-ins are relative."""

    robot: RobotModel
    folder: Path | None = None

    def build_plugin(self, kind: str, spec: Mapping[str, Any]) -> Any:
        """The plug-in that a suite names, built with its settings."""
        return build(kind, resolve_files(spec, self.folder))

    def plugin_of(self, kind: str, spec: Mapping[str, Any]) -> Any:
        """The object that `build_plugin` calls with the settings."""
        return resolve(kind, str(resolve_files(spec, self.folder)["use"]))

    @cached_property
    def check(self) -> Crosscheck:
        """Comparison of the two engines."""
        return crosscheck(self.robot)

    @cached_property
    def _bases(self) -> dict[tuple[Any, ...], BaseMap]:
        return {}

    def base_map(
        self,
        parameters: tuple[str, ...],
        rows: tuple[str, ...] | None = None,
        cuts: tuple[SensorSubtree, ...] = (),
    ) -> BaseMap:
        """The base parameters of a task; `rows`: the measured degrees of freedom (None: all), or
        the components of the sensors `cuts`."""
        key = parameters, rows, tuple(cut.at for cut in cuts)
        if key not in self._bases:
            self._bases[key] = structural_base(self.robot, parameters, rows, cuts)
        return self._bases[key]


def loaded_robot(
    source: str,
    payload: str | Mapping[str, Any],
    robots_dir: str | None,
    folder: str | None,
    free_base: bool | None = None,
) -> LoadedRobot:
    """The robot `source` with a payload, loaded at most once per worker; `free_base` overrides its
    manifest. Raises UsageError for unknown names, ModelError for unusable files."""
    return _load(source, canonical(payload), robots_dir, folder, free_base)


@lru_cache(maxsize=KEPT)
def _load(
    source: str, payload: str, robots_dir: str | None, folder: str | None, free_base: bool | None
) -> LoadedRobot:
    robots, suite = (None if path is None else Path(path) for path in (robots_dir, folder))
    manifest = find_manifest(source, robots, suite)
    return LoadedRobot(load_robot(manifest, parse_payload(json.loads(payload)), free_base), suite)
