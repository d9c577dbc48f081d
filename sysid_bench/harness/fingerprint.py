"""Fingerprint of a cell: hash of the code, models, plug-ins and libraries behind its row."""

import importlib.util
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from sysid_bench import plugin_names
from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import SysidBenchError
from sysid_bench.experiments.simulated.composed_plant import plant_entries
from sysid_bench.experiments.third_party import stale_sources
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.coverage import RowCounts
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.model import Suite
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.sources import ABSENT, file_state, model_states
from sysid_bench.plugin_names import resolve_files
from sysid_bench.types import Row
from sysid_bench.version_fields import PACKAGE_FOLDER, source_hash, version_fields


def fingerprint(paths: Iterable[Path], plugins: Iterable[str]) -> str:
    """Return 16 hex digits of this package's source, the bytes of model files (with all that they
    name) and motions, the files of plug-ins ("module:object", "file:x.py:object") and versions; ""
    where one of them is absent.

    A plug-in counts with the whole package that holds it. Files are read once per process.
    """
    models = tuple(sorted(str(Path(path).resolve()) for path in paths))
    if not all(map(os.path.exists, models)):  # now, whatever was read before
        return ""
    return _fingerprint(models, tuple(sorted(set(plugins))))


def cell_fingerprint(
    cell: Cell,
    robots_dir: Path | None,
    folder: Path | None,
    metrics: Sequence[Mapping[str, Any]] = (),
) -> str:
    """Return the fingerprint of all that the row of a cell depends on, the specs of its plug-in
    `metrics` included; "" where a part of it is absent."""
    spec = cell.spec
    files = _model_files(spec.robot, robots_dir, folder)
    if files is None:
        return ""
    used: list[tuple[str, Mapping[str, Any]]] = [("task", {"use": spec.task})]
    used.append(("estimator", cell.estimator))
    used += [("pipeline", spec.pipeline)] if spec.pipeline is not None else []
    used += [("metric", metric) for metric in metrics]
    if spec.log is not None:
        # Here, for recordings alone: planning asks for fingerprints and imports nothing heavy.
        from sysid_bench.experiments.recorded.prepare import log_files

        read = log_files(spec.log, folder or Path())
    else:
        used += [("excitation", motion) for motion in (spec.excitation, *spec.held_out)]
        used += [("simulation", spec.simulation), *plant_entries(spec.plant)]
        named = (resolve_files(plugin, folder).get("file") for _, plugin in used)
        read = [Path(file) for file in named if isinstance(file, str)]
    targets = []
    for kind, plugin in used:
        use = str(resolve_files(plugin, folder)["use"])
        targets.append(use if ":" in use else plugin_names.known(kind).get(use, use))
    return fingerprint([*files, *read], targets)


@cache
def _model_files(
    robot: str, robots_dir: Path | None, folder: Path | None
) -> tuple[Path, ...] | None:
    """Files of a robot, none of a generated one; None for an unknown robot."""
    try:
        manifest = find_manifest(robot, robots_dir, folder)
    except SysidBenchError:
        return None
    files = (manifest.path if manifest.text is None else None, manifest.manifest_file)
    return tuple(filter(None, files))


@cache
def _fingerprint(models: tuple[str, ...], plugins: tuple[str, ...]) -> str:
    files = [_model(path) for path in models]
    code = [_plugin(name) for name in plugins]
    if ABSENT in (*(state for states in files for state in states), *code):
        return ""
    own = source_hash(str(PACKAGE_FOLDER))
    return canonical_hash([own, files, code, version_fields(), sys.version_info[:2]])[:16]


_file = cache(file_state)
_model = cache(model_states)


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
        return ABSENT
    if spec is None:
        return ABSENT
    if spec.submodule_search_locations:
        # The whole package: an edit of a helper module that the plug-in imports counts as well.
        return canonical_hash(list(map(source_hash, spec.submodule_search_locations)))
    return _file(spec.origin) if spec.origin else ABSENT


def is_stale(row: Row, fingerprint: str) -> bool:
    """True where a row depends on code, models or libraries that differ now.

    What is gone (an empty `fingerprint`, an absent file) proves nothing: such a row is not stale.
    """
    # Absent files prove nothing: else a moved folder turned 6 of 8 good rows into failures.
    if fingerprint and row.get("fingerprint") != fingerprint:
        return True
    # What a plug-in's file imports is in no fingerprint; rows state the files that were loaded.
    return bool(stale_sources(row.get("sources") or {}))


def current_fingerprint(suite: Suite, robots_dir: Path | None) -> Callable[[Cell], str]:
    """Return a function that gives the fingerprint of a cell now; cells share it by their parts."""
    metrics = [entry.spec for entry in suite.metric]
    known: dict[str, str] = {}

    def fingerprint(cell: Cell) -> str:
        # Cells differ by seed, noise and repeat, and share their code and models.
        key = cell.code_key
        if key not in known:
            known[key] = cell_fingerprint(cell, robots_dir, suite.folder, metrics)
        return known[key]

    return fingerprint


def other_code(folder: RunFolder, counts: RowCounts) -> int:
    """Return the number of rows of a run that are from other code, models or libraries than now."""
    fingerprint = current_fingerprint(folder.suite, folder.suite.robots_folder)
    cells = folder.cells_at({kind.cell for kind in counts.rows})
    # One cell for each kind of row: a status over a million rows stays quick.
    now = {place: fingerprint(cell) for place, cell in cells.items()}
    others = 0
    for kind, count in counts.rows.items():
        sources = json.loads(kind.sources) if kind.sources else {}
        row = {"fingerprint": kind.fingerprint, "sources": sources}
        others += count * is_stale(row, now[kind.cell])
    return others


def stale_note(count: int) -> str:
    """Return the sentence on rows of other code; empty for none."""
    if not count:
        return ""
    rows = "1 row is" if count == 1 else f"{count} rows are"
    return (
        f"{rows} from other code, models or libraries than now; --rerun stale computes them again."
    )
