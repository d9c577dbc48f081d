"""What an answer from recordings itself says against them: torques that cannot be a robot's."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

UNEXPLAINED: Final = 0.9
"""Relative training error of a joint of whose torque the model explains nothing."""

SURE: Final = 3.0
"""Standard deviations that make a negative friction one."""


def log_warnings(
    training: Mapping[str, Mapping[str, Any]], joints: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    """Sentences on torques that are nothing, that no model explains, or that push with the motion;
    `training` and `joints` as in the answer of `identify --log`."""
    silent = [name for name, told in training.items() if not told["rms"]]
    if silent:
        yield f"the torque of {', '.join(silent)} is zero throughout: is its column the right one?"
    lost = {
        name: told["relative"]
        for name, told in training.items()
        if told["relative"] is not None and told["relative"] > UNEXPLAINED
    }
    if lost:
        shares = ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in lost.items())
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
    """Whether a joint's viscous and Coulomb friction, as far as they are told, are all negative."""
    asked = [terms[term] for term in ("viscous", "coulomb") if term in terms]
    return bool(asked) and all(
        told["value"] is not None
        and told["value"] < 0
        and (told["std"] is None or told["value"] < -SURE * told["std"])
        for told in asked
    )
