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
from sysid_bench.errors import SysidBenchError
from sysid_bench.input_files import parse_json, read_text
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.sources import model_states
from sysid_bench.package_folders import cache_folder
from sysid_bench.version_fields import PACKAGE_FOLDER, source_hash, version_fields

ModelRecord = Mapping[str, Any]
"""{"hash": 16 hex digits of the canonical model, "behaviour": see `behaviour`}."""


def model_record(
    source: str, robots_dir: Path | None, folder: Path | None, free_base: bool | None = None
) -> ModelRecord | None:
    """Return the record of a robot without payload; None for a model that is not here or cannot be
    loaded, whose cells say why."""
    with suppress(SysidBenchError, OSError):
        manifest = find_manifest(source, robots_dir, folder)
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
    return None


def _key(manifest: Manifest, free: bool) -> str:
    """Hash of all that decides on a record: the manifest, files, this package and its libraries."""
    # Where files lie does not count, except that meshes are looked for around them.
    stated = repr(replace(manifest, path=Path(), assets=None, manifest_file=None, content=None))
    files = [] if manifest.text is not None else model_states(str(manifest.path))
    code = source_hash(str(PACKAGE_FOLDER / "models"))
    return canonical_hash([stated, free, files, code, version_fields()])


def _keep(file: Path, text: str) -> None:
    """Store a record; a folder that cannot be written costs the next plan the loading."""
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", dir=file.parent, suffix=".part", delete=False
        ) as part:
            part.write(text)
        os.replace(part.name, file)
