"""Fingerprint of a cell: hash of the code, models, plug-ins and libraries behind its row."""

import hashlib
import importlib.util
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from sysid_bench import naming
from sysid_bench.canonical_json import digest
from sysid_bench.errors import SysidBenchError
from sysid_bench.harness.plan import Cell
from sysid_bench.models.manifest import find_manifest
from sysid_bench.naming import resolve_paths
from sysid_bench.versions import PACKAGE_FOLDER, source_hash, versions

_INCLUDE = re.compile(rb"""<include\s+file\s*=\s*["']([^"']+)["']""")


def fingerprint(paths: Iterable[Path], plugins: Iterable[str]) -> str:
    """Return 16 hex digits of this package's source, the bytes of model files (with the includes of
    an MJCF) and motions, the files of plug-ins ("module:object", "file:x.py:object") and versions.

    A plug-in counts with the whole package that holds it. Files are read once per process.
    """
    models = tuple(sorted(str(Path(path).resolve()) for path in paths))
    return _fingerprint(models, tuple(sorted(set(plugins))))


def cell_fingerprint(
    cell: Cell,
    robots_dir: Path | None,
    folder: Path | None,
    metrics: Sequence[Mapping[str, Any]] = (),
) -> str:
    """Return the fingerprint of all that the row of a cell depends on, the specs of its plug-in
    `metrics` included; "" for an absent robot."""
    spec = cell.spec
    plugins: dict[str, list[Mapping[str, Any]]] = {
        "task": [{"use": spec.task}],
        "plant": [spec.plant],
        "excitation": [spec.excitation, *spec.held_out],
        "simulation": [spec.simulation],
        "estimator": [cell.estimator],
        "metric": [*metrics],
    }
    files = _model_files(spec.robot, robots_dir, folder)
    if not files:
        return ""
    named = [(kind, plugin) for kind, group in plugins.items() for plugin in group]
    targets = [_target(kind, plugin, folder) for kind, plugin in named]
    specs = [resolve_paths(plugin, folder) for _, plugin in named]
    read = [Path(spec["file"]) for spec in specs if isinstance(spec.get("file"), str)]
    if spec.log is not None:
        from sysid_bench.experiments.recorded.prepare import log_files

        used = [
            _target("task", {"use": spec.task}, folder),
            _target("estimator", cell.estimator, folder),
            *(_target("metric", metric, folder) for metric in metrics),
        ]
        return fingerprint([*files, *log_files(spec.log, folder or Path())], used)
    return fingerprint([*files, *read], targets)


@cache
def _model_files(robot: str, robots_dir: Path | None, folder: Path | None) -> tuple[Path, ...]:
    try:
        manifest = find_manifest(robot, robots_dir, folder)
    except SysidBenchError:
        return ()
    return tuple(path for path in (manifest.path, manifest.manifest_file) if path is not None)


def _target(kind: str, plugin: Mapping[str, Any], folder: Path | None) -> str:
    use = str(resolve_paths(plugin, folder)["use"])
    return use if ":" in use else naming.known(kind).get(use, use)


@cache
def _fingerprint(models: tuple[str, ...], plugins: tuple[str, ...]) -> str:
    parts = [
        source_hash(str(PACKAGE_FOLDER)),
        [_model(path) for path in models],
        [_plugin(name) for name in plugins],
        versions(),
        sys.version_info[:2],
    ]
    return digest(parts)[:16]


@cache
def _file(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return "absent"


@cache
def _model(path: str) -> list[str]:
    """Return the hashes of a model file and of its includes."""
    hashes, waiting = {}, [Path(path)]
    while waiting:
        file = waiting.pop()
        if str(file) in hashes:
            continue
        hashes[str(file)] = _file(str(file))
        if hashes[str(file)] != "absent":
            names = _INCLUDE.findall(file.read_bytes())
            waiting += [file.parent / name.decode(errors="replace") for name in names]
    return list(hashes.values())


@cache
def _plugin(name: str) -> str:
    module = name.rpartition(":")[0] or name
    if module.startswith("file:"):
        return _file(module.removeprefix("file:"))
    root = module.partition(".")[0]
    if root == PACKAGE_FOLDER.name:
        return ""  # part of every fingerprint already
    try:
        spec = importlib.util.find_spec(root)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return "absent"
    if spec.submodule_search_locations:
        return digest([source_hash(folder) for folder in spec.submodule_search_locations])
    return _file(spec.origin) if spec.origin else "absent"
