"""From raw signals to a motion: filter, differentiate, cut the edges."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import Joint
from sysid_bench.signals.filters import Filter, FourierSeries, derivative, filter_of
from sysid_bench.spatial.rotation import conjugate, product
from sysid_bench.types import Array, Recording

SETTINGS: Final = ("filter", "derivatives", "torque", "calibration", "contacts", "runs")
"""Keys of a table of signals; the harness itself sees to calibrations, contacts and runs."""


@dataclass(frozen=True)
class Processing:
    """One filter for every signal, none late against another; `differentiate`: v and a from the
    filtered q, else the recording's own; `from_rates`: its own v, filtered, and a from that, as
    drives that measure speed allow. With `raw_torque` the torque is left as it came: least
    squares averages its noise, while a filter rounds the steps of Coulomb friction, which the
    regressor's sign(v) keeps."""

    filter: Filter
    differentiate: bool
    raw_torque: bool = False
    from_rates: bool = False

    def apply(self, recording: Recording, joints: tuple[Joint, ...]) -> Recording:
        """A recording with v and a; UsageError where it is too short, or v and a are absent."""
        smooth, rate = self.filter.smooth, recording.rate
        differences = self.differentiate or self.from_rates
        if isinstance(self.filter, FourierSeries):
            _require_periods(recording, self.filter)
            differences = False
        edge = self.filter.edge(rate) + (2 if differences else 0)
        if len(recording) <= 2 * edge + 10:
            raise UsageError(
                f"{len(recording)} samples are too few for {self.filter}: it spoils {edge} at each "
                "end."
            )
        q = _smooth_positions(recording.q, joints, self.filter, rate)
        if self.differentiate:
            v = _rates(q, joints, self.filter, rate)
            a = derivative(self.filter, v, rate)
        elif self.from_rates and recording.v is not None:
            v = smooth(recording.v, rate)
            a = derivative(self.filter, v, rate)
        elif self.from_rates:
            raise UsageError("derivatives = 'from v' needs a recording with v; use 'from q'.")
        elif recording.v is None or recording.a is None:
            raise UsageError("derivatives = 'exact' needs a recording with v and a; use 'from q'.")
        else:
            v, a = smooth(recording.v, rate), smooth(recording.a, rate)
        tau = recording.tau if self.raw_torque else smooth(recording.tau, rate)
        wrench = recording.wrench
        if wrench is not None and not self.raw_torque:
            wrench = smooth(wrench, rate)
        keep = slice(edge, len(recording) - edge)
        return replace(
            recording, t=recording.t[keep], q=q[keep], v=v[keep], a=a[keep], tau=tau[keep],
            wrench=None if wrench is None else wrench[keep],
        )  # fmt: skip


def processing_of(spec: Mapping[str, object]) -> Processing:
    """The processing of a suite's table {filter, derivatives, torque}."""
    for key in spec:
        if key not in SETTINGS:
            raise unknown_name("signals setting", key, SETTINGS)
    derivatives = spec.get("derivatives", "exact")
    if derivatives not in ("exact", "from q", "from v"):
        raise UsageError(f"derivatives = {derivatives!r}: write 'exact', 'from q' or 'from v'.")
    torque = spec.get("torque", "filtered")
    if torque not in ("filtered", "raw"):
        raise UsageError(f"torque = {torque!r}: write 'filtered' or 'raw'.")
    filter = filter_of(str(spec.get("filter", "none")))
    return Processing(filter, derivatives == "from q", torque == "raw", derivatives == "from v")


def _smooth_positions(q: Array, joints: tuple[Joint, ...], filter: Filter, rate: float) -> Array:
    """Quaternions are made continuous in sign before, and of unit length after the filter."""
    q = q.copy()
    turns = _quaternions(joints)
    for turn in turns:
        flips = np.sum(q[1:, turn] * q[:-1, turn], axis=1) < 0
        q[1:, turn] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
    q = filter.smooth(q, rate)
    for turn in turns:
        q[:, turn] /= np.linalg.norm(q[:, turn], axis=1, keepdims=True)
    return q


def _require_periods(recording: Recording, filter: Filter) -> None:
    """A series takes the end of a recording for its start."""
    samples = 0.0 if recording.period is None else recording.period * recording.rate
    if samples == 0.0 or abs(len(recording) / samples - round(len(recording) / samples)) > 1e-9:
        period = "no period" if recording.period is None else f"periods of {recording.period:g} s"
        raise UsageError(
            f"{filter} needs whole periods; {len(recording)} samples at {recording.rate:g} Hz have "
            f"{period}. Take an excitation that repeats, or the filter 'butter'."
        )


def _rates(q: Array, joints: tuple[Joint, ...], filter: Filter, rate: float) -> Array:
    """dq/dt (N, nv); for quaternions the body's angular velocity 2 conj(q) dq/dt."""
    dq = derivative(filter, q, rate)
    v = np.empty((len(q), sum(len(joint.dofs) for joint in joints)))
    for joint in joints:
        at, dof = joint.qadr, joint.vadr
        if joint.kind in ("hinge", "slide"):
            v[:, dof] = dq[:, at]
            continue
        if joint.kind == "free":
            v[:, dof : dof + 3] = dq[:, at : at + 3]
            at, dof = at + 3, dof + 3
        turn = slice(at, at + 4)
        v[:, dof : dof + 3] = 2 * product(conjugate(q[:, turn]), dq[:, turn])[:, 1:]
    return v


def _quaternions(joints: tuple[Joint, ...]) -> list[slice]:
    starts = {"free": 3, "ball": 0}
    return [
        slice(j.qadr + starts[j.kind], j.qadr + starts[j.kind] + 4)
        for j in joints
        if j.kind in starts
    ]
