"""Labels of the values of a sweep: short texts, unique within the suite."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final

from sysid_bench.canonical_json import canonical, canonical_hash
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    plant_entries,
    plant_name,
)
from sysid_bench.experiments.spec import normal_noise, normal_payload, normal_prior
from sysid_bench.harness.suite.data_entries import Noise, Prior
from sysid_bench.harness.suite.model import RobotEntry, Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.plugin_entries import Plugin
from sysid_bench.signals.pipeline_choice import DEFAULT, PLAIN

BASES: Final = {None: "", True: " (free base)", False: " (fixed base)"}
"""Suffix of a robot's name where the suite sets its base."""


DEFAULTS: Final = ({"use": PLAIN}, {"use": DEFAULT})
"""Pipelines of experiments that name none."""


def _unique_labels(choices: Iterable[tuple[Any, str, str]]) -> dict[str, str]:
    """Return canonical(value) -> label from (value, short text, long text): the short text where it
    is unique, else the long one, else the long one with a hash."""
    texts: dict[str, tuple[str, str]] = {}
    for value, short, long in choices:
        texts.setdefault(canonical(value), (short, long))
    labels = {key: short for key, (short, _) in texts.items()}
    longer = {key: long for key, (_, long) in texts.items()}
    hashed = {key: f"{long} #{canonical_hash(key)[:6]}" for key, long in longer.items()}
    for finer in (longer, hashed):
        count = Counter(labels.values())
        labels = {key: finer[key] if count[label] > 1 else label for key, label in labels.items()}
    return labels


def plugin_label(spec: Mapping[str, Any], label: str | None = None) -> tuple[str, str]:
    """Return short and long text of a plug-in: "Geodesic" and "Geodesic step=0.1"."""
    use = str(spec["use"])
    short = label or use.rpartition(":")[2]
    settings = " ".join(
        f"{key}={value}" for key, value in spec.items() if key not in ("use", "label")
    )
    return short, f"{short} {settings}" if settings else f"{short} ({use})" if ":" in use else short


def _plant_texts(spec: Mapping[str, Any]) -> tuple[str, str]:
    """Return short and long text of a plant: "L2" and "L2 stribeck share=0.2 delay"."""
    if spec["use"] != COMPOSED:
        return plugin_label(spec, spec.get("label"))
    short = plant_name(spec)
    parts = (plugin_label(part)[1] for _, part in plant_entries(spec))
    return short, " ".join((short, *parts))


def table_text(written: str | Mapping[str, Any], empty: str) -> str:
    """Return "q 1e-4 rad, tau 0.5 %" for a table of quantities; words stay."""
    if isinstance(written, str):
        return written
    return ", ".join(f"{key} {value}" for key, value in written.items()) or empty


def labels_of(suite: Suite, names: Names) -> dict[str, dict[str, str]]:
    """Return axis -> canonical value -> label."""
    axes = suite.defaults
    simulations, noises, pipelines = zip(*map(axes.of, axes.plant), strict=True)
    plugins = {
        "excitation": [entry.spec for entry in axes.excitation],
        "simulation": [entry.spec for entry in chain(*simulations)],
        "pipeline": list(_pipelines(chain(*pipelines))),
    }
    labels = {
        axis: _unique_labels((spec, *plugin_label(spec, spec.get("label"))) for spec in specs)
        for axis, specs in plugins.items()
    }
    labels["plant"] = _unique_labels((p.spec, *_plant_texts(p.spec)) for p in axes.plant)
    labels["estimator"] = _unique_labels(
        (e.spec, *plugin_label(e.spec, e.label)) for e in suite.estimator
    )
    labels["task"] = _unique_labels((task, *plugin_label({"use": task})) for task in axes.task)
    labels["robot"] = _unique_labels(
        (
            robot_key(source, entry.free_base, entry.sensor),
            *_robot_texts(names, suite, source, entry),
        )
        for entry, source in suite.robots
    )
    payloads = [payload for entry in suite.robot for payload in entry.payloads]
    labels["payload"] = _unique_labels(
        (normal_payload(p), names.payload(p).name, table_text(p, "none")) for p in payloads
    )
    labels["noise"] = _unique_labels(_noise_texts(noise) for noise in chain(*noises))
    labels["prior"] = _unique_labels(_prior_texts(prior) for prior in axes.prior)
    labels["held_out"] = _unique_labels(_motion_texts(motions) for motions in axes.held_out)
    return labels


def _pipelines(named: Iterable[Plugin | None]) -> Iterator[Mapping[str, Any]]:
    """Yield the pipelines that are named; where none is, those that may be chosen."""
    for entry in named:
        yield from DEFAULTS if entry is None else (entry.spec,)


def robot_key(source: str, free_base: bool | None, sensor: str | None = None) -> Any:
    """Return the key of a robot: its source, with base and sensor where the suite sets them."""
    if sensor is not None:
        return [source, free_base, sensor]
    return source if free_base is None else [source, free_base]


def _robot_texts(names: Names, suite: Suite, source: str, entry: RobotEntry) -> tuple[str, str]:
    base = BASES[entry.free_base]
    sensor = "" if entry.sensor is None else f" @ {entry.sensor}"
    return names.robot(source, suite.folder).name + base, source + base + sensor


def _noise_texts(noise: Noise) -> tuple[Any, str, str]:
    written = noise.model_dump(exclude_none=True)
    value = normal_noise(written)
    text = table_text(written, "exact") if value else "exact"
    return value, text, text


def _prior_texts(prior: Prior | str) -> tuple[Any, str, str]:
    written = prior if isinstance(prior, str) else prior.model_dump(exclude_none=True)
    text = table_text(written, "none")
    return normal_prior(written), text, text


def _motion_texts(motions: Sequence[Plugin]) -> tuple[Any, str, str]:
    texts = [plugin_label(motion.spec) for motion in motions]
    value = [motion.spec for motion in motions]
    return value, ", ".join(short for short, _ in texts), ", ".join(long for _, long in texts)
