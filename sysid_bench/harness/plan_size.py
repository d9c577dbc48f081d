"""Number of cells of a suite, counted without making them."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final

from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import COMPOSED, composed_plant
from sysid_bench.experiments.spec import REDRAWN, normal_noise, normal_prior
from sysid_bench.harness.suite.data_entries import ModelSpread, Plant, Prior
from sysid_bench.harness.suite.model import LogEntry, Suite

MANY: Final = 1_000_000
"""Most cells of a plan that nobody has to ask for: more are a mistake more often than a wish."""

_AXES: Final = ("task", "terms", "excitation", "motions", "held_out", "rate", "signals")
_NOISY_AXES: Final = ("plant", "noise", "prior", "simulation", "pipeline")
"""Axes that decide on repeats: an experiment that draws nothing is not repeated."""


def check_size(suite: Suite) -> None:
    """Raise UsageError with the product that makes a suite too large."""
    products = [_simulated(suite), *(_recorded(suite, log) for log in suite.log)]
    total = sum(count for count, _ in products)
    if total > MANY:
        terms = " + ".join(text for count, text in products if count)
        raise UsageError(
            f"{suite.name!r} has {total:,} cells before any [[exclude]], more than {MANY:,}: "
            f"{terms} = {total:,}. Make a sweep shorter, or plan and run it with --large."
        )


def is_random_prior(prior: str | Mapping[str, Any]) -> bool:
    """True for a normal prior that each repeat draws again."""
    return not isinstance(prior, str) and bool(prior.get(REDRAWN))


def has_random_sensors(plant: Mapping[str, Any]) -> bool:
    """True for a plant whose sensors have errors, which repeats may draw again."""
    return plant["use"] == COMPOSED and composed_plant(plant).has_random_signals


def prior_table(prior: Prior | ModelSpread | str) -> str | dict[str, Any]:
    """Return a prior as its words or keys."""
    return prior if isinstance(prior, str) else prior.model_dump(exclude_none=True)


def _simulated(suite: Suite) -> tuple[int, str]:
    axes = suite.defaults
    sizes = {**_robots(suite), "estimators": len(suite.estimator)}
    sizes |= {axis: len(getattr(axes, axis)) for axis in _AXES}
    repeats = suite.run.repeats
    kinds = [_kinds(suite, plant) for plant in axes.plant]
    drawn, fixed = (sum(counts) for counts in zip(*kinds, strict=True))
    count = prod(sizes.values()) * (drawn * repeats + fixed)
    noisy = {axis: len(getattr(axes, axis) or (None,)) for axis in _NOISY_AXES}
    if prod(noisy.values()) != drawn + fixed:  # plants with a simulation or noise of their own
        noisy = {f"kinds of {', '.join(_NOISY_AXES)}": drawn + fixed}
    text = _product({**sizes, **noisy, "repeats": repeats})
    if fixed and repeats > 1:
        text += f" (repeats of {drawn} of {drawn + fixed} kinds of {', '.join(_NOISY_AXES)})"
    return count, text


def _robots(suite: Suite) -> dict[str, int]:
    if len(suite.robot) == 1:
        (entry,) = suite.robot
        return {"robots": len(entry.use), "payloads": len(entry.payloads)}
    return {"robots with payloads": sum(len(e.use) * len(e.payloads) for e in suite.robot)}


def _kinds(suite: Suite, plant: Plant) -> tuple[int, int]:
    """Numbers of combinations of the axes of noise with a plant that draw something, and that do
    not."""
    axes = suite.defaults
    simulations, noises, pipelines = axes.of(plant)
    count = len(axes.prior) * len(simulations) * len(noises) * len(pipelines)
    exact = sum(not normal_noise(noise.model_dump(exclude_none=True)) for noise in noises)
    given = sum(not is_random_prior(normal_prior(prior_table(prior))) for prior in axes.prior)
    if axes.redrawn:
        return count, 0
    played = sum(entry.use == "inverse" for entry in simulations)
    fixed = (not has_random_sensors(plant.spec)) * exact * given * played * len(pipelines)
    return count - fixed, fixed


def _recorded(suite: Suite, log: LogEntry) -> tuple[int, str]:
    sweeps: Mapping[str, Sequence[Any]] = {
        "terms": log.terms, "choose": log.choose, "filter": log.filter, "moving": log.moving,
        "pipeline": log.pipeline or (None,), "prior": log.prior, "estimators": suite.estimator,
    }  # fmt: skip
    sizes = {name: len(values) for name, values in sweeps.items()}
    return prod(sizes.values()), _product(sizes)


def _product(sizes: Mapping[str, int]) -> str:
    """Return "3 robots x payloads x 4 rate"; axes of one value are left out."""
    return " x ".join(f"{size:,} {name}" for name, size in sizes.items() if size != 1) or "1"
