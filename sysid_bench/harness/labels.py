"""Labels of the values of a sweep: short texts, unique within the suite."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, Final

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    plant_entries,
    plant_name,
)
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    normal_noise,
    normal_payload,
    normal_prior,
)
from sysid_bench.harness.plan_size import prior_table
from sysid_bench.harness.suite.data_entries import (
    Estimator,
    ModelSpread,
    Noise,
    Plant,
    Plugin,
    Prior,
)
from sysid_bench.harness.suite.model import RobotEntry, Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.signals.pipeline_choice import DEFAULT, PLAIN

BASES: Final = {None: "", True: " (free base)", False: " (fixed base)"}
"""Suffix of a robot's name where the suite sets its base."""


DEFAULTS: Final = ({"use": PLAIN}, {"use": DEFAULT})
"""Pipelines of experiments that name none."""

_Choice = tuple[Any, str, str]
"""A value of a sweep, its short text and its long one."""


def _unique_labels(choices: Iterable[_Choice]) -> dict[str, str]:
    """Return canonical(value) -> label: the short text of a choice where it is unique, else the
    long one, else the long one with a hash."""
    short, long = dict[str, str](), dict[str, str]()
    for value, *texts in choices:
        key = canonical(value)
        short.setdefault(key, texts[0])
        long.setdefault(key, texts[1])
    hashed = {key: f"{text} #{canonical_hash(key)[:6]}" for key, text in long.items()}
    return _with_finer(_with_finer(short, long), hashed)


def _with_finer(labels: Mapping[str, str], finer: Mapping[str, str]) -> dict[str, str]:
    """Return the labels, each that several values share in its finer form."""
    count = Counter(labels.values())
    return {key: finer[key] if count[label] > 1 else label for key, label in labels.items()}


def plugin_label(spec: Mapping[str, Any], label: str | None = None) -> tuple[str, str]:
    """Return short and long text of a plug-in: "Geodesic" and "Geodesic step=0.1"."""
    use = str(spec["use"])
    short = label or use.rpartition(":")[2]
    settings = [f"{key}={value}" for key, value in spec.items() if key not in ("use", "label")]
    if settings:
        return short, " ".join((short, *settings))
    return short, f"{short} ({use})" if ":" in use else short


def _spec_texts(spec: Mapping[str, Any]) -> _Choice:
    return spec, *plugin_label(spec, spec.get("label"))


def _plugin_texts(entry: Plugin) -> _Choice:
    return _spec_texts(entry.spec)


def _estimator_texts(entry: Estimator) -> _Choice:
    return entry.spec, *plugin_label(entry.spec, entry.label)


def _task_texts(task: str) -> _Choice:
    return task, *plugin_label({"use": task})


def _plant_texts(entry: Plant) -> _Choice:
    """Return a plant with its short and its long text: "L2" and "L2 stribeck share=0.2 delay"."""
    spec = entry.spec
    if spec["use"] != COMPOSED:
        return _spec_texts(spec)
    short = plant_name(spec)
    parts = (plugin_label(part)[1] for _, part in plant_entries(spec))
    return spec, short, " ".join((short, *parts))


def terms_label(spec: ExperimentSpec) -> str:
    """Return the label of the joint terms of an experiment."""
    return "default" if spec.terms is None else " ".join(spec.terms) or "none"


def table_text(written: str | Mapping[str, Any], empty: str) -> str:
    """Return "q 1e-4 rad, tau 0.5 %" for a table of quantities; words stay."""
    if isinstance(written, str):
        return written
    return ", ".join(f"{key} {value}" for key, value in written.items()) or empty


def labels_of(suite: Suite, names: Names) -> dict[str, dict[str, str]]:
    """Return axis -> canonical value -> label."""
    axes = suite.defaults
    simulations, noises, pipelines = zip(*map(axes.of, axes.plant), strict=True)
    payloads = chain.from_iterable(entry.payloads for entry in suite.robot)
    choices: dict[str, Iterable[_Choice]] = {
        "excitation": map(_plugin_texts, axes.excitation),
        "simulation": map(_plugin_texts, chain(*simulations)),
        "pipeline": map(_spec_texts, _pipelines(chain(*pipelines))),
        "plant": map(_plant_texts, axes.plant),
        "estimator": map(_estimator_texts, suite.estimator),
        "task": map(_task_texts, axes.task),
        "robot": (_robot_texts(names, suite, source, entry) for entry, source in suite.robots),
        "payload": map(partial(_payload_texts, names), payloads),
        "noise": map(_noise_texts, chain(*noises)),
        "prior": map(_prior_texts, axes.prior),
        "held_out": map(_motion_texts, axes.held_out),
    }
    return {axis: _unique_labels(texts) for axis, texts in choices.items()}


def _pipelines(named: Iterable[Plugin | None]) -> Iterator[Mapping[str, Any]]:
    """Yield the pipelines that are named; where none is, those that may be chosen."""
    for entry in named:
        yield from DEFAULTS if entry is None else (entry.spec,)


def robot_key(source: str, free_base: bool | None, sensor: str | None = None) -> Any:
    """Return the key of a robot: its source, with base and sensor where the suite sets them."""
    if sensor is not None:
        return [source, free_base, sensor]
    return source if free_base is None else [source, free_base]


def _robot_texts(names: Names, suite: Suite, source: str, entry: RobotEntry) -> _Choice:
    base = BASES[entry.free_base]
    sensor = "" if entry.sensor is None else f" @ {entry.sensor}"
    key = robot_key(source, entry.free_base, entry.sensor)
    return key, names.robot(source, suite.folder).name + base, source + base + sensor


def _payload_texts(names: Names, written: str | dict[str, Any]) -> _Choice:
    return normal_payload(written), names.payload(written).name, table_text(written, "none")


def _noise_texts(noise: Noise) -> _Choice:
    written = noise.model_dump(exclude_none=True)
    value = normal_noise(written)
    text = table_text(written, "exact") if value else "exact"
    return value, text, text


def _prior_texts(prior: Prior | ModelSpread | str) -> _Choice:
    written = prior_table(prior)
    text = table_text(written, "none")
    return normal_prior(written), text, text


def _motion_texts(motions: Sequence[Plugin]) -> _Choice:
    specs = [motion.spec for motion in motions]
    texts = list(map(plugin_label, specs))
    return specs, ", ".join(short for short, _ in texts), ", ".join(long for _, long in texts)
