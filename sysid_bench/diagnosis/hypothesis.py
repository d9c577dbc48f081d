"""Hypotheses: recordings with a mistake undone, how well a robot near the model fits them, and the
edits of a log's description that undo the mistake."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, JointMotion
from sysid_bench.diagnosis.finding import ERROR, Alternative
from sysid_bench.diagnosis.near_model import NearModel, NearModelFit
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.types import Array

NORMAL: Final = 1.96
"""97.5 % quantile of the normal distribution, of a decision."""

UNKNOWNS: Final = {"gain": 1.0, "offset": 1.0, "gravity": 2.0, "rate": 1.0}
"""Numbers that candidates fit beside the bodies and the friction that all of them fit."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A recording after some changes: torques T @ mixing, mixing (n, n), along a motion."""

    evidence: DiagnoseInput
    motion: JointMotion
    mixing: Array
    given: NearModel | None = None

    @cached_property
    def model(self) -> NearModel:
        """Normal equations along the motion."""
        return self.given or self.evidence.normal(self.motion)

    @cached_property
    def fit(self) -> NearModelFit:
        """Fit near the model."""
        return self.model.fit(self.mixing)

    @property
    def torque(self) -> Array:
        """Torque (N, n) after the changes."""
        return np.asarray(self.evidence.fit_samples[1] @ self.mixing)

    def with_torque(self, mixing: Array) -> "Hypothesis":
        """The hypothesis with torques mixed once more, on the same motion."""
        return replace(self, mixing=self.mixing @ mixing, given=self.model)

    def with_motion(self, motion: JointMotion) -> "Hypothesis":
        """The hypothesis with another motion."""
        return replace(self, motion=motion, given=None)

    def with_columns(self, W: Array, motion: JointMotion | None = None) -> "Hypothesis":
        """The hypothesis with other link columns, and with another motion."""
        motion = motion or self.motion
        return replace(self, motion=motion, given=self.evidence.normal(motion, W))


def first_hypothesis(evidence: DiagnoseInput) -> Hypothesis:
    """The recording as it is."""
    return Hypothesis(
        evidence, evidence.fit_samples[0], np.eye(evidence.count), evidence.near_model
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """Possible mistake in some joints (indices), and the recording without it; `most`: its gravest
    severity. `estimate`: its number with its unit, `interval` (95 %) of that number. `unknowns`:
    numbers that it fits, `choices`: candidates of its kind that were tried."""

    name: str
    joints: tuple[int, ...]
    hypothesis: Hypothesis
    message: str
    edit: str
    blind: str
    most: str = ERROR
    estimate: str = ""
    interval: tuple[float, float] | None = None
    unknowns: float | None = None
    choices: int = 1
    is_gross: bool = False  # all torques wrong by more than any model file, whatever the cost

    def share(self, before: Hypothesis) -> float:
        """Share of the cost that the candidate removes."""
        return 1.0 - self.hypothesis.fit.cost / before.fit.cost

    def gain(self, before: Hypothesis) -> float:
        """Twice the logarithm of the odds that the candidate gains, less 1 for each number that it
        fits: what a number without meaning gains on average."""
        unknowns = UNKNOWNS.get(self.name, 0.0) if self.unknowns is None else self.unknowns
        return before.fit.score - self.hypothesis.fit.score - unknowns

    def evidence(self, before: Hypothesis) -> float:
        """The gain less twice the logarithm of the number of candidates of its kind, of which one
        gains something by chance."""
        return self.gain(before) - 2.0 * float(np.log(self.choices))

    def alternative(self, before: Hypothesis) -> Alternative:
        """Row of the table of explanations."""
        return Alternative(
            name=self.name,
            joints=tuple(before.evidence.joints[j] for j in self.joints),
            estimate=self.estimate,
            interval=self.interval,
            explains=round(self.share(before), 3),
            evidence=round(self.evidence(before), 1),
            message=self.message,
            edit=self.edit,
        )


def joint_factors(n: int, joints: Sequence[int], factor: float) -> Array:
    """Return factors (n,): one for some of the joints, 1 for the others."""
    factors = np.ones(n)
    factors[list(joints)] = factor
    return factors


def setting_edit(
    evidence: DiagnoseInput,
    signal: str,
    setting: str,
    factors: Array | float = 1.0,
    summands: Array | float = 0.0,
) -> str:
    """Return the edit of a setting of a signal: times factors (n,) of the joints, or plus summands
    (n,) for an offset."""
    log = evidence.log.description
    if signal == "tau" and log.tau.pd is not None:
        change, numbers = "multiply kp and kd by", factors
        if setting == "offset":
            change, numbers = "add to the torque", summands
        listed = ", ".join(f"{x:.4g}" for x in np.broadcast_to(numbers, evidence.count))
        return f"tau = {{ pd = ... }}: {change} [{listed}]"
    values = log.joint_values(f"{signal}.{setting}", getattr(log.signals[signal], setting))
    places = [log.joints.index(joint) for joint in evidence.joints]
    values[places] = values[places] * factors + summands
    listed = ", ".join(f"{value:.4g}" for value in values)
    where = ", in the coordinates of the motors" if log.transmission is not None else ""
    return f"{signal} = {{ {setting} = [{listed}] }}{where}"


def columns_edit(evidence: DiagnoseInput, signals: Sequence[str], order: Sequence[int]) -> str:
    """Return the edit that gives joint j the columns of joint order[j]."""
    log = evidence.log.description
    parts = {name: log.signals[name].columns for name in signals if name in log.signals}
    # Of columns that a pattern or an array names, the order of the joints is all that can be said.
    if any(len(columns) != len(log.joints) for columns in parts.values()):
        names = ", ".join(evidence.joints[i] for i in order)
        return f"write the columns of {' and '.join(signals)} in the order of {names}"
    places = [log.joints.index(joint) for joint in evidence.joints]
    edits = []
    for name, given in parts.items():
        columns = list(given)
        for j, i in enumerate(order):
            columns[places[j]] = given[places[i]]
        edits.append(f"{name} = {{ columns = {columns} }}")
    return "; ".join(edits)


def joints_edit(evidence: DiagnoseInput, order: Sequence[int]) -> str:
    """Return the edit of `joints` that gives joint j the columns of joint order[j]."""
    names = list(evidence.log.description.joints)
    places = [k for k, name in enumerate(names) if name != NO_JOINT]
    for j, i in enumerate(order):
        names[places[i]] = evidence.joints[j]
    return f"joints = {names}".replace("'", '"')
