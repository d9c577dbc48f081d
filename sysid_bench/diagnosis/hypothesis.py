"""Hypotheses: recordings with a mistake undone, and how well a robot near the model fits them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, JointMotion
from sysid_bench.diagnosis.finding import ERROR
from sysid_bench.diagnosis.near_model import NearModel, NearModelFit
from sysid_bench.types import Array

CHANGED: Final = 0.1
"""Relative change of a joint's squared residual from which a candidate concerns it."""


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

    def with_motion(self, motion: JointMotion, mixing: Array | None = None) -> "Hypothesis":
        """The hypothesis with another motion, and torques mixed once more."""
        mixing = self.mixing if mixing is None else self.mixing @ mixing
        return replace(self, motion=motion, mixing=mixing, given=None)

    def with_columns(self, W: Array, motion: JointMotion | None = None) -> "Hypothesis":
        """The hypothesis with other link columns."""
        changed = self if motion is None else replace(self, motion=motion)
        return replace(changed, given=self.evidence.normal(changed.motion, W))


def first_hypothesis(evidence: DiagnoseInput) -> Hypothesis:
    """The recording as it is."""
    return Hypothesis(
        evidence, evidence.fit_samples[0], np.eye(evidence.count), evidence.near_model
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidate:
    """Possible mistake in some joints (indices), and the recording without it; `most`: its gravest
    severity."""

    name: str
    joints: tuple[int, ...]
    hypothesis: Hypothesis
    message: str
    edit: str
    blind: str
    most: str = ERROR

    def share(self, before: Hypothesis) -> float:
        """Share of the cost that the candidate removes."""
        return 1.0 - self.hypothesis.fit.cost / before.fit.cost

    def share_on_joints(self, before: Hypothesis) -> float:
        """Share of the squared residuals that the candidate removes on the joints where it changes
        them: others, which nothing explains, may have most of the cost."""
        old, new = before.fit.residual**2, self.hypothesis.fit.residual**2
        changed = np.abs(old - new) > CHANGED * old
        total = float(old[changed].sum())
        return 1.0 - float(new[changed].sum()) / total if total > 0 else 0.0

    def difference(self, before: Hypothesis) -> float:
        """Cost that the candidate removes: of the size of one per joint that nothing explains."""
        return before.fit.cost - self.hypothesis.fit.cost


CandidateSearch = Callable[[Hypothesis], Iterator[Candidate]]
"""A check of signs, columns, gains or geometry: candidates to be tried on a hypothesis."""
