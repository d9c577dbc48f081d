"""Text of an identified load: values with intervals, what the intervals hold, and constraints."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sysid_bench.commands.identify_result import identifiable_of
from sysid_bench.commands.result import interval_text, value_text


def payload_lines(payload: Mapping[str, Any]) -> Iterator[str]:
    """The mass by all joints and by single ones; or the identifiable values of the load, with
    intervals; then what was assumed."""
    share, masses = f"{100 * payload['confidence']:.10g} %", payload["by_joint"].items()
    if "interval" in payload:
        yield (
            f"  payload: mass {payload['mass']:.4g} kg, {share} in "
            f"{interval_text(*payload['interval'])}, by leaving parts of the motion out and by the "
            "joints; errors that all joints share, of the torque scale or of the stated place, are "
            "in tau.gain_std alone"
        )
    else:
        yield from _load_lines(payload, share)
    # Torques of a wrong scale make them differ.
    if parts := [f"{name} {mass:.3g} ± {std:.1g}" for name, (mass, std) in masses]:
        yield f"    by the torque of each joint: {', '.join(parts)} kg"
    yield f"    assumed: {payload['assumed']}"


def _load_lines(payload: Mapping[str, Any], share: str) -> Iterator[str]:
    """Mass, centre of mass and inertia with their intervals, else the parameters that are
    identifiable; what holds the load feasible, and what the intervals hold."""
    texts = []
    groups: tuple[tuple[str, tuple[str, ...], str], ...] = (
        ("mass", ("mass",), "kg"),
        ("com", ("centre of mass x", "y", "z"), "m"),
        ("inertia", ("inertia about it Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz"), "kg m^2"),
    )
    for key, names, unit in groups:
        if ends := payload["intervals"].get(key):
            found = zip(names, np.atleast_1d(payload[key]), ends, strict=True)
            values = [
                f"{name} {value:.4g} in [{low:.4g}, {high:.4g}]"
                for name, value, (low, high) in found
            ]
            texts.append(f"{', '.join(values)} {unit}")
    if not texts:
        units = {"m": "kg", "h": "kg m", "I": "kg m^2"}
        listed = [f"{key} {value_text(payload['parameters'][key])} {units[key[0]]}"
                  for key in identifiable_of(payload)]  # fmt: skip
        texts.append(", ".join(listed) or "nothing of it is identifiable on its own")
    yield f"  payload: {texts[0]}"
    yield from (f"    {text}" for text in texts[1:])
    yield from constraint_lines(payload["constraint"])
    if payload["intervals"]:
        if payload["intervals"]["mass"][0][0] <= 0:
            yield "    the mass may be zero, and then its centre and inertia have no value"
        yield f"    {share} intervals by leaving parts of the motion out{_scale_text(payload)}"


def _scale_text(payload: Mapping[str, Any]) -> str:
    """The uncertainty of the torque scale that intervals hold, or that they hold none."""
    scale = payload["gain_std"]
    if scale["from"] is None:
        return "; errors of the torque scale are not in them: state tau.gain_std in the logs"
    sizes = sorted({f"{100 * u:.2g}" for u in scale["std"].values()}, key=float)
    size = " to ".join(dict.fromkeys((sizes[0], sizes[-1])))
    if scale["from"] == "stated":
        return f" and by the torque scales, {size} % as gain_std of the logs states"
    return (
        f" and by the torque scales, {size} % as far as the joints disagree on the mass; an error "
        "that all joints share shows in none of them: state it as tau.gain_std"
    )


def constraint_lines(constraint: Mapping[str, Any]) -> Iterator[str]:
    """Changes by the constraint of a feasible load; none where the data satisfy it."""
    if not constraint["binds"]:
        return
    yield (
        "    held feasible (mass positive, inertia about the centre within the triangle "
        f"inequality): torque error {_percent(constraint['cost'])}, squared residuals over their "
        f"noise {constraint['excess']:+.3g}"
    )
    free = constraint["without"]
    texts = [f"mass {free['mass'][0]:.4g} kg"] if "mass" in free else []
    if "inertia" in free:
        texts.append(f"inertia {' '.join(f'{x:.2g}' for x in free['inertia'])} kg m^2")
    if texts:
        yield f"      without it: {', '.join(texts)}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:+.2g} %"
