"""Fields of an identification of actuators: delay, values of joints, ranges between files."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED
from sysid_bench.apps.actuators.delay_profile import DelayInformation, DelayProfile
from sysid_bench.apps.actuators.drive_estimate import (
    DriveEstimate,
    RepeatInterval,
    identify_drives,
    repeat_covariance,
    repeat_interval,
)
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS, DriveRows
from sysid_bench.signals.log import Log
from sysid_bench.types import Array

FILES: Final = 3
"""Recordings from which on deviations are those between files."""

LIMITS: Final = {
    "files": "between the values of single files",
    "residuals": "from blocks of the residuals: repeated runs scatter more (give several --log)",
}


def delay_fields(found: DriveEstimate) -> dict[str, Any]:
    """Return delay, its interval and profile, and the directions that the data hardly notice."""
    profile, apart = found.profile, found.separation
    if profile is None or apart is None:
        return {
            "delay": found.delay, "delay_interval": None, "delay_open": None,
            "confounded": [], "profile": [],
        }  # fmt: skip
    return {
        "delay": found.delay,
        "delay_interval": list(profile.interval),
        "delay_open": None if apart.is_static else apart.open,
        "confounded": _confounded(found.rows.joints, apart) if apart.is_open else [],
        "profile": _profile_fields(profile),
    }


def _confounded(joints: Sequence[str], apart: DelayInformation) -> list[dict[str, Any]]:
    """Changes of the values of each joint by which a delay is made up for; none of commands that
    do not change."""
    directions: list[dict[str, float]] = [
        {f"{name}.{term}": change for term, change in zip(UNKNOWNS[:2], row, strict=False)}
        for name, row in zip(joints, apart.direction.tolist(), strict=True)
    ]
    return [
        {"parameters": ["delay", *direction], "direction": direction}
        for direction in ([{}] if apart.is_static else directions)
    ]


def _profile_fields(profile: DelayProfile) -> list[dict[str, float]]:
    return [
        {"delay": float(d), "loss": float(loss), **_medians(fit.values)}
        for d, loss, fit in zip(profile.delays, profile.loss, profile.fits, strict=True)
    ]


def motor_fields(log: Log, found: DriveEstimate) -> dict[str, dict[str, Any]]:
    """Return name, armature and its deviation of the motor of each joint that names one."""
    pd, prior = log.description.tau.pd, found.rows.armature
    if pd is None or pd.motor is None or prior is None:
        return {}
    names = dict(zip(log.description.joints, _each(pd.motor, log), strict=True))
    return {
        joint: {"name": names[joint], "armature": float(value), "std": float(std)}
        for joint, value, std in zip(found.rows.joints, *prior, strict=True)
        if np.isfinite(value)
    }


def _each(names: Sequence[str], log: Log) -> Sequence[str]:
    return names if len(names) > 1 else list(names) * len(log.description.joints)


def _medians(values: Array) -> dict[str, float]:
    middle = np.median(values[:, :SIGNED], axis=0).tolist()
    return dict(zip(UNKNOWNS[:SIGNED], middle, strict=True))


def joint_fields(
    found: DriveEstimate, rollout: Array | None, torque: Array
) -> dict[str, dict[str, Any]]:
    """Return values, deviations and errors of each joint: squared ones `rollout` (n, k) of the
    positions, relative ones `torque` (k,), NaN where there is none."""
    fit, std, names = found.fit, found.std, (*UNKNOWNS, *found.rows.more)
    positions = None if rollout is None else np.sqrt(rollout.mean(axis=0))
    return {
        name: {
            **_values(found, j),
            "at_bound": [UNKNOWNS[i] for i in np.flatnonzero(fit.at_bound[j])],
            "std": dict(zip(names, map(_number, [*std[j], *fit.more_std[j]]), strict=True)),
            "rollout": None if positions is None else float(positions[j]),
            "torque_error": _number(float(torque[j])),
        }
        for j, name in enumerate(found.rows.joints)
    }


def _values(found: DriveEstimate, j: int) -> dict[str, float]:
    """Values of a joint by name, those asked for besides the usual ones behind them."""
    usual = dict(zip(UNKNOWNS, found.fit.values[j].tolist(), strict=True))
    return {**usual, **{name: float(x[j]) for name, x in found.other_values.items()}}


def _number(x: float) -> float | None:
    return x if np.isfinite(x) else None


def file_fields(
    singles: Sequence[DriveRows],
    shared: Sequence[str],
    delay: float | None,
    answer: Mapping[str, dict[str, Any]],
) -> dict[str, Any]:
    """Return the ranges between recordings, each fitted by itself; from FILES of them on these are
    the deviations of the joints of the `answer`. Nothing for one recording."""
    if len(singles) < 2:
        return {}
    fits = [identify_drives(rows, shared, delay) for rows in singles]
    files = _ranges_between(singles[0].joints, fits)
    if len(singles) < FILES:
        return {"files": files}
    return {
        "files": files, "joints": _with_deviations(answer, files["joints"]),
        "covariance": files["covariance"], "std_from": "files", "std_limit": LIMITS["files"],
    }  # fmt: skip


def _ranges_between(joints: Sequence[str], fits: Sequence[DriveEstimate]) -> dict[str, Any]:
    """Ranges of values and delay between the fits of single files, and their covariance."""
    usual, delays = np.array([x.fit.values for x in fits]), np.array([x.delay for x in fits])
    more = [np.array([x.other_values[name] for x in fits]) for name in fits[0].rows.more]
    ranges = repeat_interval(np.concatenate([usual, *(x[..., None] for x in more)], axis=2))
    by_joint = {
        name: {
            term: _range(ranges, (j, i)) for i, term in enumerate((*UNKNOWNS, *fits[0].rows.more))
        }
        for j, name in enumerate(joints)
    }
    return {
        "covariance": covariance_fields(joints, repeat_covariance(usual, delays)),
        "count": ranges.count, "share": ranges.share, "joints": by_joint,
        "delay": _range(repeat_interval(delays), ()), "mjcf": _entries(by_joint),
    }  # fmt: skip


def _with_deviations(
    answer: Mapping[str, dict[str, Any]], ranges: Mapping[str, Mapping[str, Mapping[str, float]]]
) -> dict[str, dict[str, Any]]:
    """The joints of an answer with the deviations of their values between files."""
    return {
        name: {**joint, "std": {term: one["std"] for term, one in ranges[name].items()}}
        for name, joint in answer.items()
    }


def covariance_fields(joints: Sequence[str], covariance: Array) -> dict[str, Any]:
    """Return covariances (k, 5, 5) of values and delay by joint, for ranges drawn jointly."""
    return {
        "of": [*UNKNOWNS, "delay"],
        "joints": dict(zip(joints, covariance.tolist(), strict=True)),
    }


def _range(ranges: RepeatInterval, place: tuple[int, ...]) -> dict[str, float]:
    return {name: float(getattr(ranges, name)[place]) for name in ("mean", "std", "low", "high")}


def _entries(joints: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, list[float]]]:
    """Ranges of the attributes of MJCF joints, cut at zero."""
    words = dict(zip(UNKNOWNS[:SIGNED], ("armature", "damping", "frictionloss"), strict=True))
    return {
        name: {
            word: [max(terms[term]["low"], 0.0), max(terms[term]["high"], 0.0)]
            for term, word in words.items()
        }
        for name, terms in joints.items()
    }
