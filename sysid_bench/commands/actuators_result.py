"""Result of an identification of actuators: its fields and their text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from sysid_bench.commands.identify_result import IdentifyResult, behind
from sysid_bench.commands.result import OMIT_NONE
from sysid_bench.errors import SHOWN, first_names
from sysid_bench.evaluation.intervals import level_text
from sysid_bench.signals.log import Log
from sysid_bench.types import Array

WIDTHS: Final = (15, 15, 15, 17)
CONFOUNDED: Final = (
    "delay and armature cannot be separated from this recording; record one more run with kd halved"
)
MORE_NAMES: Final = {
    "gain": "torque over that of the stated gains",
    "bias": "position less that of the encoder (rad, m)",
    "load": "friction over the torque of the links",
}
SILENT: Final = "the commands do not change, so they say nothing of the delay"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ActuatorsResult(IdentifyResult):
    """Actuators from recordings, links known.

    `joints`: {joint: Ia (kg m^2), fv (N m s/rad), fc (N m), offset (N m); `at_bound`: terms on
    their bound of zero; std, None on a bound; `rollout` (rad): RMS error in the simulation of the
    judged samples; `torque_error`: there, of the RMS torque, None for joints with hardly any};
    with `also`, gain, bias and load as well; units of slides: kg, N s/m, N, m. `delay` (s) with its
    `delay_interval` for an exact model, and `delay_open`: the error that residuals as large as
    these allow, None where commands do not change. `confounded`: {parameters, direction: changes
    that the data hardly notice}. `profile`: {delay, loss, Ia, fv, fc: medians over the joints}.
    `files`: mean, deviation between files and 95 % interval of a new file. `judged`: recordings,
    periods and errors of the rollout. `covariance`: of each joint's values and the delay, between
    files from three on. `motors`: of joints that name one, its `name`, and `armature` with `std`, a
    prior of the fit. `configurations`: texts for "mjlab" and "isaaclab".
    """

    rollout_error: float | None = field(metadata=behind("torque_error"))
    delay: float = field(metadata=behind("torque_error"))
    delay_interval: list[float] | None = field(metadata=behind("torque_error"))
    delay_open: float | None = field(metadata=behind("torque_error"))
    confounded: list[dict[str, Any]] = field(metadata=behind("torque_error"))
    profile: list[dict[str, float]] = field(metadata=behind("torque_error"))
    joints: dict[str, dict[str, Any]] = field(metadata=behind("profile"))
    covariance: dict[str, Any] = field(metadata=behind("joints"))
    configurations: dict[str, str] = field(metadata=behind("joints"))
    shared: list[str] = field(metadata=behind("joints"))
    files: dict[str, Any] | None = field(metadata=behind("joints"))
    judged: list[dict[str, Any]] = field(metadata=behind("joints"))
    seconds: float = field(metadata=behind("joints"))
    # Bounded least squares always ends, with values that can exist, and knows no bodies.
    feasible: bool | None = field(default=True, metadata=behind("warnings"))
    converged: bool | None = field(default=True, metadata=behind("feasible"))
    iterations: int | None = field(default=None, metadata=behind("feasible"))
    simulations: int | None = field(default=None, metadata=behind("feasible"))
    stop: str = field(default="", metadata=behind("feasible"))
    condition: float | None = field(default=None, metadata=behind("stop"))
    condition_unit: float | None = field(default=None, metadata=behind("stop"))
    base: list[dict[str, Any]] = field(default_factory=list, metadata=behind("condition_unit"))
    bodies: dict[str, dict[str, Any]] = field(
        default_factory=dict, metadata=behind("condition_unit")
    )
    payload: dict[str, Any] | None = field(default=None, metadata=behind("condition_unit"))
    motors: dict[str, dict[str, Any]] | None = field(
        default=None, metadata=OMIT_NONE | behind("payload")
    )
    written: dict[str, Any] | None = field(default=None, metadata=OMIT_NONE)

    def summary(self) -> str:
        """Values of the joints, delay, what is confounded or on a bound, ranges, rollout."""
        lines = [
            f"{self.model}, task {self.task}, {self.estimator}: {self.parameters} values of "
            f"{len(self.joints)} joints from {self.seconds:.1f} s, links of the model file",
            *self._delay_lines(),
            f"  {'joint':18} {'Ia':>15} {'fv':>15} {'fc':>15} {'offset':>17}  rollout  torque",
            *(_joint_line(name, joint) for name, joint in self.joints.items()),
            f"  ±: one standard deviation, {self.std_limit}",
            *self._more_lines(),
            *self._motor_lines(),
            *self._bound_lines(),
            *self._file_lines(),
            *self._judged_lines(),
            *self._written_lines(),
        ]
        return "\n".join(lines + self._closing_lines())

    def _delay_lines(self) -> list[str]:
        if self.delay_interval is None:
            return [f"  delay {1e3 * self.delay:.2f} ms, as stated"] if self.delay else []
        if self.delay_open is None:
            return [f"  delay {1e3 * self.delay:.2f} ms: {SILENT}"]
        low, high = (1e3 * end for end in self.delay_interval)
        return [
            f"  delay {1e3 * self.delay:.2f} ms, in {low:.2f} to {high:.2f} ms if the model is "
            f"exact; residuals as large as these leave it open by {1e3 * self.delay_open:.2g} ms",
            *self._confounded_lines(),
        ]

    def _confounded_lines(self) -> list[str]:
        if not self.confounded:
            return []
        first = self.confounded[0]["direction"]
        words = [f"{name} {1e-3 * change:+.2g}" for name, change in first.items()]
        return [
            f"  {CONFOUNDED}",
            f"    1 ms more of delay and {', '.join(words)} (SI) fit nearly alike; others: --json",
        ]

    def _more_lines(self) -> list[str]:
        """Further unknowns, each with the joints' values."""
        return [
            f"  {MORE_NAMES[term]}: "
            + ", ".join(f"{name} {_value_text(joint, term)}" for name, joint in self.joints.items())
            for term in self.terms
            if term in MORE_NAMES
        ]

    def _motor_lines(self) -> list[str]:
        """Armatures of tables of motors, each with the values that were found."""
        parts = [
            f"{name} {motor['armature']:.3g} ± {motor['std']:.2g} ({motor['name']}, found "
            f"{self.joints[name]['Ia']:.3g})"
            for name, motor in (self.motors or {}).items()
        ]
        return [f"  armature of motors, a prior of the fit: {', '.join(parts)}"] if parts else []

    def _bound_lines(self) -> list[str]:
        named = [f"{name}.{x}" for name, joint in self.joints.items() for x in joint["at_bound"]]
        if not named:
            return []
        against = "; they trade against the delay" if self.confounded else ""
        return [f"  on the bound of zero, so no estimates: {first_names(named, SHOWN)}{against}"]

    def _file_lines(self) -> list[str]:
        if self.files is None:
            return []
        return [
            f"  between {self.files['count']} files, each fitted by itself: median deviation in % "
            f"of the mean: {_percent(self.files['joints'])}; {level_text()} ranges of a new file: "
            "--json"
        ]

    def _judged_lines(self) -> list[str]:
        if self.rollout_error is None:
            return []
        return [
            f"  simulated under the recorded commands of {one['log']}, {one['from']:.1f} to "
            f"{one['to']:.1f} s, not fitted: RMS error {1e3 * one['rollout']:.2f} mrad (mm)"
            for one in self.judged
        ]

    def _written_lines(self) -> list[str]:
        if self.written is None:
            return []
        gap, reason = self.written["gap"], self.written["reason"]
        again = "simulation by MuJoCo alone "
        again += f"not checked: {reason}" if gap is None else f"differs by {gap:.1e} rad (m)"
        return [f"  model: {self.written['file']}; {again}"]


def _joint_line(name: str, joint: Mapping[str, Any]) -> str:
    words = [_value_text(joint, term) for term in UNKNOWNS]
    rollout = "      -" if joint["rollout"] is None else f"{1e3 * joint['rollout']:7.2f}"
    share = "     -" if joint["torque_error"] is None else f"{100 * joint['torque_error']:5.1f}%"
    values = " ".join(f"{word:>{width}}" for word, width in zip(words, WIDTHS, strict=True))
    return f"  {name:18} {values}  {rollout}  {share}"


def _value_text(joint: Mapping[str, Any], term: str) -> str:
    if term in joint["at_bound"]:
        return "bound"
    return f"{joint[term]:.3g} ± {joint['std'][term]:.1g}"


def _percent(joints: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Median over the joints of the deviation between files over the mean, term by term."""
    words = []
    for term in UNKNOWNS:
        shares = [abs(j[term]["std"] / j[term]["mean"]) for j in joints.values() if j[term]["mean"]]
        words.append(f"{term} {100 * sorted(shares)[len(shares) // 2]:.2g}" if shares else term)
    return ", ".join(words)


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
