"""Optimised excitation: the curves of one family that make a criterion small within all limits."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError, unknown_name
from sysid_bench.excitation.design_cost import (
    NONE,
    DesignCost,
    LimitSensitivity,
    Progress,
    limit_sensitivity,
)
from sysid_bench.excitation.design_problem import MARGIN, DesignProblem, is_count
from sysid_bench.excitation.design_space import FAMILIES, DesignSpace, curves_of
from sysid_bench.excitation.information import Criterion, InformationModel, criterion_weights
from sysid_bench.excitation.limits import (
    Limit,
    LimitUse,
    collision_limit,
    joint_limits,
    largest_use,
    origin_limit,
    torque_limits,
)
from sysid_bench.excitation.search import Continuation, Search, has_continuation, run_continuation
from sysid_bench.identifiability.base_map import base_map
from sysid_bench.numerics import qr_factor
from sysid_bench.types import Array, Trajectory

_DRAWS: Final = 20
"""Random feasible motions: starts of a search, and reference for its result."""

_SPARE: Final = 0.004
"""m added to the clearance in a search, which sees fewer samples than the check after it."""

_CHECKS: Final = 16
"""Feasible motions of a search that are checked on the finer grid, the best first."""

_MOST_HARMONICS: Final = 100
"""A search holds about 4000 h^2 numbers for h harmonics."""

_DENSER: Final = 10
"""Ratio of samples in the final check of limits to those of the search."""


@dataclass(frozen=True, eq=False)
class Design:
    """Coefficients C (m, k), the minimised criterion, and the effort of the search.

    `start`: criterion of the median random motion; `without`: least criterion found without boxes
    (None: there are none); `prices`: as in `limit_sensitivity`.
    """

    C: Array
    value: float
    start: float
    evaluations: int = 0
    interrupted: bool = False
    without: float | None = None
    prices: LimitSensitivity = NONE


@dataclass(frozen=True)
class Optimised:
    """Curves of one family that minimise an objective: a criterion (`cond`, `cond-unit`, `D`, `A`,
    `E`, `predict`), or a table of their weights (Gautier & Khalil 1992; Swevers et al. 1997).

    `joints` move (none named: all hinges and slides), the others stay at the reference
    configuration. `clearance` and `floor` are in m, `boxes` as in `origin_limit`; `margin` is the
    share of every limit that the search leaves, for what happens between its samples.
    """

    objective: str | Mapping[str, float] = "D"
    family: str = "fourier"
    harmonics: int = 5
    period: float = field(default=10.0, metadata={"unit": "s"})
    cycles: int = 1
    joints: Sequence[str] = ()
    iterations: int = 150
    starts: int = 2
    torque_share: float = field(default=0.9, metadata={"unit": "1"})
    margin: float = field(default=1 - MARGIN, metadata={"unit": "1"})
    clearance: float | None = field(default=None, metadata={"unit": "m"})
    floor: float | None = field(default=None, metadata={"unit": "m"})
    boxes: Mapping[str, Sequence[Sequence[float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        criterion_weights(self.objective)
        if self.family not in FAMILIES:
            raise unknown_name("family of curves", self.family, FAMILIES)
        for name in ("harmonics", "cycles", "iterations", "starts"):
            value = getattr(self, name)
            if not is_count(value):
                raise UsageError(f"{name} must be an integer of at least 1; got {value!r}.")
        if self.harmonics > _MOST_HARMONICS:
            raise UsageError(
                f"harmonics must be at most {_MOST_HARMONICS}; got {self.harmonics}. A search with "
                "so many coefficients would need gigabytes; use a shorter period."
            )
        if not self.period > 0:
            raise UsageError(f"The period must be positive; got {self.period:g} s.")
        if not 0 < self.torque_share <= 1:
            raise UsageError(
                "The share of the torque limits must lie above 0 % and up to 100 %; got "
                f"{100 * self.torque_share:g} %."
            )
        if not 0 <= self.margin < 0.5:
            raise UsageError(
                f"The margin of the limits must lie from 0 % to 50 %; got {100 * self.margin:g} %."
            )

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return the motion of `solve`, `cycles` times."""
        return self.motion(self.solve(brief, rng).C, brief)

    def motion(self, C: Array, brief: DesignProblem) -> Trajectory:
        """Return the motion of coefficients C (m, k), sampled at the rate of the problem."""
        space = self.space(brief)
        t = brief.times(self.cycles * self.period)
        # Families at rest at both ends are not periodic functions: each cycle starts them anew.
        motion = space.motion(C, t % self.period if not space.curves.periodic else t)
        return replace(motion, t=t, name="optimised", period=self.period)

    def space(self, brief: DesignProblem) -> DesignSpace:
        """Return the motions to choose from.

        Raises UsageError for an unknown or dependent joint, UnsupportedError where none can move.
        """
        # The independent hinges and slides: others have no profile, or several.
        profile = {int(dof): k for k, dof in enumerate(brief.dofs)}
        scalar = [joint for joint in brief.joints if joint.kind in ("hinge", "slide")]
        profiles = {joint.name: profile[joint.vadr] for joint in scalar if joint.vadr in profile}
        for name in self.joints:
            if name not in profiles:
                raise _joint_error(brief, name, profiles)
        if not profiles:
            raise UnsupportedError("This robot has no hinge and no slide that a design could move.")
        dofs = [profiles[name] for name in self.joints] or list(profiles.values())
        return DesignSpace(
            brief, curves_of(self.family, self.period, self.harmonics), np.array(dofs)
        )

    @staticmethod
    def random_coefficients(space: DesignSpace, rng: np.random.Generator) -> list[Array]:
        """Return coefficients of random motions, the starts and the reference of a search."""
        return [space.random(rng, 0.99 * MARGIN) for _ in range(_DRAWS)]

    def limits(self, brief: DesignProblem, share: float = 1.0) -> tuple[Limit, ...]:
        """Return all limits of the motion, `share` of positions, rates and torques.

        Raises UsageError for clearance, floor or boxes without a collision model.
        """
        space = self.space(brief)
        limits = [
            *joint_limits(brief, space.dofs, share),
            *torque_limits(brief, share * self.torque_share),
        ]
        return (*limits, *self._scene_limits(brief, _SPARE if share < 1.0 else 0.0))

    def _scene_limits(self, brief: DesignProblem, spare: float) -> Iterator[Limit]:
        """Yield limits of clearance and boxes; `spare` (m) is added to the clearance."""
        if self.clearance is None and self.floor is None and not self.boxes:
            return
        if brief.scene is None:
            raise UsageError("Clearance, floor and boxes need a collision model of the robot.")
        scene = brief.scene(self.floor)
        # Links need shapes to keep clear of each other; a floor is watched in any case.
        if (self.clearance is not None and scene.shapes) or self.floor is not None:
            yield collision_limit(scene, (self.clearance or 0.0) + spare)
        if self.boxes:
            yield origin_limit(scene, self.boxes)

    def solve(
        self,
        brief: DesignProblem,
        rng: np.random.Generator,
        known: Sequence[Trajectory] = (),
        progress: Progress = lambda count, value: None,
    ) -> Design:
        """Return the best coefficients, given motions `known` from earlier recordings.

        Raises UsageError without a regressor, UnsupportedError where no motion keeps all limits.
        """
        if brief.regress is None:
            raise UsageError("An optimised motion needs a regressor to judge it by; none is given.")
        brief.times(self.cycles * self.period)  # a motion too long is refused before its search
        space = self.space(brief)
        draws = self.random_coefficients(space, rng)
        information = excitation_parameters(space, brief.regress, draws)
        criterion = design_criterion(self.objective, information, space, draws, known)
        limits = self.limits(brief, 1 - self.margin)
        evaluation = DesignCost(space, information.smooth, criterion, limits, progress)
        values = np.array([evaluation.criterion_value(C) for C in draws])
        over = np.array([evaluation.largest_use(C) for C in draws])
        order = np.lexsort((values, np.maximum(over, 1.0)))
        search, ranked = Search(evaluation), [draws[i] for i in np.argsort(values)]
        # A search in a box stalls near its start: the way from wide limits to it comes first.
        wide = self._continued(evaluation, ranked) if has_continuation(limits) else None
        if not evaluation.kept and not (wide is not None and wide.interrupted):
            self._direct_search(search, [draws[i] for i in order], values, rng)
        interrupted = search.interrupted or (wide is not None and wide.interrupted)
        inside = [] if interrupted else self._inside(brief, evaluation)
        C, value = self._checked(brief, evaluation, inside)
        return Design(
            C=C,
            value=value,
            start=float(np.median(values)),
            evaluations=evaluation.evaluations,
            interrupted=interrupted,
            without=None if wide is None else min(wide.without, value),
            prices=limit_sensitivity(evaluation, C),
        )

    def _continued(self, evaluation: DesignCost, draws: Sequence[Array]) -> Continuation:
        """Continuations in the limits from the first draws; the least criterion without them."""
        found = Continuation(np.inf, False)
        for C in draws[: self.starts]:
            more = run_continuation(evaluation, C, self.iterations)
            found = Continuation(min(found.without, more.without), more.interrupted)
            if more.interrupted:
                break
        return found

    def _direct_search(
        self, search: Search, draws: Sequence[Array], values: Array, rng: np.random.Generator
    ) -> None:
        """Search within all limits from the start; in small steps where that finds nothing."""
        evaluation = search.evaluation
        # More starts never make a motion worse: the long search from the first one is kept.
        for C in search.start(draws[: self.starts], self.iterations):
            # Where a short search stays infeasible, a long one only takes longer.
            if evaluation.kept and not search.interrupted:
                search.run_from(C, self.iterations)
        improved = evaluation.kept and evaluation.best <= values.min()
        if not (search.interrupted or improved):
            # No feasible motion, or none better than random: start small, within the limits.
            small = _scaled_to_limits(evaluation, draws[0], rng)
            search.bounded_search(small, self.iterations)

    def report(self, C: Array, brief: DesignProblem) -> dict[str, LimitUse]:
        """Return the largest use of each kind of limit, on the finer grid, of the whole limits."""
        motion = self._fine(C, self.space(brief))
        strict = replace(self, torque_share=1.0).limits(brief)
        return {limit.kind: largest_use(limit, motion) for limit in strict}

    def _inside(self, brief: DesignProblem, evaluation: DesignCost) -> list[tuple[float, Array]]:
        """The best motion, pulled inside the whole limits on the finer grid: many limits bind, and
        some of them between the points of the search."""
        if not evaluation.kept:
            return []
        finer = replace(evaluation, limits=self.limits(brief), density=_DENSER, kept=[])
        C = Search(finer).nearest_feasible(evaluation.kept[-1][1])
        return [(evaluation.criterion_value(C), C)]

    def _fine(self, C: Array, space: DesignSpace) -> Trajectory:
        return space.motion(C, space.curves.grid(_DENSER))

    def _checked(
        self, brief: DesignProblem, evaluation: DesignCost, more: Sequence[tuple[float, Array]] = ()
    ) -> tuple[Array, float]:
        """Return the best motion within the limits on the finer grid, of those kept and of `more`,
        and its value."""
        limits = self.limits(brief)
        nearest = evaluation.nearest
        # Up to _CHECKS of the kept motions. Neighbours in the list are alike: the last and best
        # ones singly, earlier ones in growing strides.
        count = len(evaluation.kept)
        indices = count - np.unique(np.geomspace(1, count or 1, _CHECKS, dtype=int))
        some = [evaluation.kept[index] for index in indices[indices >= 0]]  # -1: nothing was kept
        candidates = sorted([*some, *more], key=lambda kept: kept[0])
        for value, C in candidates:
            motion = self._fine(C, evaluation.space)
            uses = [float(np.abs(limit.use(motion)).max()) for limit in limits]
            if max(uses) <= 1.0:
                return C, value
            finer = max(uses), limits[int(np.argmax(uses))].kind
            nearest = finer if nearest[0] <= 1.0 else min(nearest, finer)
        raise UnsupportedError(
            f"No motion within all limits was found in {evaluation.evaluations} evaluations; the "
            f"nearest one breaks this limit: {nearest[1]} ({nearest[0]:.3f} of it). "
            "Give another seed, more iterations, a longer period, or wider limits."
        )


def _joint_error(brief: DesignProblem, name: str, profiles: Mapping[str, int]) -> UsageError:
    """Return the error of a joint that cannot be designed: it depends on others, or is unknown."""
    vadr = {j.name: j.vadr for j in brief.joints if j.kind in ("hinge", "slide")}
    if name not in vadr or brief.coupling is None:
        return unknown_name("hinge or slide", name, profiles)
    drivers = brief.coupling.independent_of(vadr[name])
    followed = ", ".join(brief.coupling.names[dof] for dof in drivers) or "constraints"
    return UsageError(f"The joint {name!r} follows {followed}; name that instead.")


def _scaled_to_limits(evaluation: DesignCost, C: Array, rng: np.random.Generator) -> Array:
    """Return a random motion scaled down until it keeps torques, clearances and boxes too; the
    least violating one where none does.

    Each size is tried about its own centre, the reference posture and random postures.
    """
    best, least = C, evaluation.largest_use(C)
    space = evaluation.space
    low, high = (edge[space.dofs] for edge in (space.brief.low, space.brief.high))
    # The author of a model has usually checked its reference posture for collisions.
    room = 0.1 * (high - low)
    reference = np.clip(space.brief.q0[space.q_indices], low + room, high - room)
    for size in (0.6, 0.35, 0.2, 0.1, 0.05):
        if least <= 1.0:
            break
        small = size * C
        inner = 0.8 * low + 0.2 * high, 0.2 * low + 0.8 * high
        for centre in (C[0], reference, *rng.uniform(*inner, (6, len(low)))):
            small[0] = centre
            over = evaluation.largest_use(small)
            if over < least:
                best, least = small.copy(), over
    return best


def excitation_parameters(
    space: DesignSpace, information: InformationModel, draws: Sequence[Array]
) -> InformationModel:
    """Return the regressor of the base parameters that the motions `draws` excite.

    Held joints, a held base and short ranges leave fewer of them, chosen from left to right. Raises
    UnsupportedError where none is left.
    """
    t = space.curves.grid()
    some = draws[: 1 + len(draws) // 4]  # rank needs few motions
    R = qr_factor(_stacked(information, space.motion(C, t)) for C in some)
    base = base_map(R, information.names)
    if base.rank == 0:
        raise UnsupportedError("These motions excite none of the task's parameters.")
    return information.select_columns(base.names)


def design_criterion(
    objective: str | Mapping[str, float],
    information: InformationModel,
    space: DesignSpace,
    draws: Sequence[Array],
    known: Sequence[Trajectory] = (),
) -> Criterion:
    """Return the criterion of an objective on r base parameters, given motions `known` before.

    `predict` takes the torques of the random motions `draws`: S = (R / sqrt(count))^-1 with the R
    factor of their stacked regressors.
    """
    weights, r = criterion_weights(objective), len(information.names)
    rows = [_stacked(information, motion) for motion in known]
    before = qr_factor([*rows, np.zeros((1, r))]) if rows else np.zeros((0, r))
    whiten = np.eye(r)
    if "predict" in weights:
        t = space.curves.grid()
        R = qr_factor(_stacked(information, space.motion(C, t)) for C in draws)
        whiten = np.linalg.inv(R / np.sqrt(len(draws)))
    return Criterion(weights, before, whiten)


def _stacked(information: InformationModel, motion: Trajectory) -> Array:
    Y = information.rows(motion)
    return Y.reshape(-1, Y.shape[2])


def design_figures(information: InformationModel, motion: Trajectory) -> dict[str, Any]:
    """Return rank, condition numbers, log det of W' W and smallest singular value of a motion's
    regressor W, with sign(v) of Coulomb friction unsmoothed."""
    R = qr_factor([_stacked(information, motion)])
    s = np.linalg.svd(R, compute_uv=False)
    unit = np.linalg.svd(R / np.linalg.norm(R, axis=0), compute_uv=False)
    return {
        "rank": len(s),
        "condition": float(s[0] / s[-1]),
        "condition_unit": float(unit[0] / unit[-1]),
        "log_det": float(2 * np.log(s).sum()),
        "smallest_singular_value": float(s[-1]),
    }
