"""Plant files: effects, model errors, sensor errors and signals of a realism level, as TOML."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench import package_folders, plugin_names
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.simulated.composed_plant import COMPOSED, KIND_OF
from sysid_bench.experiments.spec import SEALED
from sysid_bench.input_files import parse_toml, read_text

SCHEMA: Final = 1
"""Version of the format of plant files."""

SIGNALS: Final = plugin_names.RESERVED["plant"]
"""Keys of a plant that hold in place of those of the suite."""

_KEYS: Final = ("schema", "name", "title", SEALED, *KIND_OF, *SIGNALS)
_OWN: Final = (*KIND_OF, *SIGNALS, "label")
"""Keys that a suite may write beside the name of a plant file."""
_PREFIX: Final = "file:"


def _is_plant_file(name: str) -> bool:
    """Return True for the name of a plant file, and for "file:" with the path of one."""
    return (name.startswith(_PREFIX) and name.endswith(".toml")) or (
        name in package_folders.plant_files()
    )


def with_plant_file(written: Any, folder: Path | None) -> Any:
    """Return the plant of a suite with the keys of the file that it names; keys beside `use`
    replace those of the file. Anything else is returned as it is.

    Relative paths are found from `folder`. Raises UsageError for a file that cannot be read, for
    unknown keys, and for a name of neither a plant file nor an effect.
    """
    if not isinstance(written, Mapping) or not isinstance(written.get("use"), str):
        return written
    if not _is_plant_file(written["use"]):
        _check_known(written["use"])
        return written
    data = read_plant(_path(written["use"], folder))
    own = {key: value for key, value in written.items() if key != "use"}
    for key in own:
        if key not in _OWN:
            raise unknown_name("key of a plant file", key, _OWN)
    table = {key: value for key, value in data.items() if key not in ("schema", "title")}
    return {**table, **own, "use": COMPOSED}


def _check_known(name: str) -> None:
    """Raise UsageError with plant files and effects for a name of neither; "module:object" and
    "file:path.py:object" are looked up elsewhere."""
    names = (*package_folders.plant_files(), COMPOSED, *plugin_names.known("plant"))
    if ":" not in name and name not in names:
        raise unknown_name("plant", name, names)


def read_plant(file: Path) -> dict[str, Any]:
    """Return the keys of a plant file, its name among them.

    Raises UsageError where it cannot be read, for another schema and for unknown keys.
    """
    try:
        data = parse_toml(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"The plant file {str(file)!r} cannot be read: {error}.") from error
    for key in data:
        if key not in _KEYS:
            raise UsageError(f"{file}: {unknown_name('key of a plant file', key, _KEYS)}")
    if data.get("schema") != SCHEMA:
        raise UsageError(f"{file}: schema = {data.get('schema')!r}; this version reads {SCHEMA}.")
    return {"name": file.stem, **data}


def _path(name: str, folder: Path | None) -> Path:
    if name.startswith(_PREFIX):
        return (folder or Path()) / name.removeprefix(_PREFIX)
    return package_folders.plant_files()[name]
