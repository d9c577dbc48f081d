"""Presets of log descriptions: the column names of common recorders, as data."""

from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.signals.log_keys import COMMANDED, SIGNALS

_FILE: Final = Path(__file__).with_suffix(".toml")
_ABOUT: Final = ("title", "needs")
"""Keys of a preset that are not those of a description."""


@cache
def preset_keys() -> dict[str, dict[str, Any]]:
    """Return the presets by name."""
    return parse_toml(read_text(_FILE))


def with_preset(text: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Return the keys of a description, completed by those of its preset.

    Raises UsageError for an unknown preset.
    """
    given = dict(text)
    name = given.pop("preset", None)
    if name is None:
        return given
    if name not in preset_keys():
        raise UsageError(f"{source}: {unknown_name('preset', str(name), preset_keys())}")
    keys = _log_keys(name)
    replaced = {key: _replaced(key, keys.get(key), value) for key, value in given.items()}
    if "rate" in given:
        keys.pop("time")
    return {**keys, **replaced}


def _log_keys(preset: str) -> dict[str, Any]:
    """Return the keys of a preset that a description may have."""
    return {key: value for key, value in preset_keys()[preset].items() if key not in _ABOUT}


def _replaced(key: str, before: Any, value: Any) -> Any:
    """Return a signal of the preset with the keys that the description gives itself."""
    signal = key in (*SIGNALS, *COMMANDED)
    if not signal or not isinstance(before, Mapping) or not isinstance(value, Mapping):
        return value
    left_out = ("match",) if "columns" in value else ()
    return {**{k: v for k, v in before.items() if k not in left_out}, **value}


def find_preset(names: Collection[str]) -> str | None:
    """Return the preset whose columns a file has, None without one."""
    fitting = (name for name, keys in preset_keys().items() if set(keys["needs"]) <= set(names))
    return next(fitting, None)


def preset_note(names: Collection[str]) -> str:
    """Return a sentence that proposes the preset whose columns a file has, "" without one."""
    name = find_preset(names)
    if name is None:
        return ""
    return f" Its columns are those of {preset_keys()[name]['title']}: write preset = {name!r}."
