"""Ranges of actuators between recordings, and between robots: fields and text."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED
from sysid_bench.apps.actuators.drive_estimate import (
    DriveEstimate,
    identify_drives,
    repeat_covariance,
)
from sysid_bench.apps.actuators.drive_rows import LEAST, UNKNOWNS, DriveRows
from sysid_bench.evaluation.intervals import confidence_level, new_value_interval
from sysid_bench.types import Array

FILES: Final = 3
"""Recordings from which on deviations are those between files."""
LIMITS: Final = {
    "files": "between the values of single files",
    "residuals": "from blocks of the residuals: repeated runs scatter more (give several --log)",
}


def covariance_fields(joints: Sequence[str], covariance: Array) -> dict[str, Any]:
    """Return covariances (k, 5, 5) of values and delay by joint, for ranges drawn jointly."""
    return {
        "of": [*UNKNOWNS, "delay"],
        "joints": dict(zip(joints, covariance.tolist(), strict=True)),
    }


def file_fields(
    singles: Sequence[DriveRows],
    shared: Sequence[str],
    delay: float | None,
    answer: Mapping[str, dict[str, Any]],
    serials: Sequence[str | None],
) -> dict[str, Any]:
    """Return the ranges between recordings, each fitted by itself; from FILES of them on these are
    the deviations of the joints of the `answer`. Nothing for one recording. `serials`: robot of
    each recording, as far as it is stated."""
    if len(singles) < 2:
        return {}
    fits = [identify_drives(rows, shared, delay) for rows in singles]
    files = _between(singles, fits, serials)
    # Two files give a range, and hardly a deviation: that of the residuals stays.
    if len(singles) < FILES:
        return {"files": files}
    between = {
        name: {**joint, "std": {term: one["std"] for term, one in files["joints"][name].items()}}
        for name, joint in answer.items()
    }
    return {
        "files": files,
        "joints": between,
        "covariance": files["covariance"],
        "std_from": "files",
        "std_limit": LIMITS["files"],
    }


def _between(
    singles: Sequence[DriveRows], fits: Sequence[DriveEstimate], serials: Sequence[str | None]
) -> dict[str, Any]:
    """Ranges of values and delay between the fits of single files, and their covariance."""
    joints, terms = singles[0].joints, (*UNKNOWNS, *singles[0].more)
    usual, delays = np.array([x.fit.values for x in fits]), np.array([x.delay for x in fits])
    more = [np.array([x.other_values[name] for x in fits])[..., None] for name in singles[0].more]
    ranges = _ranges(np.concatenate([usual, *more], axis=2))
    by_joint = {
        name: {
            term: {key: float(x[j, i]) for key, x in ranges.items()} for i, term in enumerate(terms)
        }
        for j, name in enumerate(joints)
    }
    held = np.any([x.fit.at_bound for x in fits], axis=0)
    for j, i in np.argwhere(held):
        # On its bound in one file, it may be anything from zero to the model's in the next.
        one = by_joint[joints[j]][terms[i]]
        own = 0.0 if singles[0].low is None else float(singles[0].low[j, i]) / LEAST
        one["low"], one["high"] = min(one["low"], 0.0), max(one["high"], own)
    words = dict(zip(UNKNOWNS[:SIGNED], ("armature", "damping", "frictionloss"), strict=True))
    return {
        "covariance": covariance_fields(joints, repeat_covariance(usual, delays)),
        "count": len(fits),
        "share": confidence_level(),
        "joints": by_joint,
        "delay": {key: float(x) for key, x in _ranges(delays).items()},
        **unit_fields(np.concatenate([usual, *more], axis=2), (joints, terms), serials),
        "mjcf": {
            name: {
                word: [max(one[term][end], 0.0) for end in ("low", "high")]
                for term, word in words.items()
            }
            for name, one in by_joint.items()
        },
    }


def unit_fields(
    values: Array, names: tuple[Sequence[str], Sequence[str]], serials: Sequence[str | None]
) -> dict[str, Any]:
    """Deviations of values (n, k, c) of joints and terms between robots, and between files of one
    (one-way analysis of variance); nothing without several robots with several files."""
    units = [np.flatnonzero([x == serial for x in serials]) for serial in dict.fromkeys(serials)]
    if None in serials or len(units) < 2 or len(units) == len(serials):
        return {}
    means = np.array([values[unit].mean(axis=0) for unit in units])
    moved = [values[unit] - values[unit].mean(axis=0) for unit in units]
    within = (np.concatenate(moved) ** 2).sum(axis=0) / (len(serials) - len(units))
    # The mean of a unit scatters by its files too.
    of_files = within * np.mean([1.0 / len(unit) for unit in units])
    between = np.sqrt(np.maximum(means.var(axis=0, ddof=1) - of_files, 0.0))
    return {
        "units": {
            joint: {
                term: {"between_units": float(between[j, i]), "between_files": float(x)}
                for i, (term, x) in enumerate(zip(names[1], np.sqrt(within[j]), strict=True))
            }
            for j, joint in enumerate(names[0])
        }
    }


def _ranges(values: Array) -> dict[str, Array]:
    """Mean and deviation (...) of the values of n files (n, ...), and the ends of the range of a
    new one."""
    # Of a new file, not of the mean: the next robot, day or floor scatters as these did.
    low, high = new_value_interval(values)
    return {
        "mean": values.mean(axis=0),
        "std": values.std(axis=0, ddof=1),
        "low": low,
        "high": high,
    }


def unit_ratios(units: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Median over the joints of the deviation between robots over that between files."""
    texts = []
    for term in UNKNOWNS:
        pairs = [(x[term]["between_units"], x[term]["between_files"]) for x in units.values()]
        texts.append(f"{term} {np.median([a / b for a, b in pairs if b > 0.0] or [0.0]):.2g}")
    return ", ".join(texts)


def percent_text(joints: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Median over the joints of the deviation between files over the mean, term by term."""
    words = []
    for term in UNKNOWNS:
        shares = [abs(j[term]["std"] / j[term]["mean"]) for j in joints.values() if j[term]["mean"]]
        words.append(f"{term} {100 * sorted(shares)[len(shares) // 2]:.2g}" if shares else term)
    return ", ".join(words)
