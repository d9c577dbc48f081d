"""Plug-ins as a suite names them: {use, settings...}, with the keys that are not the plug-in's."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, ConfigDict, StrictStr, ValidationInfo, model_validator

from sysid_bench.canonical_json import canonical
from sysid_bench.excitation.limit_settings import checks_limits, without_limits
from sysid_bench.experiments.simulated.composed_plant import plant_entries, size_limits
from sysid_bench.harness.suite.checks import CheckInput, check_input, to_plugin, value_of
from sysid_bench.harness.suite.data_entries import Noise
from sysid_bench.harness.suite.plant_file import SIGNALS, with_plant_file
from sysid_bench.harness.suite.report_entries import SuiteTable
from sysid_bench.plugin_names import resolve_files


class Plugin(SuiteTable):
    """A plug-in: its name and its settings."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)
    kind: ClassVar[str] = ""
    use: StrictStr  # name, `module:object` or `file:mine.py:Class`

    @property
    def spec(self) -> dict[str, Any]:
        """Return {use, settings...}, without a label."""
        return {"use": self.use, **(self.model_extra or {})}

    def _looked_up(self) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Return (kind, {use, settings}) of each plug-in that this entry needs."""
        return [(self.kind, self.plugin_spec)]

    @model_validator(mode="after")
    def known(self, info: ValidationInfo) -> "Plugin":
        value_of(lambda: canonical(self.spec))  # ids are made of JSON: TOML dates are refused
        context = check_input(info)
        for kind, spec in value_of(self._looked_up):
            value_of(partial(context.names.plugin, kind, resolve_files(spec, context.folder)))
        return self

    @property
    def plugin_spec(self) -> dict[str, Any]:
        """Return {use, settings...} as the plug-in is given them."""
        return self.spec


class Estimator(Plugin):
    kind = "estimator"
    label: StrictStr | None = None  # name in tables

    @model_validator(mode="after")
    def _no_reserved_keys(self) -> "Estimator":
        if "cell" in (self.model_extra or {}):
            raise ValueError("'cell' cannot be a setting of an estimator: it names the row.")
        return self


class Excitation(Plugin):
    kind = "excitation"

    @property
    def plugin_spec(self) -> dict[str, Any]:
        """Return the specification without the rule for limits, which is not the plug-in's."""
        return without_limits(self.spec)

    @model_validator(mode="after")
    def _rule_for_limits(self) -> "Excitation":
        value_of(lambda: checks_limits(self.spec))
        return self


class Simulation(Plugin):
    kind = "simulation"


class Pipeline(Plugin):
    kind = "pipeline"


Named = BeforeValidator(to_plugin)


def _check_parts(plant: Mapping[str, Any], context: CheckInput) -> None:
    """Look up each effect and error of a plant, ranges at either limit."""
    for kind, spec in value_of(partial(plant_entries, plant)):
        for settings in value_of(partial(size_limits, spec)):
            found = resolve_files(settings, context.folder)
            value_of(partial(context.names.plugin, kind, found))


class Plant(Plugin):
    """An effect, or {use = "composed"} with lists of effects, model errors and sensor errors; a
    size may be drawn from a range. A plant file is read when the suite is. `simulation`, `noise`
    and `pipeline` hold for this plant in place of those of the suite."""

    kind = "plant"
    simulation: Annotated[Simulation | None, Named] = None
    noise: Noise | None = None
    pipeline: Annotated[Pipeline | None, Named] = None

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, value: Any, info: ValidationInfo) -> Any:
        context = check_input(info)
        if context.names.frozen:  # plant files were read when the suite was planned
            return value
        read = value_of(lambda: with_plant_file(value, context.folder))
        if isinstance(read, Mapping) and not read.keys().isdisjoint(SIGNALS):
            # Before these keys are read as the plant's own: an effect may mean something else.
            own = {key: x for key, x in read.items() if key not in (*SIGNALS, "label")}
            _check_parts(own, context)
        return read

    def _looked_up(self) -> Iterable[tuple[str, Mapping[str, Any]]]:
        """Return (kind, {use, settings}) of each effect and error, ranges at either limit."""
        return [
            (kind, settings)
            for kind, spec in plant_entries(self.spec)
            for settings in size_limits(spec)
        ]
