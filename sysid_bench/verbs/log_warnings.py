"""Warnings about implausible torques in recordings, from the identified model itself."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

UNEXPLAINED: Final = 0.9
"""Relative training error of a joint above which the model explains nothing of its torque."""

DEVIATIONS: Final = 3.0
"""Standard deviations below zero from which a friction coefficient counts as negative."""


def log_warnings(
    training: Mapping[str, Mapping[str, Any]], joints: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    """Yield a sentence for torques that are zero, that no model explains, or that push with the
    motion; `training` and `joints` as in the result of `identify` on logs."""
    silent = [name for name, error in training.items() if not error["rms"]]
    if silent:
        yield f"the torque of {', '.join(silent)} is zero throughout: is its column the right one?"
    unexplained = {
        name: error["relative"]
        for name, error in training.items()
        if error["relative"] is not None and error["relative"] > UNEXPLAINED
    }
    if unexplained:
        shares = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in unexplained.items())
        yield (
            f"the model explains next to nothing of the torque of {shares}: are columns exchanged, "
            "constant, or those of other joints?"
        )
    pushing = [name for name, terms in joints.items() if _pushes(terms)]
    if pushing:
        yield (
            f"friction is negative on {', '.join(pushing)}: the torque has the wrong sign there, "
            "or it is not the motor's."
        )


def _pushes(terms: Mapping[str, Mapping[str, Any]]) -> bool:
    """Test whether the viscous and Coulomb friction of a joint, where identified, are negative."""
    friction = [terms[term] for term in ("viscous", "coulomb") if term in terms]
    return bool(friction) and all(
        term["value"] is not None
        and term["value"] < 0
        and (term["std"] is None or term["value"] < -DEVIATIONS * term["std"])
        for term in friction
    )
