"""Result of an identification of actuators: its fields and their text."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED
from sysid_bench.apps.actuators.commands.file_ranges import percent_text, unit_ratios
from sysid_bench.apps.actuators.commands.servo_result import (
    MORE_NAMES,
    finite,
    servo_lines,
    value_text,
)
from sysid_bench.apps.actuators.drive_estimate import (
    DriveEstimate,
)
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.apps.actuators.position_baselines import (
    REPETITION,
    PositionBaselines,
    rollout_fields,
)
from sysid_bench.commands.identify_result import KNOWN, IdentifyResult
from sysid_bench.commands.result import OMIT_NONE
from sysid_bench.errors import SHOWN, first_names
from sysid_bench.evaluation.baselines import COMMAND, FILE, WORDS, Baselines
from sysid_bench.evaluation.intervals import level_text
from sysid_bench.signals.log import Log
from sysid_bench.types import Array

CONFOUNDED: Final = (
    "delay and armature cannot be separated from this recording; record one more run with kd halved"
)
SILENT: Final = "the commands do not change, so they say nothing of the delay"
OF_JOINT: Final = {
    "rollout_null": FILE, "rollout_command": COMMAND, "rollout_floor": REPETITION
}  # fmt: skip
"""Fields of a joint beside its rollout."""
WIDTHS: Final = (15, 15, 15, 17)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ActuatorsResult(IdentifyResult):
    """Actuators from recordings, links known.

    `joints`: {joint: Ia (kg m^2), fv (N m s/rad), fc (N m), offset (N m); `at_bound`: terms on
    their bound of zero; std, None on a bound; `rollout` (rad): RMS error in the simulation of the
    judged samples, `rollout_null`, `rollout_command` and `rollout_floor` those of the values of the
    file, of the commands and of the repeated motion; `torque_error`: there, of the RMS torque, None
    for joints with hardly any};
    with `also`, gain, bias and load as well; units of slides: kg, N s/m, N, m. `delay` (s) with its
    `delay_interval` for an exact model, and `delay_open`: the error that residuals as large as
    these allow, None where commands do not change. `confounded`: {parameters, direction: changes
    that the data hardly notice}. `profile`: {delay, loss, Ia, fv, fc: medians over the joints}.
    `files`: mean, deviation between files and 95 % interval of a new file, from zero to the value
    of the model file at least where one is on its bound; `units`: deviations between robots and
    between files of one, where logs name their robots (`serial`). `judged`: recordings,
    periods and errors of the rollout. `covariance`: of each joint's values and the delay, between
    files from three on. `motors`: of joints that name one, its `name`, and `armature` with `std`, a
    prior of the fit. `gains` (with `also`): {joints, gain over the stated one, low, high;
    determined} of joints that share one. `lost_motion` (rad, m): {joint: {width of the hysteresis
    between position and command, 2 fc / kp, and twice a dead band; std; backlash: interval}}.
    `limits` (with `also`): tests of each limit of the servo {term, joint, value, ratio of the
    errors of both halves, kept}. `resolution` (rad, m): step of the recorded positions of joints
    that have one. `magnitude`: {joint: {factor: N m (N) over the recorded size, correlation}} of
    the torques that the answer predicts. `configurations`: texts for "mjlab", "isaaclab" and "usd"
    (JSON).
    """

    delay: float
    delay_interval: list[float] | None
    delay_open: float | None
    confounded: list[dict[str, Any]]
    profile: list[dict[str, float]]
    covariance: dict[str, Any]
    configurations: dict[str, str] = field(default_factory=dict)
    shared: list[str]
    files: dict[str, Any] | None = None
    judged: list[dict[str, Any]]
    seconds: float
    motors: dict[str, dict[str, Any]] | None = field(default=None, metadata=OMIT_NONE)
    gains: list[dict[str, Any]] | None = field(default=None, metadata=OMIT_NONE)
    lost_motion: dict[str, dict[str, Any]] | None = field(default=None, metadata=OMIT_NONE)
    limits: list[dict[str, Any]] | None = field(default=None, metadata=OMIT_NONE)
    resolution: dict[str, float] | None = field(default=None, metadata=OMIT_NONE)
    magnitude: dict[str, dict[str, float]] | None = field(default=None, metadata=OMIT_NONE)

    def summary(self) -> str:
        """Values of the joints, delay, what is confounded or on a bound, ranges, rollout."""
        lines = [
            *self._opening_lines(),
            self._first_line(),
            f"  task {self.task}, {self.estimator}: {self.parameters} values of "
            f"{len(self.joints)} joints from {self.seconds:.1f} s, links of the model file",
            *self._delay_lines(),
            f"  {'joint':18} {'Ia':>15} {'fv':>15} {'fc':>15} {'offset':>17}  rollout  command    "
            "file  torque",
        ]
        for name, joint in self.joints.items():
            words = [value_text(joint, term) for term in UNKNOWNS]
            values = " ".join(f"{word:>{width}}" for word, width in zip(words, WIDTHS, strict=True))
            errors = [joint.get(x) for x in ("rollout", "rollout_command", "rollout_null")]
            position = "  ".join("      -" if x is None else f"{1e3 * x:7.2f}" for x in errors)
            error = joint["torque_error"]
            share = "     -" if error is None else f"{100 * error:5.1f}%"
            lines.append(f"  {name:18} {values}  {position}  {share}")
        lines.append(f"  ±: one standard deviation, {self.std_limit}")
        for term in (term for term in self.terms if term in MORE_NAMES and term != "gain"):
            texts = [f"{name} {value_text(joint, term)}" for name, joint in self.joints.items()]
            lines.append(f"  {MORE_NAMES[term]}: {', '.join(texts)}")
        lines += servo_lines(self)
        return "\n".join([*lines, *self._source_lines(), *self._closing_lines()])

    def _first_line(self) -> str:
        """Known values, and errors beside those of the baselines."""
        values = [(one[x], one["std"][x]) for one in self.joints.values() for x in UNKNOWNS]
        sure = sum(std is not None and std < KNOWN * abs(value) for value, std in values)
        known = f"{self.model}: {sure} of {len(values)} values are known within 10 %"
        positions = {"null": WORDS[FILE], "command": WORDS[COMMAND]}
        positions["floor"] = "the motion that the training repeats"
        found = {x: self.scores.get(f"rollout_error_{key}") for key, x in positions.items()}
        texts = [f"{words} {1e3 * x:.2f}" for words, x in found.items() if x is not None]
        if texts and self.rollout_error is not None:
            return (
                f"{known}. Positions simulated under commands that were not fitted err by "
                f"{1e3 * self.rollout_error:.2f} mrad (mm) ({', '.join(texts)})."
            )
        if (null := self.scores.get("torque_error_null")) is None:
            return f"{known}."
        error = 100 * self.scores["torque_error"]
        return f"{known}. Torques err by {error:.3g} % ({WORDS[FILE]} {100 * null:.3g} %)."

    def _delay_lines(self) -> Iterator[str]:
        """The delay, and what is confounded with it."""
        delay = f"  delay {1e3 * self.delay:.2f} ms"
        if self.delay_interval is None:
            if self.delay:
                yield f"{delay}, as stated"
            return
        if self.delay_open is None:
            yield f"{delay}: {SILENT}"
            return
        low, high = (1e3 * end for end in self.delay_interval)
        yield (
            f"{delay}, in {low:.2f} to {high:.2f} ms if the model is exact; residuals as large as "
            f"these leave it open by {1e3 * self.delay_open:.2g} ms"
        )
        if self.confounded:
            first = self.confounded[0]["direction"]
            words = [f"{name} {1e-3 * change:+.2g}" for name, change in first.items()]
            yield f"  {CONFOUNDED}"
            yield (
                f"    1 ms more of delay and {', '.join(words)} (SI) fit nearly alike; others: "
                "--json"
            )

    def _source_lines(self) -> Iterator[str]:
        """Armatures of motors, bounds, scatter between files, rollouts and the written model."""
        motors = [
            f"{name} {motor['armature']:.3g} ± {motor['std']:.2g} ({motor['name']}, found "
            f"{self.joints[name]['Ia']:.3g})"
            for name, motor in (self.motors or {}).items()
        ]
        if motors:
            yield f"  armature of motors, a prior of the fit: {', '.join(motors)}"
        named = [f"{name}.{x}" for name, joint in self.joints.items() for x in joint["at_bound"]]
        if named:
            against = "; they trade against the delay" if self.confounded else ""
            yield (
                "  on the lower bound, zero or a tenth of the model file's, so no estimates: "
                f"{first_names(named, SHOWN)}{against}"
            )
        if units := (self.files or {}).get("units"):
            yield (
                "  median deviation between robots of one type over that between files of one: "
                f"{unit_ratios(units)}"
            )
        if self.files is not None:
            yield (
                f"  between {self.files['count']} files, each fitted by itself: median deviation "
                f"in % of the mean: {percent_text(self.files['joints'])}; {level_text()} ranges of "
                "a new file: --json"
            )
        for one in self.judged if self.rollout_error is not None else ():
            yield (
                f"  simulated under the recorded commands of {one['log']}, {one['from']:.1f} to "
                f"{one['to']:.1f} s, not fitted: RMS error {1e3 * one['rollout']:.2f} mrad (mm)"
            )
        if self.written is not None:
            yield _written_line(self.written)


def baseline_scores(against: Baselines, scores: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores of the baselines, of positions where these are simulated, and what beats
    the answer."""
    rollout = scores["rollout_error"]
    error = scores["torque_error"] if rollout is None else rollout
    beaten = {"beaten_by": ", ".join(against.beaten_by(error))}
    if rollout is None:
        return beaten | {"torque_error_null": against.null}
    return beaten | rollout_fields(against)


def judged_result(result: ActuatorsResult, against: Baselines, accepted: bool) -> ActuatorsResult:
    """Return the result with the reason why it is worse than none, where it is; `accepted`: it may
    pass."""
    error, what = result.scores["rollout_error"], "rad (m), of simulated positions"
    if error is None:
        error, what = result.scores["torque_error"], "of the torque"
    if not (names := against.beaten_by(error)):
        return result
    failure = (
        f"error {error:.4g} {what} on samples that were not fitted: the answer errs more than "
        f"{against.text(names)}. Check kp, kd, signs and times of the recording (sysid-bench "
        "diagnose) and the model's links, or record a richer motion (sysid-bench excite --task "
        "actuators)"
    )
    warnings = [failure, *result.warnings]
    return replace(result, failure=None if accepted else failure, warnings=warnings)


def _written_line(written: Mapping[str, Any]) -> str:
    gap, reason = written["gap"], written["reason"]
    again = f"not checked: {reason}" if gap is None else f"differs by {gap:.1e} rad (m)"
    return f"  model: {written['file']}; simulation by MuJoCo alone {again}"


# --- Fields -------------------------------------------------------------------------------------


def delay_fields(found: DriveEstimate) -> dict[str, Any]:
    """Return delay, its interval and profile, and the directions that the data hardly notice:
    changes of the values of each joint by which a delay is made up for."""
    profile, apart = found.profile, found.separation
    fields = {"delay": found.delay, "delay_interval": None, "delay_open": None}
    if profile is None or apart is None:
        return fields | {"confounded": [], "profile": []}
    directions: list[dict[str, float]] = [{}]  # none of commands that do not change
    if not apart.is_static:
        directions = [
            {f"{name}.{term}": change for term, change in zip(UNKNOWNS[:2], row, strict=False)}
            for name, row in zip(found.rows.joints, apart.direction.tolist(), strict=True)
        ]
    curves = []
    for delay, loss, fit in zip(profile.delays, profile.loss, profile.fits, strict=True):
        medians = np.median(fit.values[:, :SIGNED], axis=0).tolist()
        values = dict(zip(UNKNOWNS[:SIGNED], medians, strict=True))
        curves.append({"delay": float(delay), "loss": float(loss), **values})
    return fields | {
        "delay_interval": list(profile.interval),
        "delay_open": None if apart.is_static else apart.open,
        "confounded": [
            {"parameters": ["delay", *direction], "direction": direction}
            for direction in (directions if apart.is_open else ())
        ],
        "profile": curves,
    }


def motor_fields(log: Log, found: DriveEstimate) -> dict[str, dict[str, Any]]:
    """Return name, armature and its deviation of the motor of each joint that names one."""
    pd, prior, joints = log.description.tau.pd, found.rows.armature, log.description.joints
    if pd is None or pd.motor is None or prior is None:
        return {}
    each = pd.motor if len(pd.motor) > 1 else list(pd.motor) * len(joints)
    names = dict(zip(joints, each, strict=True))
    return {
        joint: {"name": names[joint], "armature": float(value), "std": float(std)}
        for joint, value, std in zip(found.rows.joints, *prior, strict=True)
        if np.isfinite(value)
    }


def joint_fields(
    found: DriveEstimate, squares: Array | None, against: PositionBaselines, torque: Array
) -> dict[str, dict[str, Any]]:
    """Return values, deviations and errors of each joint: squared ones (n, k) of the positions,
    beside those without an identification; relative ones `torque` (k,), NaN where there is none."""
    fit, std, names = found.fit, found.std, (*UNKNOWNS, *found.rows.more)
    positions = None if squares is None else np.sqrt(squares.mean(axis=0))
    return {
        name: {
            **dict(zip(UNKNOWNS, fit.values[j].tolist(), strict=True)),
            **{term: float(x[j]) for term, x in found.other_values.items()},
            "at_bound": [UNKNOWNS[i] for i in np.flatnonzero(fit.at_bound[j])],
            "std": dict(zip(names, map(finite, [*std[j], *fit.more_std[j]]), strict=True)),
            "rollout": None if positions is None else float(positions[j]),
            **{
                key: float(against.joints[x][j])
                for key, x in OF_JOINT.items()
                if x in against.joints
            },
            "torque_error": finite(float(torque[j])),
        }
        for j, name in enumerate(found.rows.joints)
    }
