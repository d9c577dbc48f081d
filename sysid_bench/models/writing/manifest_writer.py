"""Writing of a robot's manifest: the text of a robot.toml that reads back as given."""

from collections.abc import Mapping
from typing import Any, Final

import tomlkit

from sysid_bench.models.manifest import Manifest

_PLAIN: Final = ("name", "title", "tool", "free_base", "gravity", "terms", "locked", "massless")
"""Keys that are fields of the same name."""


def manifest_text(manifest: Manifest, file: str) -> str:
    """Return the text of a robot.toml for a robot whose model is `file`, relative to it.

    Keys at their defaults are left out; the DH table and the paper's order of parameters, which
    belong to the original file, are not written.
    """
    tables: dict[str, dict[str, Any]] = {"limits": {}, "joints": {}}
    for kind, entries in (("limits", manifest.limits), ("joints", manifest.joints)):
        for name, entry in entries.items():
            written = entry.model_dump(exclude_none=True, mode="json")
            tables[kind][name] = {key: value for key, value in written.items() if value != {}}
    keys = (
        {key: getattr(manifest, key) for key in _PLAIN}
        | tables
        | {
            "file": file,
            "assets": None if manifest.assets is None else str(manifest.assets.resolve()),
            "coupling": {"independent": list(manifest.independent)}
            if manifest.independent
            else None,
            "sensor": [{"name": sensor.name, "at": sensor.at} for sensor in manifest.sensors],
            "source": {"licence": manifest.licence} if manifest.licence else None,
        }
    )
    order = ("name", "title", "file", *sorted(set(keys) - {"name", "title", "file"}))
    given = {key: keys[key] for key in order if keys[key] not in (None, False, (), [], {})}
    if not manifest.couplings:
        given["couplings"] = False
    return _toml_text(given)


def _toml_text(keys: Mapping[str, Any]) -> str:
    # TOML knows no tuples; values of the top table stand before the first table.
    plain = {key: list(x) if isinstance(x, tuple) else x for key, x in keys.items()}
    return tomlkit.dumps(dict(sorted(plain.items(), key=lambda x: isinstance(x[1], (dict, list)))))
