"""Warnings about an estimate from recordings: what its parameters, its payload and its tests say of
them. What a recording itself says is in the diagnosis."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from sysid_bench.commands.result import interval_text
from sysid_bench.experiments.recorded.process_log import ProcessedLog

DEVIATIONS: Final = 3.0
"""Standard deviations below zero from which a friction coefficient counts as negative."""

LEAST_GAIN_ERROR, LARGEST_DEVIATION = 0.05, 0.2
"""Least error of a torque scale that is reported, and the largest standard deviation (shares) with
which a joint decides it."""

PUSHING: Final = (
    "friction is negative on {}: the torque has the wrong sign there, or it is not the motor's."
)


def friction_warnings(joints: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for joints whose torque pushes with the motion; `joints` as in the result
    of `identify`."""
    names = [name for name, terms in joints.items() if _pushes(terms)]
    return [PUSHING.format(", ".join(names))] if names else []


def _pushes(terms: Mapping[str, Mapping[str, Any]]) -> bool:
    """Test whether the viscous and Coulomb friction of a joint, where identified, are negative."""
    friction = [terms[term] for term in ("viscous", "coulomb") if term in terms]
    return bool(friction) and all(_is_negative(term) for term in friction)


def _is_negative(term: Mapping[str, Any]) -> bool:
    """Test whether a coefficient is negative beyond its standard deviation, where that is known."""
    return term["value"] is not None and bool(term["value"] < -DEVIATIONS * (term["std"] or 0.0))


def finding_warnings(logs: Sequence[ProcessedLog]) -> list[str]:
    """Return the findings in recordings, each with its file."""
    return [
        f"{one.log.description.source.name}: {finding.text}"
        for one in logs
        for finding in one.log.findings
    ]


def repetition_warnings(replayed: Mapping[str, Mapping[str, float] | None]) -> list[str]:
    """Return sentences for tests on the training motion: they say nothing about other motions."""
    return [
        _repeated_test(label, errors) for label, errors in replayed.items() if errors is not None
    ]


def _repeated_test(label: str, errors: Mapping[str, float]) -> str:
    shares = " ".join(f"{100 * error:.1f}" for error in errors.values())
    return (
        f"{label} repeats the training motion: its errors show how well the same motion is "
        "predicted again, not how well others are; the training torque itself, played "
        f"again, errs by {shares} %"
    )


def gain_warnings(payload: Mapping[str, Any] | None, stated: float) -> list[str]:
    """Return sentences for torques whose scale a known load contradicts; `payload` as in the result
    of `identify` on logs, `stated`: its mass (kg) in the log."""
    if payload is None or not stated > 0:
        return []
    if "by_joint" in payload:
        return _joint_gains(payload["by_joint"], stated)
    ends = payload["intervals"].get("mass")
    return [] if ends is None else _mass_gain(payload["mass"], ends[0], stated)


def _mass_gain(found: float, interval: Sequence[float], stated: float) -> list[str]:
    """A sentence on a mass that the torques of all joints give, where the stated one is beyond its
    interval."""
    low, high = interval
    if low <= stated <= high or abs(found / stated - 1) < LEAST_GAIN_ERROR:
        return []
    return [
        f"the log states a payload of {stated:.4g} kg, the torques give {found:.4g} kg (95 % in "
        f"{interval_text(low, high)}): if the statement is right, torques are {found / stated:.3g} "
        "times the true ones, as with wrong drive gains"
    ]


def _joint_gains(masses: Mapping[str, Sequence[float]], stated: float) -> list[str]:
    """Sentence on the joints whose own torque gives another mass than the one stated."""
    wrong = [
        f"{name} {mass / stated:.3g} ± {std / stated:.1g}"
        for name, (mass, std) in masses.items()
        if abs(mass - stated) > max(DEVIATIONS * std, LEAST_GAIN_ERROR * stated)
        and std < LARGEST_DEVIATION * stated
    ]
    if not wrong:
        return []
    return [
        f"by the stated payload of {stated:.4g} kg, torques are these multiples of the true ones: "
        f"{', '.join(wrong)}; divide the gains of these joints by them, or correct the statement"
    ]
