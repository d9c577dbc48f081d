"""Servo part of the result of an identification of actuators: gains, limits, lost motion and
backlash, resolution, and sizes of currents; fields and text."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.apps.actuators.backlash import friction_std, load_steps
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_part import DrivePart
from sysid_bench.apps.actuators.drive_rows import drive_filter, used_rows
from sysid_bench.apps.actuators.gain_profile import GainProfile
from sysid_bench.apps.actuators.servo_limits import LimitTest
from sysid_bench.errors import SHOWN, first_names
from sysid_bench.evaluation.intervals import coverage_factor
from sysid_bench.signals.log import Log
from sysid_bench.types import Array

if TYPE_CHECKING:
    from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult

RATIOS: Final = (
    "these recordings do not determine the gain, so that all values are ratios to the stated kp: "
    "postures under more gravity, a known mass at the tool (payload), or measured torques would"
)
"""Of position commands alone."""
BACKLASH: Final = "where its load changes sign beyond friction, else at most the lost motion"
FINEST: Final = 1e-5
"""Share of the range of positions below which differences are rounding."""
OFF_GRID: Final = 0.05
ON_GRID: Final = 0.95
"""Steps from a multiple of the smallest one, and the share of differences within it."""
MORE_NAMES: Final = {
    "gain": "torque over that of the stated gains",
    "bias": "position less that of the encoder (rad, m)",
    "load": "friction over the torque of the links",
}


def value_text(joint: Mapping[str, Any], term: str) -> str:
    if term in joint["at_bound"]:
        return f"{joint[term]:.3g} (bound)"
    return f"{joint[term]:.3g} ± {joint['std'][term]:.1g}"


def gain_text(one: Mapping[str, Any]) -> str:
    """Return the line of the gain of joints that share one."""
    names = first_names(one["joints"], SHOWN)
    if not one["determined"]:
        return f"  gain of {names}: {RATIOS}"
    return (
        f"  {MORE_NAMES['gain']}: {one['gain']:.3g} ({one['low']:.3g} to {one['high']:.3g} if "
        f"the model is exact), one of {names}"
    )


def gain_fields(profiles: Sequence[GainProfile], joints: Sequence[str]) -> list[dict[str, Any]]:
    """Return the gains with their intervals by the names of their joints."""
    return [
        {
            "joints": [joints[j] for j in one.joints],
            "gain": one.gain,
            "low": finite(one.interval[0]),
            "high": finite(one.interval[1]),
            "determined": not one.is_open,
        }
        for one in profiles
    ]


def lost_motion_fields(found: DriveEstimate, kp: Array) -> dict[str, dict[str, Any]]:
    """Return the widths of the hysteresis between position and command for the last kp (k,), and
    the interval of the backlash in them."""
    acting = kp * found.other_values.get("gain", np.ones(len(kp)))
    width, std = 2.0 * found.fit.values[:, 2] / acting, 2.0 * friction_std(found) / acting
    width = width + 2.0 * found.rows.servo.get("dead-band", np.zeros(len(kp)))
    reach = coverage_factor(np.inf)
    play, play_std = (2.0 * x / kp for x in load_steps(found, kp))
    # Not more than all of the hysteresis, whatever the load does.
    low = np.nan_to_num(np.maximum(play - reach * play_std, 0.0))
    most = np.fmax(width + reach * std, low)
    high = np.fmin(np.maximum(play + reach * play_std, 0.0), most)
    return {
        name: {
            "width": float(width[j]),
            "std": float(std[j]),
            "backlash": [float(low[j]), float(high[j])],
        }
        for j, name in enumerate(found.rows.joints)
    }


def limit_fields(tests: Sequence[LimitTest], found: DriveEstimate) -> list[dict[str, Any]]:
    """Return the tests of limits joint by joint, torques as they act."""
    gain = found.other_values.get("gain", np.ones(len(found.rows.joints)))
    return [
        {
            "term": test.term,
            "joint": name,
            "value": finite(float(value)),
            "ratio": test.ratio[:, j].tolist(),
            "kept": bool(test.kept[j]),
        }
        for test in tests
        for j, (name, value) in enumerate(
            zip(
                found.rows.joints,
                test.value * (gain if test.term == "torque-limit" else 1.0),
                strict=True,
            )
        )
    ]


def resolution_fields(log: Log) -> dict[str, float]:
    """Return the step of the recorded positions of each joint, as far as they lie on one grid."""
    steps: dict[str, float] = {}
    if log.raw is None:
        return steps
    for name in log.joints:
        values = np.unique(log.raw.q[:, log.description.joints.index(name)])
        values = values[np.isfinite(values)]
        gaps = np.diff(values)
        # Differences of rounding are not steps.
        gaps = gaps[gaps > FINEST * np.ptp(values)] if len(gaps) else gaps
        if not len(gaps) or len(values) > 0.5 * len(log.raw):
            continue
        counts = gaps / gaps.min()
        if np.mean(np.abs(counts - np.round(counts)) < OFF_GRID) > ON_GRID:
            steps[name] = float(np.median(gaps / np.round(counts)))
    return steps


def magnitude_fields(
    found: DriveEstimate, parts: Sequence[DrivePart]
) -> dict[str, dict[str, float]]:
    """Return correlation and factor of the sizes of torques that the answer predicts over the
    recorded sizes, of rows in which a joint moves."""
    rows, sizes = found.rows, []
    for part in parts:
        commands = part.log.commands
        if commands is None or commands.magnitude is None:
            return {}
        own = commands.of(rows.joints).select(part.rows)
        assert own.magnitude is not None
        smooth = drive_filter(own.rate).smooth(np.abs(own.magnitude), own.rate)
        sizes.append(smooth[used_rows(own.rate, len(smooth))])
    size, weight = np.concatenate(sizes), rows.features[:, :, 3]
    used = found.fit.values.shape[1]
    tau = np.einsum("nkc,kc->nk", rows.features[..., :used], found.fit.values) + rows.links
    fields = {}
    for j, name in enumerate(rows.joints):
        moving = weight[:, j] > 0.0
        x, y = size[moving, j], np.abs(tau[moving, j] / weight[moving, j])
        if x.std() > 0.0 and y.std() > 0.0:
            correlation = float(np.corrcoef(x, y)[0, 1])
            fields[name] = {"factor": float(x @ y / (x @ x)), "correlation": correlation}
    return fields


def servo_lines(result: "ActuatorsResult") -> Iterator[str]:
    """Yield the lines of gains, limits, lost motion, resolution and sizes of currents."""
    yield from map(gain_text, result.gains or ())
    yield from _limit_lines(result.limits or ())
    widest = sorted((result.lost_motion or {}).items(), key=lambda item: -item[1]["width"])
    texts, plays = [], []
    for name, one in widest[:SHOWN]:
        low, high = (1e3 * x for x in one["backlash"])
        texts.append(f"{name} {1e3 * one['width']:.3g} ± {1e3 * one['std']:.1g}")
        plays.append(f"{name} {low:.2g} to {high:.2g}")
    more = "" if len(widest) <= SHOWN else "; others: --json"
    if texts:
        yield f"  lost motion 2 fc / kp in mrad (mm): {', '.join(texts)}{more}"
        yield f"  of which backlash, {BACKLASH}: {', '.join(plays)}{more}"
    if result.resolution:
        steps = [f"{name} {1e3 * x:.3g}" for name, x in list(result.resolution.items())[:SHOWN]]
        more = "" if len(result.resolution) <= SHOWN else "; others: --json"
        yield f"  resolution of the positions in mrad (mm): {', '.join(steps)}{more}"
    if result.magnitude:
        texts = [
            f"{name} {one['factor']:.3g} (correlation {one['correlation']:.2f})"
            for name, one in result.magnitude.items()
        ]
        yield f"  size of the torque in N m (N) over the recorded one: {', '.join(texts)}"


def _limit_lines(tests: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    kept = [
        f"{one['term']} of {one['joint']} {one['value']:.3g} (errors {one['ratio'][0]:.2f} and "
        f"{one['ratio'][1]:.2f} of those without)"
        for one in tests
        if one["kept"]
    ]
    if tests:
        terms = ", ".join(dict.fromkeys(one["term"] for one in tests))
        yield (
            f"  limits of the servo that the data keep (SI), of {terms}: "
            f"{', '.join(kept) or 'none'}"
        )


def finite(x: float) -> float | None:
    return x if np.isfinite(x) else None
