"""A motion designed for its question: the best of a family of curves within all limits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError, unknown_name
from sysid_bench.excitation.criteria import Criterion, criterion_weights
from sysid_bench.excitation.curves import FAMILIES, curves_of
from sysid_bench.excitation.design_problem import MARGIN, DesignProblem, is_count
from sysid_bench.excitation.information import InformationModel
from sysid_bench.excitation.limit_use import (
    Limit,
    LimitUse,
    joint_limits,
    largest_use,
    torque_limits,
)
from sysid_bench.excitation.search import DesignSpace, Search, Tell
from sysid_bench.identifiability.base_map import base_map
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.types import Array, Trajectory

DRAWS: Final = 20
"""Random feasible motions: where a search starts, and what its result is compared with."""

SPARE: Final = 0.004
"""m that a search adds to the clearance: it looks at fewer samples than the check after it."""

CHECKS: Final = 16
"""Feasible motions of a search that are looked at on the finer grid, the best first."""

DENSER: Final = 10
"""The limits are checked on a grid so many times finer than that of the search."""


@dataclass(frozen=True, eq=False)
class Design:
    """Coefficients C (m, k) of the degrees of freedom `dofs`, and how they were found. Values are
    those of the criterion, which is made small; `start` is the median random motion's."""

    C: Array
    value: float
    start: float
    evaluations: int = 0
    interrupted: bool = False


@dataclass(frozen=True)
class Optimised:
    """Curves of one family that make an objective small: `cond`, `cond-unit`, `D`, `A`, `E`,
    `predict`, or a table of weights. `joints` move (none named: all hinges and slides), the rest is
    held at the reference configuration."""

    objective: str | Mapping[str, float] = "D"
    family: str = "fourier"
    harmonics: int = 5
    period: float = field(default=10.0, metadata={"unit": "s"})
    cycles: int = 1
    joints: Sequence[str] = ()
    iterations: int = 150
    starts: int = 1
    torque_share: float = field(default=0.9, metadata={"unit": "1"})
    clearance: float | None = field(default=None, metadata={"unit": "m"})
    floor: float | None = field(default=None, metadata={"unit": "m"})
    boxes: Mapping[str, Sequence[Sequence[float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises UsageError for settings that make no motion."""
        criterion_weights(self.objective)
        if self.family not in FAMILIES:
            raise unknown_name("family of curves", self.family, FAMILIES)
        for name in ("harmonics", "cycles", "iterations", "starts"):
            if not is_count(getattr(self, name)):
                raise UsageError(f"{name} counts from 1; got {getattr(self, name)!r}.")
        if not self.period > 0:
            raise UsageError(f"The period is positive; got {self.period:g} s.")
        if not 0 < self.torque_share <= 1:
            raise UsageError(
                "The share of the torque limits lies above 0 % and up to 100 %; got "
                f"{100 * self.torque_share:g} %."
            )

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """The motion of `solve`, `cycles` times."""
        return self.motion(self.solve(brief, rng).C, brief)

    def motion(self, C: Array, brief: DesignProblem) -> Trajectory:
        """The motion of coefficients C, sampled at the brief's rate. A family that rests at its
        ends is played once more for each cycle."""
        space = self.space(brief)
        t = brief.times(self.cycles * self.period)
        own = space.motion(C, t % self.period if not space.curves.periodic else t)
        return replace(own, t=t, name="optimised", period=self.period)

    def space(self, brief: DesignProblem) -> DesignSpace:
        """The motions to choose from; raises UsageError for a joint that is not there, or that
        follows others."""
        place = {int(dof): k for k, dof in enumerate(brief.dofs)}
        joints = {j.name: j for j in brief.joints if j.kind in ("hinge", "slide")}
        scalar = {name: place[j.vadr] for name, j in joints.items() if j.vadr in place}
        for name in self.joints:
            if name in joints and name not in scalar and brief.coupling is not None:
                drivers = brief.coupling.independent_of(joints[name].vadr)
                told = ", ".join(brief.coupling.names[dof] for dof in drivers) or "constraints"
                raise UsageError(f"The joint {name!r} follows {told}; name that in its place.")
            if name not in scalar:
                raise unknown_name("hinge or slide", name, scalar)
        if not scalar:
            raise UnsupportedError("This robot has no hinge and no slide that a design could move.")
        dofs = [scalar[name] for name in self.joints] or list(scalar.values())
        return DesignSpace(
            brief, curves_of(self.family, self.period, self.harmonics), np.array(dofs)
        )

    @staticmethod
    def draws(space: DesignSpace, rng: np.random.Generator) -> list[Array]:
        """The random motions that a search starts from and is compared with."""
        return [space.random(rng, 0.99 * MARGIN) for _ in range(DRAWS)]

    def limits(self, brief: DesignProblem, share: float = 1.0) -> tuple[Limit, ...]:
        """Everything that the motion has to keep; `share` of positions, rates and torques."""
        space = self.space(brief)
        limits = [
            *joint_limits(brief, space.dofs, share),
            *torque_limits(brief, share * self.torque_share),
        ]
        if self.clearance is None and self.floor is None and not self.boxes:
            return tuple(limits)
        from sysid_bench.excitation.geometry import box_limit, collision_limit

        if brief.scene is None:
            raise UsageError("Nothing is known of this robot's shapes and places.")
        scene = brief.scene(self.floor)
        if (self.clearance is not None and scene.shapes) or self.floor is not None:
            spare = SPARE if share < 1.0 else 0.0
            limits.append(collision_limit(scene, (self.clearance or 0.0) + spare))
        if self.boxes:
            limits.append(box_limit(scene, self.boxes))
        return tuple(limits)

    def solve(
        self,
        brief: DesignProblem,
        rng: np.random.Generator,
        known: Sequence[Trajectory] = (),
        tell: Tell = lambda count, value: None,
    ) -> Design:
        """The best coefficients; `known`: motions that have been recorded before.

        Raises UsageError where the brief holds no regressor, and UnsupportedError where no motion
        within the limits was found.
        """
        if brief.regress is None:
            raise UsageError(
                "An optimised motion needs to know what it is for: the brief holds no regressor."
            )
        space = self.space(brief)
        draws = self.draws(space, rng)
        asked = torque_prior(space, brief.regress, draws)
        criterion = design_criterion(self.objective, asked, space, draws, known)
        search = Search(space, asked.smooth, criterion, self.limits(brief, MARGIN), tell)
        values = np.array([search.objective(C) for C in draws])
        over = np.array([search.largest_use(C) for C in draws])
        order = np.lexsort((values, np.maximum(over, 1.0)))
        best = search.start([draws[i] for i in order[: self.starts]], self.iterations)
        # Where a short search does not come back inside, a long one only takes longer.
        if search.kept and not search.interrupted:
            search.resume(best, self.iterations)
        if not search.interrupted and not (search.kept and search.kept[-1][0] <= values.min()):
            # From outside of all limits no way led in, or to nothing good: begin small, inside.
            search.short_steps(
                _scaled_to_limits(search, space, draws[order[0]], rng), self.iterations
            )
        C, value = self._checked(brief, space, search)
        median = float(np.median(values))
        return Design(C, value, median, search.evaluations, search.interrupted)

    def report(self, C: Array, brief: DesignProblem) -> dict[str, LimitUse]:
        """The worst moment of each kind of limit, on the finer grid; true limits, none shared."""
        motion = self._fine(C, self.space(brief))
        strict = replace(self, torque_share=1.0).limits(brief)
        return {limit.kind: largest_use(limit, motion) for limit in strict}

    def _fine(self, C: Array, space: DesignSpace) -> Trajectory:
        return space.motion(C, space.curves.grid(DENSER))

    def _checked(
        self, brief: DesignProblem, space: DesignSpace, search: Search
    ) -> tuple[Array, float]:
        """The best of the kept motions that keeps the limits on the finer grid as well."""
        limits = self.limits(brief)
        nearest = search.nearest
        # The last ones one by one, those before in growing strides: they are like each other.
        places = len(search.kept) - np.unique(
            np.geomspace(1, len(search.kept) or 1, CHECKS, dtype=int)
        )
        for place in places[places >= 0]:  # -1: nothing was kept
            value, C = search.kept[place]
            motion = self._fine(C, space)
            uses = [float(np.abs(limit.use(motion)).max()) for limit in limits]
            if max(uses) <= 1.0:
                return C, value
            finer = max(uses), limits[int(np.argmax(uses))].kind
            nearest = finer if nearest[0] <= 1.0 else min(nearest, finer)
        raise UnsupportedError(
            f"No motion within all limits was found in {search.evaluations} evaluations; the "
            f"nearest one breaks this limit: {nearest[1]} ({nearest[0]:.3f} of it). "
            "Give another seed, more iterations, a longer period, or wider limits."
        )


def _scaled_to_limits(
    search: Search, space: DesignSpace, C: Array, rng: np.random.Generator
) -> Array:
    """A random motion made smaller, about its own place and then about others, until it keeps
    torques, clearances and boxes too; the least violating where none does."""
    best, least = C, search.largest_use(C)
    low, high = (edge[space.dofs] for edge in (space.brief.low, space.brief.high))
    # The reference posture is the one that whoever drew the model has looked at.
    room = 0.1 * (high - low)
    reference = np.clip(space.brief.q0[space.places], low + room, high - room)
    for size in (0.6, 0.35, 0.2, 0.1, 0.05):
        if least <= 1.0:
            break
        small = size * C
        for place in (
            C[0],
            reference,
            *rng.uniform(0.8 * low + 0.2 * high, 0.2 * low + 0.8 * high, (6, len(low))),
        ):
            small[0] = place
            over = search.largest_use(small)
            if over < least:
                best, least = small.copy(), over
    return best


def torque_prior(
    space: DesignSpace, question: InformationModel, draws: Sequence[Array]
) -> InformationModel:
    """The part of a question that these motions can answer at all: held joints, a held base and
    short reaches leave fewer base parameters, again taken from left to right."""
    t = space.curves.grid()
    R = upper_factor(_stacked(question, space.motion(C, t)) for C in draws[: 1 + len(draws) // 4])
    base = base_map(R, question.names)
    if base.rank == 0:
        raise UnsupportedError("These motions tell nothing of what is asked.")
    return question.subset_of_rows(base.names)


def design_criterion(
    objective: str | Mapping[str, float],
    question: InformationModel,
    space: DesignSpace,
    draws: Sequence[Array],
    known: Sequence[Trajectory] = (),
) -> Criterion:
    """The criterion of an objective; `predict` is about the torques of the random motions `draws`,
    each row in units of its own largest column so that strong joints do not drown the weak."""
    weights, r = criterion_weights(objective), len(question.names)
    rows = [_stacked(question, motion) for motion in known]
    before = upper_factor([*rows, np.zeros((1, r))]) if rows else np.zeros((0, r))
    whiten = np.eye(r)
    if "predict" in weights:
        t = space.curves.grid()
        R = upper_factor(_stacked(question, space.motion(C, t)) for C in draws)
        whiten = np.linalg.inv(R / np.sqrt(len(draws)))
    return Criterion(weights, before, whiten)


def _stacked(question: InformationModel, motion: Trajectory) -> Array:
    Y = question.rows(motion)
    return Y.reshape(-1, Y.shape[2])


def design_figures(question: InformationModel, motion: Trajectory) -> dict[str, Any]:
    """What a motion tells, with the true sign of Coulomb friction: rank, condition, log det."""
    R = upper_factor([_stacked(question, motion)])
    s = np.linalg.svd(R, compute_uv=False)
    unit = np.linalg.svd(R / np.linalg.norm(R, axis=0), compute_uv=False)
    return {
        "rank": len(s),
        "condition": float(s[0] / s[-1]),
        "condition_unit": float(unit[0] / unit[-1]),
        "log_det": float(2 * np.log(s).sum()),
        "smallest_singular_value": float(s[-1]),
    }
