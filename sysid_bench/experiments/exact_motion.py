"""Experiments whose motion is played back, and those whose positions are exact as well."""

from typing import Final

from sysid_bench.experiments.simulated.composed_plant import composed_plant
from sysid_bench.experiments.spec import ExperimentSpec

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
