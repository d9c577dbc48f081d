"""Conformance kit of estimators, on small simulated experiments.

Exact data give the true parameters; the result is deterministic, equivariant under changes of unit
and invariant to the order of the joints; the input stays unchanged; a failure has a reason; and the
estimate depends on the data, not only on the prior.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, Kit, KitCase, Law, failed_checks
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_std, std_with_floor
from sysid_bench.identifiability.base_map import base_map
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import row_noise, stacked_factor
from sysid_bench.spatial import phi_of_pseudo_inertia, pseudo_inertia
from sysid_bench.types import Array, Estimate, Experiment, Factor, Prior, Problem, RowBlock

# `replace` makes a new object each time, so that the cached `Problem.stacked` is not inherited.


def _with_blocks(
    problem: Problem, change: Callable[[Array, Array], RowBlock], **changes: Any
) -> Problem:
    """The problem with its blocks of rows changed, and other fields."""

    def blocks() -> Iterator[RowBlock]:
        return (change(Y, b) for Y, b in problem.blocks())

    return replace(problem, blocks=blocks, **changes)


def scaled_problem(problem: Problem, regressor: float = 1.0, torque: float = 1.0) -> Problem:
    """The problem (regressor W) beta = torque b, in R factors and blocks alike."""
    factors = tuple(
        replace(f, R=f.R * np.append(np.full(len(f.columns), regressor), torque))
        for f in problem.factors
    )
    return _with_blocks(problem, lambda Y, b: (regressor * Y, torque * b), factors=factors)


def first_samples(problem: Problem, samples: int) -> Problem:
    """The problem of the first `samples` samples."""
    Y, b = next(iter(problem.blocks()))
    Y, b = Y[:samples].copy(), b[:samples].copy()
    factors = []
    for i, factor in enumerate(problem.factors):
        # R of [W b] holds all that least squares need: R^T R = [W b]^T [W b].
        stack = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        R = np.asarray(np.linalg.qr(stack, mode="r"))
        factors.append(Factor(factor.row, factor.columns, R, len(b)))
    return replace(problem, factors=tuple(factors), blocks=lambda: iter([(Y, b)]), samples=len(b))


def with_moved_frames(problem: Problem, rng: np.random.Generator) -> Problem:
    """The same problem with the frames of its links turned, and moved by 0.1 m: other inertial
    parameters, another choice of base parameters, the same torques. The deviations of a prior are
    those that its values have in the new frames."""
    index = {name: i for i, name in enumerate(problem.parameters)}
    turn, std = np.eye(len(index)), None if problem.prior is None else problem.prior.std.copy()
    bodies = [np.array([index[name] for name in body.columns]) for body in problem.bodies]
    for columns in bodies:
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = rng.normal(0.0, 0.1, 3)
        # J' = T J T': the second moments of the mass in the new frame, by columns.
        moved = pose @ pseudo_inertia(np.eye(10)) @ pose.T
        turn[np.ix_(columns, columns)] = phi_of_pseudo_inertia(moved).T
    back = np.linalg.inv(turn)
    sizes = problem.base.singular_values[: problem.base.rank, None]
    base = base_map(sizes * (problem.base.K if (V := problem.base.row_space) is None else V) @ back,
                    problem.parameters)  # fmt: skip
    # beta' = C beta, and W' = W C^-1.
    C = base.K @ turn @ np.linalg.pinv(problem.base.K)
    inverse, r = np.linalg.inv(C), problem.base.rank
    factors = []
    for factor in problem.factors:
        whole = np.zeros((max(len(factor.R), r + 1), r + 1))
        whole[: len(factor.R), [*factor.columns, r]] = factor.R
        whole[:, :r] = whole[:, :r] @ inverse
        # A row counts the parameters that it depends on: what is rounding is none.
        size = np.linalg.norm(whole[:, :r], axis=0)
        columns = np.flatnonzero(size > ROUNDING * size.max(initial=0.0))
        R = np.asarray(np.linalg.qr(whole[:, [*columns, r]], mode="r"))
        factors.append(replace(factor, R=R, columns=columns))
    prior = problem.prior
    if prior is not None and std is not None:
        theta = turn @ prior.theta
        for columns in bodies:
            std[columns] = prior_std(theta[columns], PriorSpread())
        prior = Prior(theta, std_with_floor(std, problem.parameters))
    file = None if problem.file is None else turn @ problem.file
    return _with_blocks(
        problem, lambda Y, b: (Y @ inverse, b), factors=tuple(factors), base=base, prior=prior,
        file=file,
    )  # fmt: skip


ROUNDING: Final = 1e-9
"""Share of the largest column of a row that is rounding of a change of parameters."""

EXACT: Final = 1e-8
"""Largest |beta - beta*| / |beta*| of a consistent method on exact data."""

SAME: Final = 1e-5
"""Largest relative difference between the torques of two estimates that have to agree."""

UNMOVED_SHARE: Final = 0.01
"""Largest part of a standard deviation by which other frames of the links may move an answer: it
adds 0.005 % to the spread, which no comparison sees."""

UNMOVED: Final = 1e-9
"""Relative distance below which an estimate equals the (wrong) prior, or zero."""


@dataclass(frozen=True, eq=False)
class TestProblem(KitCase):
    """An identification problem with known parameters `theta` (p,); `exact` where its data have no
    noise, `experiment` for methods that simulate."""

    # Its name starts with Test: pytest is not to collect it.
    __test__ = False

    problem: Problem
    theta: Array
    exact: bool
    experiment: Experiment | None = None


def check(estimator: Any, cases: Sequence[TestProblem]) -> list[Finding]:
    """Findings of all laws on all cases; an exception of the estimator violates the law that met
    it."""
    kits = [_EstimatorKit(estimator, case) for case in cases]
    findings = [finding for kit in kits for finding in kit.findings()]
    estimates = [kit.result for kit in kits if kit.result is not None]
    # A method that fails on every problem would keep all laws.
    if not any(estimate.status == "ok" for estimate in estimates):
        given = "; ".join(dict.fromkeys(one.reason for one in estimates if one.reason))
        message = "it solved none of the problems" + (f": {given}" if given else "")
        findings.append(Finding(_EstimatorKit.runs, "all problems", False, message))
    return findings


def assert_conforms(estimator: Any, cases: Sequence[TestProblem]) -> None:
    """Raise AssertionError with all violated laws of an estimator; for tests."""
    lines = failed_checks(check(estimator, cases))
    if lines:
        raise AssertionError(f"{estimator!r} violates {len(lines)} laws:\n" + "\n".join(lines))


class _EstimatorKit(Kit[TestProblem]):
    """`result`: the estimate. A method biased by design declares `bias`."""

    runs = "returns an estimate"
    changed = "it changed an array of the problem"

    def run(self) -> Estimate:
        return identify(self.plugin, self.case.problem, self.case.experiment)

    def given(self) -> Any:
        return self.case.problem, self.case.experiment

    @Law("recovers exact parameters")
    def exact(self) -> str | None:
        first = self.result
        if not self.case.exact or first.beta is None or first.status != "ok":
            return None
        if getattr(self.plugin, "bias", ""):
            return None
        # beta = K theta: base parameters are sums of the standard ones.
        truth = self.case.problem.base.K @ self.case.theta
        error = _relative(first.beta - truth, truth)
        if error <= EXACT:
            return None
        return (
            f"exact data give beta with a relative error of {error:.1e}; {EXACT:.0e} is allowed. A "
            "method biased by design describes its bias in a class attribute 'bias'"
        )

    @Law("is deterministic")
    def repeats(self) -> str | None:
        """The same problem gives the same estimate, bit for bit."""
        first, second = self.result, self.run()
        if first.status != second.status:
            return (
                f"its status is {first.status!r} in the first call and {second.status!r} in the "
                "next"
            )
        for name in ("beta", "theta", "covariance"):
            one, two = getattr(first, name), getattr(second, name)
            if not (np.array_equal(one, two) if one is not None else two is None):
                return f"{name} differs from one call to the next"
        return None

    @Law("is invariant to the unit of torque")
    def torque_unit(self) -> str | None:
        """W and b times a factor: the same parameters."""
        # Powers of two change exponents alone: both forms of the problem have the same rounding.
        return self._differs(scaled_problem(self.case.problem, regressor=4.0, torque=4.0))

    @Law("is equivariant to the unit of mass")
    def mass_unit(self) -> str | None:
        """b and the prior times a factor: the parameters times that factor."""
        factor, prior = 2.0, self.case.problem.prior
        scaled = scaled_problem(self.case.problem, torque=factor)
        if prior is not None:
            scaled = replace(scaled, prior=Prior(factor * prior.theta, factor * prior.std))
        return self._differs(scaled, factor)

    @Law("is invariant to the order of joints")
    def joint_order(self) -> str | None:
        """Rows in reverse order: the same parameters."""
        problem = self.case.problem
        turned = {name: getattr(problem, name)[::-1] for name in ("rows", "factors", "kinds")}
        other = _with_blocks(problem, lambda Y, b: (Y[:, ::-1], b[:, ::-1]), **turned)
        return self._differs(other)

    @Law("does not depend on names")
    def names(self) -> str | None:
        """Other names of joints and bodies, with the kinds of their parameters: the same values."""
        return self._differs(_renamed(self.case.problem))

    @Law("does not depend on the frames of the links")
    def frames(self) -> str | None:
        """Frames turned and moved: the same torques, to 1 % of their deviations; a method that does
        not declares `frame_dependent`, and is not ranked."""
        problem = self.case.problem
        is_declared = bool(getattr(self.plugin, "frame_dependent", ""))
        # Without noise there is no deviation to compare with.
        if self.case.exact or is_declared or not hasattr(self.plugin, "solve"):
            return None
        moved = frame_deviation(self.plugin, problem, self.result)
        if moved is None or moved <= UNMOVED_SHARE:
            return None
        return (
            f"other link frames move its answer by {moved:.1e} of a standard deviation; "
            f"{UNMOVED_SHARE:g} is allowed. A method that depends on them says why in a class "
            "attribute 'frame_dependent'"
        )

    def _differs(self, other: Problem, factor: float = 1.0) -> str | None:
        """Violation where the solution of `other` is not `factor` times the first one."""
        if not hasattr(self.plugin, "solve"):
            return None
        one, two = self.result, identify(self.plugin, other)
        if one.status != two.status:
            return (
                f"its status is {one.status!r} in one form of the problem and {two.status!r} in "
                "another"
            )
        if one.beta is None or two.beta is None or one.status != "ok":
            return None
        # In torques rather than in beta: weakly excited directions may differ by more.
        R = stacked_factor(self.case.problem)[:-1, :-1]
        error = _relative(R @ (two.beta / factor - one.beta), R @ one.beta)
        return None if error <= SAME else f"the torques of the two estimates differ by {error:.1e}"

    @Law("gives a reason on failure")
    def reason(self) -> str | None:
        """One sample excites almost nothing: the estimate is finite or has a status with a
        reason."""
        if not hasattr(self.plugin, "solve"):
            return None
        for estimate in (self.result, identify(self.plugin, first_samples(self.case.problem, 1))):
            if estimate.status != "ok" and len(estimate.reason.split()) < 3:
                return f"its status is {estimate.status!r} and its reason {estimate.reason!r}"
        return None

    @Law("refuses unexcited parameters")
    def unexcited(self) -> str | None:
        """One sample without a prior determines fewer base parameters than there are. A method that
        returns all of them has added information: it declares `bias` or returns `theta`."""
        if not hasattr(self.plugin, "solve"):
            return None
        # A prior would be a reason to return every parameter.
        problem = replace(first_samples(self.case.problem, 1), prior=None)
        # As many equations as unknowns could determine all of them.
        if len(problem.rows) >= problem.base.rank:
            return None
        estimate = identify(self.plugin, problem)
        biased = getattr(self.plugin, "bias", "") or estimate.theta is not None
        if estimate.status != "ok" or biased:
            return None
        return (
            "it returns all base parameters from one sample without a prior, and declares no 'bias'"
        )

    @Law("uses the data")
    def data(self) -> str | None:
        """The estimate is neither zero nor the prior, which is wrong here; that of a null model,
        which declares `uses_data = False`, is the prior."""
        beta, problem = self.result.beta, self.case.problem
        if self.result.status != "ok" or beta is None:
            return None
        uses_data = getattr(self.plugin, "uses_data", True)
        if uses_data and _relative(beta, problem.base.K @ self.case.theta) <= UNMOVED:
            return "its estimate is zero"
        if problem.prior is None:
            without = "it declares uses_data = False, and has an estimate without a prior"
            return None if uses_data else without
        start = problem.base.K @ problem.prior.theta
        is_prior = _relative(beta - start, start) <= UNMOVED
        if uses_data and is_prior:
            return "its estimate is the prior: a fit that stays at its start has failed"
        if uses_data or is_prior:
            return None
        return "it declares uses_data = False, and its estimate is not the prior"


def frame_deviation(estimator: Any, problem: Problem, result: Estimate) -> float | None:
    """Return how far other frames of the links move the answer `result`, in standard deviations of
    weighted least squares (RMS over base parameters); None without an answer in one of them,
    infinite where other frames lose it."""
    moved = with_moved_frames(problem, np.random.default_rng(3))
    other = identify(estimator, moved)
    if result.beta is None or result.status != "ok":
        return None
    if other.beta is None or other.status != "ok":
        return np.inf
    sigma, squares = row_noise(problem), 0.0
    for (W, _), (V, _) in zip(problem.blocks(), moved.blocks(), strict=True):
        squares += float((((W @ result.beta - V @ other.beta) / sigma) ** 2).sum())
    return float(np.sqrt(squares / problem.base.rank))


def _renamed(problem: Problem) -> Problem:
    """The problem with other names of its bodies and joints."""
    owners = dict.fromkeys(name.rpartition(".")[0] for name in problem.parameters)
    known = {owner: f"part{len(owners) - k}" for k, owner in enumerate(owners)}

    def renamed(names: Sequence[str]) -> tuple[str, ...]:
        parts = (name.rpartition(".") for name in names)
        return tuple(f"{known[owner]}.{kind}" for owner, _, kind in parts)

    bodies = tuple(
        replace(body, name=f"body{k}", columns=renamed(body.columns))
        for k, body in enumerate(problem.bodies)
    )
    rows = {row: f"row{k}" for k, row in enumerate(problem.rows)}
    return replace(
        problem,
        parameters=renamed(problem.parameters),
        base=replace(problem.base, parameters=renamed(problem.base.parameters)),
        bodies=bodies,
        rows=tuple(rows.values()),
        factors=tuple(replace(factor, row=rows[factor.row]) for factor in problem.factors),
        signed=None if problem.signed is None else renamed(problem.signed),
    )


def _relative(difference: Array, reference: Array) -> float:
    return float(np.linalg.norm(difference)) / max(float(np.linalg.norm(reference)), 1e-300)


LINEAR: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7"},
    {"robot": "random:12", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5"},
    {"robot": "ur10", "noise": {"tau_relative": 0.01}, "prior": "none"},
    {"robot": "panda", "task": "payload", "payload": "box-2kg"},
    {"robot": "ur10", "task": "link", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""Exact and noisy data, whole robots and single bodies, with and without a prior."""

CLOSED_LOOP: Final[Mapping[str, Any]] = {
    "robot": "random:94",
    "simulation": {"use": "closed-loop", "rate": 500.0, "substeps": 1},
    "rate": 100.0,
}
"""Experiment of methods that simulate: a declared controller, and joints without Coulomb friction,
which would stick, so that exact data would not give the true parameters."""

_DEFAULTS: Final[Mapping[str, Any]] = {
    "seed": 1,
    "payload": "none",
    "task": "robot",
    "terms": None,
    "plant": {"use": "matched"},
    "prior": {"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
    "excitation": {"use": "fourier", "period": "4 s", "cycles": 1},
    "held_out": (),
    "simulation": {"use": "inverse"},
    "rate": 30.0,
    "noise": {},
    "signals": {"filter": "none", "derivatives": "exact"},
    "repeat": 0,
}


def estimator_problems(
    simulating: bool = False, robots_dir: Path | None = None
) -> tuple[TestProblem, ...]:
    """Test problems of linear methods, or of methods that simulate; a new object each time."""
    if simulating:
        # Exact data show a bias, noisy ones that the method does not need exact data.
        noisy = {**CLOSED_LOOP, "noise": {"tau_relative": 0.01}}
        return tuple(_problem(changes, robots_dir) for changes in (CLOSED_LOOP, noisy))
    return tuple(_problem(changes, robots_dir) for changes in LINEAR)


@cache
def estimator_cases(simulating: bool) -> tuple[TestProblem, ...]:
    """`estimator_problems`, made once per process."""
    return estimator_problems(simulating)


def experiment_spec(changes: Mapping[str, Any]) -> ExperimentSpec:
    """Specification of a small experiment of one short motion, with some fields changed."""
    return ExperimentSpec(**{**_DEFAULTS, **changes})


def _problem(changes: Mapping[str, Any], robots_dir: Path | None) -> TestProblem:
    spec = experiment_spec(changes)
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(
        name, ready.problem, ready.source.truth.theta, not spec.noise, ready.experiment
    )
