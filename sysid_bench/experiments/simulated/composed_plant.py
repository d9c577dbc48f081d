"""Plant of a specification: effects, model errors and sensor errors, with sizes that are drawn."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.spec import SEALED, ExperimentSpec, check_seed_hash
from sysid_bench.plugin_names import plugin_fields
from sysid_bench.simulation.size import is_random
from sysid_bench.units import parse_quantity, quantity

COMPOSED: Final = "composed"
"""Name of a plant that lists its parts."""

KIND_OF: Final[Mapping[str, str]] = {
    "effects": "plant", "errors": "model_error", "sensors": "sensor_error",
}  # fmt: skip
"""Kind of plug-in by the list of a composed plant."""

ENCODERS: Final = ("q", "quantum")
"""Keys of a [noise] table that disturb positions."""


@dataclass(frozen=True)
class PlantEntry:
    """One effect or error of a plant: the list that it stands in, {use, settings}, and how many
    entries of the same name stand before it there."""

    group: str
    spec: Mapping[str, Any]
    before: int

    @property
    def kind(self) -> str:
        """Kind of plug-in."""
        return KIND_OF[self.group]

    @property
    def channel(self) -> tuple[str, str, int]:
        """Part of the seed of its draws: neither its sizes nor other entries change them."""
        return self.group, str(self.spec["use"]), self.before


def composed_plant(plant: Mapping[str, Any]) -> tuple[PlantEntry, ...]:
    """The entries of a plant as a suite writes it: effects, errors, sensors; a plain plant is its
    only effect. Raises UsageError for unknown keys and for entries without a name."""
    if plant.get("use") != COMPOSED:
        return (PlantEntry("effects", plant, 0),)
    for key in plant:
        if key not in ("use", "name", "label", SEALED, *KIND_OF):
            raise unknown_name("key of a composed plant", key, ("name", "label", SEALED, *KIND_OF))
    if SEALED in plant:
        check_seed_hash(plant[SEALED])
    return tuple(entry for group in KIND_OF for entry in _entries(plant, group))


def _entries(plant: Mapping[str, Any], group: str) -> Iterator[PlantEntry]:
    written = plant.get(group, [])
    if not isinstance(written, (list, tuple)):
        raise UsageError(f"{group} of a plant is a list, as [{{ use = ... }}]; got {written!r}.")
    names: list[str] = []
    for item in written:
        spec = {"use": item} if isinstance(item, str) else item
        if not isinstance(spec, Mapping) or not isinstance(spec.get("use"), str):
            raise UsageError(f"An entry of {group} needs a name: {{ use = ... }}; got {item!r}.")
        if spec["use"] == COMPOSED:
            raise UsageError("A composed plant lists single effects, and no composed plants.")
        yield PlantEntry(group, spec, names.count(spec["use"]))
        names.append(spec["use"])


def plant_entries(plant: Mapping[str, Any]) -> tuple[tuple[str, Mapping[str, Any]], ...]:
    """(kind, {use, settings}) of every plug-in of a plant."""
    return tuple((entry.kind, entry.spec) for entry in composed_plant(plant))


def plant_name(plant: Mapping[str, Any]) -> str:
    """Short text of a plant: its label or name, else the names of its parts."""
    if plant.get("use") != COMPOSED:
        return str(plant.get("label") or plant["use"])
    parts = [str(spec["use"]).rpartition(":")[2] for _, spec in plant_entries(plant)]
    return str(plant.get("label") or plant.get("name") or " + ".join(parts) or "matched")


def size_limits(spec: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
    """The settings of an entry with every range replaced by its lower limit, and by its upper one:
    where both can be built, so can all between. Raises UsageError for an incomplete range, and for
    one that ends below its beginning."""
    ranges = {key: value for key, value in spec.items() if is_random(value)}
    if not ranges:
        return (dict(spec),)
    for key, value in ranges.items():
        _check_range(f"{key} of {spec['use']!r}", value)
    return tuple(
        {**spec, **{key: value[end] for key, value in ranges.items()}} for end in ("from", "to")
    )


def _check_range(what: str, value: Mapping[str, Any]) -> None:
    if set(value) != {"from", "to"}:
        raise UsageError(
            f"{what}: a drawn size has the keys 'from' and 'to', as "
            f"{{ from = 0, to = 1 }}; got {sorted(value)}."
        )
    ends = value["from"], value["to"]
    if all(isinstance(end, (int, float, str)) for end in ends):
        (low, unit), (high, other) = (parse_quantity(str(end)) for end in ends)
        # Limits in two units are compared where the unit of the setting is known.
        if unit == other and low > high:
            raise UsageError(f"{what}: the range from {ends[0]} to {ends[1]} ends below its begin.")


def random_limits(entry: PlantEntry, make: Any) -> dict[str, tuple[float, float]]:
    """(low, high) of each drawn setting in SI units; `make` is the plug-in's class. Raises
    UsageError for a range that is incomplete or ends below its beginning."""
    size_limits(entry.spec)
    fields, limits = plugin_fields(make), {}
    for key, written in entry.spec.items():
        if not is_random(written):
            continue
        unit = fields[key].unit if key in fields else None
        what = f"{entry.kind} {entry.spec['use']!r}, {key}"
        try:
            low, high = (quantity(written[end], unit or "1") for end in ("from", "to"))
        except UsageError as error:
            raise UsageError(f"{what}: {error}") from error
        if low > high:
            raise UsageError(
                f"{what}: The range from {written['from']} to {written['to']} ends below its start."
            )
        limits[key] = low, high
    return limits


def has_exact_motion(spec: ExperimentSpec) -> bool:
    """True where the simulated robot moves exactly as commanded, without a controller."""
    return bool(spec.simulation["use"] == "inverse")


def has_sensor_errors(plant: Mapping[str, Any]) -> bool:
    """True where repeats of exact signals may differ."""
    return any(entry.group == "sensors" for entry in composed_plant(plant))


def has_exact_positions(spec: ExperimentSpec) -> bool:
    """True for a motion that is played back and read without errors of encoders or of the log:
    exact rates then exist, and a filter has nothing to remove from them."""
    disturbed = any(key in spec.noise for key in ENCODERS) or has_sensor_errors(spec.plant)
    return has_exact_motion(spec) and not disturbed
