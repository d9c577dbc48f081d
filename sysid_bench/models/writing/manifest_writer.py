"""Writing of a robot's manifest: the text of a robot.toml that reads back as given."""

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
    keys = {key: getattr(manifest, key) for key in _PLAIN} | {
        "file": file,
        "couplings": None if manifest.couplings else False,
        "assets": None if manifest.assets is None else str(manifest.assets.resolve()),
        "limits": _tables(manifest.limits),
        "joints": _tables(manifest.joints),
        "coupling": {"independent": list(manifest.independent)} if manifest.independent else None,
        "sensor": [{"name": sensor.name, "at": sensor.at} for sensor in manifest.sensors],
        "source": {"licence": manifest.licence} if manifest.licence else None,
    }
    order = ("name", "title", "file", *sorted(set(keys) - {"name", "title", "file"}))
    plain = {key: _plain(keys[key]) for key in order if keys[key] not in (None, False, (), [], {})}
    if not manifest.couplings:
        plain["couplings"] = False
    # TOML: values of the top table stand before the first table.
    return tomlkit.dumps(dict(sorted(plain.items(), key=_is_table)))


def _is_table(item: tuple[str, Any]) -> bool:
    return isinstance(item[1], (dict, list))


def _tables(entries: Any) -> dict[str, dict[str, Any]]:
    """Tables by joint name, without the keys that are None."""
    tables = {name: entry.model_dump(exclude_none=True) for name, entry in entries.items()}
    return {name: {k: v for k, v in table.items() if v != {}} for name, table in tables.items()}


def _plain(value: Any) -> Any:
    """The value with lists for tuples, which TOML does not know."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value
