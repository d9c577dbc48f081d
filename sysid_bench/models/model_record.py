"""Record of a robot's model, its hash and its behaviour, kept by the content of its files.

Planning asks for it; loading MuJoCo takes longer than all else that a plan does.
"""

import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.input_files import is_file, parse_json, read_text
from sysid_bench.models.behaviour_change import behaviour_changes
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.sources import model_states
from sysid_bench.package_folders import cache_folder, package_folder
from sysid_bench.version_fields import PACKAGE_FOLDER, source_hash, version_fields

ModelRecord = Mapping[str, Any]
"""{"hash": 16 hex digits of the canonical model, "behaviour": see `behaviour`}."""


def model_record(
    source: str, robots_dir: Path | None, folder: Path | None, free_base: bool | None = None
) -> ModelRecord | None:
    """Return the record of a robot without payload; None for a model that is not here or cannot be
    loaded, whose cells say why."""
    with suppress(SysidBenchError, OSError):
        return _record(find_manifest(source, robots_dir, folder), free_base)
    return None


def seed_content(manifest: Manifest, free_base: bool | None = None) -> str | None:
    """Return what the seeds of a robot without a name are made of, as in suites: the hash of its
    model, which a comment in a file does not change; None for one that has a name."""
    if manifest.content is not None or not manifest.by_path:
        return manifest.content
    return str(_record(manifest, free_base)["hash"])


def _record(manifest: Manifest, free_base: bool | None) -> ModelRecord:
    """Return the record of a robot, kept or computed; raise SysidBenchError where it is neither."""
    free = manifest.free_base if free_base is None else free_base
    file = cache_folder() / f"{_key(manifest, free)}.model"
    with suppress(OSError, ValueError):
        record = parse_json(read_text(file))
        if isinstance(record, dict) and record.keys() == {"hash", "behaviour"}:
            return record
    from sysid_bench.models.behaviour import computed_record  # loads MuJoCo

    record = computed_record(manifest, free)
    _keep(file, json.dumps(record))
    return record


def check_name(manifest: Manifest) -> None:
    """Raise UsageError for a robot.toml with the name of an installed robot that is another one:
    rankings, baselines and sites know robots by their names."""
    file = manifest.manifest_file
    installed = package_folder("robots") / manifest.name / "robot.toml"
    if file is None or not is_file(installed) or file.resolve() == installed.resolve():
        return
    own, known = (model_record(str(one), None, None) for one in (file, installed))
    if own is not None and known is not None and own["hash"] != known["hash"]:
        changes = behaviour_changes("", known["behaviour"], own["behaviour"])
        what = f": {changes[0].joint or 'robot'}, {changes[0].quantity}" if changes else ""
        raise UsageError(
            f"{file} is called {manifest.name!r} as an installed robot, and is another one{what}; "
            "give it another name."
        )


def _key(manifest: Manifest, free: bool) -> str:
    """Hash of all that decides on a record: the manifest, files, this package and its libraries."""
    # Where files lie does not count, except that meshes are looked for around them.
    anywhere = replace(manifest, path=Path(), assets=None, manifest_file=None)
    stated = repr(replace(anywhere, content=None, by_path=False))
    files = [] if manifest.text is not None else model_states(str(manifest.path))
    code = source_hash(str(PACKAGE_FOLDER / "models"))
    return canonical_hash([stated, free, files, code, version_fields()])


def _keep(file: Path, text: str) -> None:
    """Store a record; a folder that cannot be written costs the next plan the loading."""
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", dir=file.parent, suffix=".part", delete=False, encoding="utf-8"
        ) as part:
            part.write(text)
        os.replace(part.name, file)
