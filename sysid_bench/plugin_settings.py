"""Settings of plug-ins: known keys, and quantities read with the unit of their dataclass field."""

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_origin

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.units import quantity


@dataclasses.dataclass(frozen=True)
class _SettingField:
    """Field of a plug-in: its unit (None: not read with a unit), and True where its type allows a
    list with one value per joint."""

    unit: str | None
    is_per_joint: bool

    def si_value(self, value: Any) -> Any:
        """Return a value as the plug-in takes it: quantities in SI units."""
        if self.unit is None:
            return value
        if self.is_per_joint and isinstance(value, (list, tuple)):
            return tuple(quantity(one, self.unit) for one in value)
        return quantity(value, self.unit)


def plugin_settings(plugin: str, make: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the plug-in `make` in SI units; `plugin` names it in errors.

    Raises UsageError for unknown, missing or wrong ones.
    """
    try:
        parameters = inspect.signature(make).parameters
    except (TypeError, ValueError):  # written in C, without a signature
        return dict(given)
    _check_settings(plugin, parameters, given)
    fields = plugin_fields(make)
    return {key: _setting(plugin, key, value, fields.get(key)) for key, value in given.items()}


def plugin_fields(make: Any) -> dict[str, _SettingField]:
    """Return the dataclass fields of a plug-in by name; {} for another callable."""
    fields = dataclasses.fields(make) if dataclasses.is_dataclass(make) else ()
    return {f.name: _SettingField(f.metadata.get("unit"), _takes_list(f.type)) for f in fields}


def _takes_list(annotation: Any) -> bool:
    if isinstance(annotation, str):  # postponed
        return "Sequence[" in annotation or "tuple[" in annotation or "Size" in annotation
    return any(map(_is_sequence, (annotation, *get_args(annotation))))


def _is_sequence(annotation: Any) -> bool:
    kind = get_origin(annotation)
    return isinstance(kind, type) and issubclass(kind, Sequence)


def _check_settings(
    plugin: str, parameters: Mapping[str, inspect.Parameter], given: Mapping[str, Any]
) -> None:
    """Raise UsageError for a setting that the plug-in does not take, and for one that it lacks."""
    unknown = [key for key in given if key not in parameters]
    if unknown and not _takes_any(parameters):
        raise unknown_name(f"setting of the {plugin}", unknown[0], parameters)
    required = (key for key, parameter in parameters.items() if _is_required(parameter))
    missing = [key for key in required if key not in given]
    if missing:
        raise UsageError(f"{plugin} needs the settings {', '.join(missing)}.")


def _is_required(parameter: inspect.Parameter) -> bool:
    variadic = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return parameter.default is inspect.Parameter.empty and parameter.kind not in variadic


def _takes_any(parameters: Mapping[str, inspect.Parameter]) -> bool:
    """Test for `**settings`, which take every key."""
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())


def _setting(plugin: str, key: str, value: Any, field: _SettingField | None) -> Any:
    try:
        return value if field is None else field.si_value(value)
    except UsageError as error:
        raise UsageError(f"{plugin}, {key}: {error}") from error
