"""From sensor signals to a motion: filter, differentiate, cut the edges."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.robot import Joint
from sysid_bench.signals.filter import Filter, FourierFilter, derivative, filter_of
from sysid_bench.spatial import composed_rotation, inverse_quaternion
from sysid_bench.types import Array, Recording

SETTINGS: Final = ("filter", "derivatives", "torque", "calibration", "contacts", "runs")
"""Keys of a suite's table `signals`; calibration, contacts and runs are applied elsewhere."""


@dataclass(frozen=True)
class Processing:
    """One filter for all signals, so that none lags another.

    `differentiate`: v and a from the filtered q, else those of the recording; `from_rates`: v of
    the drives, filtered, and a from that. With `raw_torque` the torque stays unfiltered: least
    squares averages its noise, while a filter rounds the steps of Coulomb friction, which sign(v)
    in the regressor keeps. `accuracy`: order of the differences, 2 or 4.
    """

    filter: Filter
    differentiate: bool
    raw_torque: bool = False
    from_rates: bool = False
    accuracy: int = 2

    def apply(self, recording: Recording, joints: tuple[Joint, ...]) -> Recording:
        """Return the recording with v and a, without its spoilt edges.

        Raises UsageError where it is too short, or where needed v or a are absent.
        """
        rate, edge = recording.rate, self.edge(recording)
        if len(recording) <= 2 * edge + 10:
            raise UsageError(
                f"{len(recording)} samples are too few for {self.filter}, which spoils {edge} at "
                "each end."
            )
        # Q (N, nq) filtered; quaternions stay continuous in sign and of unit length
        q = recording.q
        q = q.copy()
        # Columns of each quaternion [w, x, y, z]: of a free joint behind its position.
        starts = {"free": 3, "ball": 0}
        first = [joint.qadr + starts[joint.kind] for joint in joints if joint.kind in starts]
        rotations = [slice(start, start + 4) for start in first]
        for part in rotations:
            # q and -q are one rotation; a filter across a change of sign would pass through zero.
            flips = np.sum(q[1:, part] * q[:-1, part], axis=1) < 0
            q[1:, part] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
        q = self.filter.smooth(q, rate)
        for part in rotations:
            q[:, part] /= np.linalg.norm(q[:, part], axis=1, keepdims=True)
        v, a = self._derivatives(recording, q, joints)
        tau, wrench = recording.tau, recording.wrench
        if not self.raw_torque:
            tau = self.filter.smooth(tau, rate)
            wrench = None if wrench is None else self.filter.smooth(wrench, rate)
        keep = slice(edge, len(recording) - edge)
        return replace(
            recording, t=recording.t[keep], q=q[keep], v=v[keep], a=a[keep], tau=tau[keep],
            wrench=None if wrench is None else wrench[keep],
        )  # fmt: skip

    def edge(self, recording: Recording) -> int:
        """Return the samples to cut at each end: those spoilt by the filter, and by differences.

        Raises UsageError unless the recording holds whole periods, where the filter assumes them.
        """
        spoilt = self.filter.edge(recording.rate)
        if not isinstance(self.filter, FourierFilter):
            # Two central differences use half of their order in neighbours each.
            return spoilt + (self.accuracy if self.differentiate or self.from_rates else 0)
        # An incomplete period makes the series jump at its end, and its derivatives ring.
        samples = 0.0 if recording.period is None else recording.period * recording.rate
        if samples == 0.0 or abs(len(recording) / samples - round(len(recording) / samples)) > 1e-9:
            period = (
                "no period" if recording.period is None else f"periods of {recording.period:g} s"
            )
            raise UsageError(
                f"{self.filter} needs whole periods; {len(recording)} samples at "
                f"{recording.rate:g} Hz have {period}. Use a periodic excitation, or the filter "
                "'butter'."
            )
        return spoilt

    def _derivatives(
        self, recording: Recording, q: Array, joints: tuple[Joint, ...]
    ) -> tuple[Array, Array]:
        """Return v and a (N, nv) from the filtered q (N, nq), or from the recording."""
        rate, v, a = recording.rate, recording.v, recording.a
        if self.differentiate:
            v = _rates(q, joints, derivative(self.filter, q, rate, self.accuracy))
            return v, derivative(self.filter, v, rate, self.accuracy)
        if v is None or (a is None and not self.from_rates):
            word, needed = ("from v", "v") if self.from_rates else ("exact", "v and a")
            raise UsageError(
                f"derivatives = {word!r} needs a recording with {needed}; use 'from q'."
            )
        v = self.filter.smooth(v, rate)
        if a is None or self.from_rates:
            return v, derivative(self.filter, v, rate, self.accuracy)
        return v, self.filter.smooth(a, rate)


def processing_of(spec: Mapping[str, object]) -> Processing:
    """Return the processing of a suite's table {filter, derivatives, torque}.

    Raises UsageError for unknown keys and values.
    """
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


def _rates(q: Array, joints: tuple[Joint, ...], dq: Array) -> Array:
    """Return v (N, nv) from q and dq/dt (N, nq); for quaternions the angular velocity in the body
    frame, 2 conj(q) dq/dt."""
    # A hinge or slide has one coordinate in q and v, a ball joint 4 and 3, a free one 7 and 6.
    v = np.empty((len(q), sum(len(joint.dofs) for joint in joints)))
    for joint in joints:
        first, dof = joint.qadr, joint.vadr
        if joint.kind in ("hinge", "slide"):
            v[:, dof] = dq[:, first]
            continue
        if joint.kind == "free":
            v[:, dof : dof + 3] = dq[:, first : first + 3]
            first, dof = first + 3, dof + 3
        part = slice(first, first + 4)
        v[:, dof : dof + 3] = (
            2 * composed_rotation(inverse_quaternion(q[:, part]), dq[:, part])[:, 1:]
        )
    return v
