"""Hypotheses: a recording with a mistake undone, and how well a robot near the model explains it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_bench.diagnosis.evidence import Evidence, JointMotion, terms
from sysid_bench.diagnosis.near_model import NearModel, NearModelFit, near_model
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A recording after some changes: torques T @ mixing, mixing (n, n), along a motion."""

    evidence: Evidence
    motion: JointMotion
    mixing: Array
    given: NearModel | None = None

    @cached_property
    def model(self) -> NearModel:
        """Normal equations along the motion."""
        return self.given or self.normal()

    @cached_property
    def fit(self) -> NearModelFit:
        """Fit near the model."""
        return self.model.fit(self.mixing)

    @property
    def torque(self) -> Array:
        """Torque (N, n) after the changes."""
        return np.asarray(self.evidence.sparse[1] @ self.mixing)

    def normal(self, W: Array | None = None, more: Array | None = None) -> NearModel:
        """Normal equations with other link columns W (N, n, p), and with further columns (N, n, k)
        that a mixing may add to the torques."""
        e, n = self.evidence, self.evidence.count
        W = e.regressor(self.motion) if W is None else W
        T = np.repeat(e.sparse[1][:, None], n, axis=1)
        T = T if more is None else np.concatenate([T, more], axis=2)
        return near_model(W, terms(self.motion), T, e.file_parameters.ravel(), e.link_spreads)

    def mixed(self, mixing: Array) -> "Hypothesis":
        """The hypothesis with torques mixed once more, on the same motion."""
        return replace(self, mixing=self.mixing @ mixing, given=self.model)

    def moving(self, motion: JointMotion, mixing: Array | None = None) -> "Hypothesis":
        """The hypothesis with another motion, and torques mixed once more."""
        mixing = self.mixing if mixing is None else self.mixing @ mixing
        return replace(self, motion=motion, mixing=mixing, given=None)

    def with_columns(self, W: Array, motion: JointMotion | None = None) -> "Hypothesis":
        """The hypothesis with other link columns."""
        changed = self if motion is None else replace(self, motion=motion)
        return replace(changed, given=changed.normal(W))


def as_recorded(evidence: Evidence) -> Hypothesis:
    """The recording as it is."""
    return Hypothesis(evidence, evidence.sparse[0], np.eye(evidence.count))


@dataclass(frozen=True, eq=False, kw_only=True)
class Cure:
    """A mistake that a check suspects in some joints (indices), and the recording without it."""

    name: str
    joints: tuple[int, ...]
    hypothesis: Hypothesis
    message: str
    edit: str
    blind: str

    def explains(self, before: Hypothesis) -> float:
        """Share of the cost that the cure removes."""
        return 1.0 - self.hypothesis.fit.cost / before.fit.cost

    def removes(self, before: Hypothesis) -> float:
        """Cost that the cure removes: of the size of one per joint that nothing explains."""
        return before.fit.cost - self.hypothesis.fit.cost


CureSearch = Callable[[Hypothesis], Iterator[Cure]]
"""A check of signs, columns, gains or geometry: cures to be tried on a hypothesis."""
