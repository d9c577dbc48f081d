"""Units of a recording guessed from its numbers: ranges, limits of joints, rates of change."""

from typing import Final

import numpy as np

from sysid_bench.signals.column_names import words_of
from sysid_bench.signals.log_checks import check_finite, check_rates
from sysid_bench.types import Array

_FULL_TURN: Final = 2.0 * np.pi
_SLOWEST: Final = 0.5
"""s between samples above which stamps are not in s."""
_TIME_UNITS: Final = ("s", "ms", "us", "ns")


def position_unit(q: Array, low: Array, high: Array, name: str) -> tuple[str, str]:
    """Return rad or deg for hinges with positions q (N, k) and limits (k,), and the reason."""
    if words_of(name) & {"deg", "degrees", "degree"}:
        return "deg", "the name says so"
    if words_of(name) & {"rad", "radians"}:
        return "rad", "the name says so"
    reach = np.nanmax(np.abs(q), initial=0.0)
    bound = np.maximum(np.abs(low), np.abs(high))
    widest = float(np.max(bound[np.isfinite(bound)], initial=_FULL_TURN))
    if reach <= 2 * widest:
        return "rad", f"the numbers reach {reach:.3g}, the limits of the joints {widest:.3g} rad"
    if np.deg2rad(reach) <= 2 * widest:
        return "deg", (
            f"a doubt: the numbers reach {reach:.4g}, the limits {widest:.3g} rad: degrees, or rad "
            "of motors, then give ratio"
        )
    return "rad", f"a doubt: the numbers reach {reach:.4g}; perhaps of motors, then give ratio"


def time_unit(t: Array) -> tuple[str, str]:
    """Return the unit of time stamps (N,), and the reason: their steps."""
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    fitting = (e for e in range(len(_TIME_UNITS)) if step * 10.0 ** (-3 * e) < _SLOWEST)
    exponent = next(fitting, len(_TIME_UNITS) - 1)
    unit, seconds = _TIME_UNITS[exponent], step * 10.0 ** (-3 * exponent)
    return unit, f"the stamps step by {step:.4g}, so {1 / seconds:.4g} Hz"


def velocity_unit(q: Array, v: Array, rate: float, unit_of_q: str) -> tuple[str, str]:
    """Return rad/s or deg/s for v (N, k) beside q (N, k) in rad, and the reason."""
    joints = [str(j) for j in range(q.shape[1])]
    q, v = _valid(q, v)
    for unit, scale in (("rad/s", 1.0), ("deg/s", np.pi / 180.0)):
        _, measured = check_rates(q, v * scale, rate, joints)
        if measured is not None and abs(measured / rate - 1) < 0.2:
            return unit, "v and the differences of q agree in it"
    unit = f"{unit_of_q}/s"
    return unit, "a doubt: v and the differences of q do not agree; the unit of q is taken"


def measured_rate(q: Array, v: Array) -> float | None:
    """Return the rate (Hz) at which v (N, k) and the differences of q agree, None without one."""
    q, v = _valid(q, v)
    _, rate = check_rates(q, v, 100.0, [str(j) for j in range(q.shape[1])])
    return rate


def _valid(q: Array, v: Array) -> tuple[Array, Array]:
    """Return the samples of q and v (N, k) that are measurements."""
    valid = ~check_finite(q, v)
    return q[valid], v[valid]
