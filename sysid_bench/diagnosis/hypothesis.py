"""Hypotheses: recordings with a mistake undone, how well a robot near the model fits them, and the
edits of a log's description that undo the mistake."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, JointMotion
from sysid_bench.diagnosis.finding import ERROR, Alternative
from sysid_bench.diagnosis.near_model import NearModel, NearModelFit
from sysid_bench.errors import first_names
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.types import Array

NORMAL: Final = 1.96
"""97.5 % quantile of the normal distribution, of a decision."""

SHARP: Final = float(np.log(2.0))
"""Half of the widest interval of a gain, in the logarithm, that a cure holds as a number."""

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

    @cached_property
    def variances(self) -> Array:
        """Variances (p,) of the link parameters over those that the model file leaves them."""
        return self.model.variances(self.mixing)

    @property
    def strain(self) -> float:
        """Distance of the links from the model file over that of right spreads, at least 1: numbers
        relative to a file that is further off are as much less certain (Birge ratio)."""
        away = (self.fit.links - self.model.known) / self.model.scale
        known = max(float((1.0 - self.variances).sum()), 1e-9)
        return max(1.0, float(np.sqrt((away**2).sum() / known)))

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

    def with_columns(self, W: Array, motion: JointMotion) -> "Hypothesis":
        """The hypothesis with another motion and its link columns."""
        return replace(self, motion=motion, given=self.evidence.normal(motion, W))

    def with_gravity(self, W: Array) -> "Hypothesis":
        """The hypothesis with the link columns of another gravity."""
        return replace(self, given=self.evidence.normal(self.motion, W, is_own=False))


def curvature_half(low: float, middle: float, high: float, step: float) -> float:
    """Half of the 95 % interval of a number with the scores at it and a step to either side."""
    return NORMAL * step * float(np.sqrt(2.0 / max(low + high - 2.0 * middle, 1e-9)))


def first_hypothesis(evidence: DiagnoseInput) -> Hypothesis:
    """The recording as it is."""
    return Hypothesis(
        evidence, evidence.fit_samples[0], np.eye(evidence.count), evidence.near_model
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """Possible mistake in some joints (indices), and the recording without it; `most`: its gravest
    severity. `estimate`: its number with its unit, `interval` (95 %) of that number, or the number
    itself, a step of it, and the hypotheses `along` it. `unknowns`: numbers that it fits,
    `choices`: candidates of its kind that were tried."""

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
    along: tuple[float, float, Callable[[float], Hypothesis]] | None = None
    doubt: str = ""  # the edit where the candidate is only a doubt
    ahead: float = 0.0  # evidence of a load, or of a mistake behind one, that shows after it alone
    is_gross: bool = False  # all torques wrong by more than any model file, whatever the cost

    def share(self, before: Hypothesis) -> float:
        """Share of the cost that the candidate removes."""
        return 1.0 - self.hypothesis.fit.cost / before.fit.cost

    def removed(self, before: Hypothesis) -> float:
        """Cost that the candidate removes from joints and from the penalty: a joint that nothing
        explains, and that decides nothing, may cost more instead."""
        old, new = before.fit, self.hypothesis.fit
        fall = np.append(old.residual**2 - new.residual**2, old.penalty - new.penalty)
        return float(np.maximum(fall, 0.0).sum())

    def gain(self, before: Hypothesis) -> float:
        """Twice the logarithm of the odds that the candidate gains, less 1 for each number that it
        fits: what a number without meaning gains on average."""
        unknowns = UNKNOWNS.get(self.name, 0.0) if self.unknowns is None else self.unknowns
        return before.fit.score - self.hypothesis.fit.score - unknowns + self.ahead

    def evidence(self, before: Hypothesis) -> float:
        """The gain less twice the logarithm of the number of candidates of its kind, of which one
        gains something by chance."""
        return self.gain(before) - 2.0 * float(np.log(self.choices))

    def number_interval(self) -> tuple[float, float] | None:
        """Interval of the number, from the scores beside it where it is not known."""
        if self.interval is not None or self.along is None:
            return self.interval
        number, step, at = self.along
        beside = [at(number + one).fit.score for one in (-step, step)]
        half = curvature_half(beside[0], self.hypothesis.fit.score, beside[1], step)
        # A number that is not at the minimum of the score, or that nothing decides, has none.
        is_closed = min(beside) > self.hypothesis.fit.score and half < abs(number)
        return (number - half, number + half) if is_closed else None

    def alternative(self, before: Hypothesis) -> Alternative:
        """Row of the table of explanations."""
        return Alternative(
            name=self.name,
            joints=tuple(before.evidence.joints[j] for j in self.joints),
            estimate=self.estimate,
            interval=self.number_interval(),
            explains=round(self.share(before), 3),
            evidence=round(self.evidence(before), 1),
            message=self.message,
            edit=self.edit,
        )


def joint_factors(n: int, joints: Collection[int], factor: float) -> Array:
    """Return factors (n,): one for some of the joints, 1 for the others."""
    factors = np.ones(n)
    factors[list(joints)] = factor
    return factors


def gain_edits(evidence: DiagnoseInput, factors: Array, half: float) -> tuple[str, str]:
    """Return the edit of the gains, times factors (n,) of which the logarithm is known to `half`,
    and the one without numbers, where these are not sure enough to be written down."""
    wrong = factors != 1.0
    size = float(np.exp(np.median(np.log(factors[wrong]))))
    names = first_names(evidence.names(wrong))
    doubt = (
        f"tau = {{ gain = ... }} of {names}: times the gear ratio, drive constant or unit that is "
        f"missing, between {size * np.exp(-half):.2g} and {size * np.exp(half):.2g}"
    )
    return (setting_edit(evidence, "tau", "gain", factors) if half <= SHARP else doubt), doubt


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
