"""Plant of a specification: effects, model errors and sensor errors, with sizes that are drawn."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.spec import SEALED, ExperimentSpec, check_seed_hash
from sysid_bench.plugin_names import plugin_fields
from sysid_bench.simulation.size import is_random, random_limits
from sysid_bench.units import parse_quantity

COMPOSED: Final = "composed"
"""Name of a plant that lists its parts."""

KIND_OF: Final[Mapping[str, str]] = {
    "effects": "plant", "errors": "model_error", "sensors": "sensor_error",
}  # fmt: skip
"""Kind of plug-in by the list of a composed plant."""


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

    @property
    def random_settings(self) -> dict[str, Mapping[str, Any]]:
        """The settings that are drawn, { from = ..., to = ... }."""
        return {key: value for key, value in self.spec.items() if is_random(value)}


@dataclass(frozen=True)
class ComposedPlant:
    """Entries of a plant in the order of the specification."""

    entries: tuple[PlantEntry, ...]

    def of(self, group: str) -> tuple[PlantEntry, ...]:
        """The entries of one list: "effects", "errors" or "sensors"."""
        return tuple(entry for entry in self.entries if entry.group == group)

    @property
    def has_random_signals(self) -> bool:
        """True where repeats of exact signals may differ: their sensors have errors."""
        return bool(self.of("sensors"))


def composed_plant(plant: Mapping[str, Any]) -> ComposedPlant:
    """The entries of a plant as a suite writes it; a plain one is its only effect.

    Raises UsageError for unknown keys and for entries without a name.
    """
    if plant.get("use") != COMPOSED:
        return ComposedPlant((PlantEntry("effects", plant, 0),))
    for key in plant:
        if key not in ("use", "name", "label", SEALED, *KIND_OF):
            raise unknown_name("key of a composed plant", key, ("name", "label", SEALED, *KIND_OF))
    if SEALED in plant:
        check_seed_hash(plant[SEALED])
    return ComposedPlant(tuple(entry for group in KIND_OF for entry in _entries(plant, group)))


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
    return tuple((entry.kind, entry.spec) for entry in composed_plant(plant).entries)


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
        what = f"{key} of {spec['use']!r}"
        if set(value) != {"from", "to"}:
            raise UsageError(
                f"{what}: a drawn size has the keys 'from' and 'to', as "
                f"{{ from = 0, to = 1 }}; got {sorted(value)}."
            )
        _check_order(what, value)
    ends = ({key: value[end] for key, value in ranges.items()} for end in ("from", "to"))
    return tuple({**spec, **end} for end in ends)


def _check_order(what: str, written: Mapping[str, Any]) -> None:
    """Raise UsageError for numbers of one unit in the wrong order; others wait for the plug-in."""
    ends = [written[key] for key in ("from", "to")]
    if not all(isinstance(end, (int, float, str)) for end in ends):
        return
    (low, unit), (high, other) = (parse_quantity(str(end)) for end in ends)
    if unit == other and low > high:
        raise UsageError(f"{what}: the range from {ends[0]} to {ends[1]} ends below its begin.")


def check_limits(entry: PlantEntry, make: Any) -> dict[str, tuple[float, float]]:
    """(low, high) of each drawn setting in SI units; `make` is the plug-in's class.

    Raises UsageError for a range that ends below its beginning.
    """
    fields = plugin_fields(make)
    limits = {}
    for key, written in entry.random_settings.items():
        unit = fields[key].unit if key in fields else None
        try:
            limits[key] = random_limits(written, unit)
        except UsageError as error:
            raise UsageError(f"{entry.kind} {entry.spec['use']!r}, {key}: {error}") from error
    return limits


ENCODERS: Final = ("q", "quantum")
"""Keys of a [noise] table that disturb positions."""


def has_exact_motion(spec: ExperimentSpec) -> bool:
    """Return True where the simulated robot moves exactly as commanded, without a controller."""
    return bool(spec.simulation["use"] == "inverse")


def has_exact_positions(spec: ExperimentSpec) -> bool:
    """Return True for a motion that is played back and read without errors of encoders or of the
    log: exact rates then exist, and a filter has nothing to remove from them."""
    disturbed = any(key in spec.noise for key in ENCODERS)
    errors = composed_plant(spec.plant).has_random_signals
    return has_exact_motion(spec) and not disturbed and not errors
