"""Design of the most informative motion: its search, and its result."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.commands.excite import ExciteRequest
from sysid_bench.commands.request import OnValue
from sysid_bench.commands.result import OMIT_NONE, Result, file_text
from sysid_bench.commands.task_terms import check_term_names, terms_of
from sysid_bench.commands.values import check_seed
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.motion_output import (
    RESTING,
    MotionOutput,
    check_output,
    joint_commands,
    joint_motors,
    read_motion,
    write_motion,
)
from sysid_bench.excitation.optimised import Optimised, design_figures, excitation_parameters
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, BaseMap

LIMITS: Final = ("v", "a", "tau")
MOST: Final = 1e9
"""Largest limit: scaled coefficients stay far from the ends of floats."""

RESTING_SPEED: Final = 1e-3
"""Speed (rad/s, m/s) below which a motion counts as starting and ending at rest."""

CLEARANCE: Final = 0.01
"""m between links."""

SHOWN_PRICES: Final = 4
"""Active limits whose price is printed; JSON has all."""

BALANCED: Final = 0.9
"""Share of the slope that the active limits oppose below which prices are said to be rough."""

OWN_NUMBER: Final = {
    "cond": "condition",
    "cond-unit": "condition_unit",
    "D": "log_det",
    "E": "smallest_singular_value",
}
"""Figure of a motion that an objective is about; of others the criterion itself is shown."""


@dataclass(frozen=True, eq=False, repr=False)
class ExciteResult(Result):
    """Designed motion. `rank` of `of` base parameters are excited; `start_...`: median of random
    motions within the limits; `limits`: {kind: value, limit, unit, margin, at} on a grid ten times
    finer than that of the search; `violations`: those above their limit. `value`: the minimised
    criterion, in natural logarithms for condition numbers; `prices`: its decrease per relative
    widening of each active limit, whose slopes oppose the share `prices_balance` of the
    criterion's, squared: one at an optimum."""

    robot: str
    task: str
    payload: str
    terms: list[str]
    objective: str | Mapping[str, float]
    family: str
    harmonics: int
    period: float
    cycles: int
    joints: list[str]
    seed: int
    rate: float
    rank: int
    condition: float
    condition_unit: float
    log_det: float
    smallest_singular_value: float
    of: int
    start_condition: float
    start_condition_unit: float
    start_log_det: float
    start_smallest_singular_value: float
    value: float
    start_value: float
    value_without_box: float | None
    prices: Mapping[str, float]
    prices_balance: float
    evaluations: int
    interrupted: bool
    limits: dict[str, dict[str, Any]]
    violations: list[dict[str, Any]]
    rest: bool
    geometry: dict[str, Any]
    warnings: list[str]
    file: str | None
    export: list[dict[str, Any]] | None = field(default=None, metadata=OMIT_NONE)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Condition, limits with their margins, warnings and the file."""
        condition = f"condition {self.condition:.4g} ({self.start_condition:.4g}), "
        if self.objective == "cond":  # its line has it
            condition = ""
        lines = [
            f"{self.robot}, task {self.task}: {self.family}, "
            f"{self.harmonics} harmonics of {self.period:g} s, rank {self.rank} of {self.of}",
            f"  {self._objective_text()}",
            f"  {condition}log det {self.log_det:.5g} ({self.start_log_det:.5g}); "
            f"{self.evaluations} evaluations, {self.seconds:.1f} s",
            *self._price_lines(),
        ]
        lines += [
            f"  {kind:<12} {used['value']:9.4g} {used['unit']}, limit {used['limit']:.4g}, "
            f"margin {used['margin']:.3g} ({used['at']})"
            for kind, used in self.limits.items()
        ]
        if not self.violations:
            lines.append("  no limit is violated on a grid ten times finer than that of the search")
        lines.append(f"  shapes: {self.geometry['note']}")
        if self.interrupted:
            lines.append("  interrupted: this is the best feasible motion so far")
        lines += [f"  warning: {warning}" for warning in self.warnings]
        return "\n".join(lines + ([f"  file: {self.file}"] if self.file else []))

    def _objective_text(self) -> str:
        """Objective of the search in its own unit: of the motion, of the median random motion, and
        without boxes."""
        objective = self.objective
        shown = OWN_NUMBER.get(str(objective))
        if not isinstance(objective, str):
            objective = ", ".join(f"{name}={weight:g}" for name, weight in objective.items())
        now, before = self.value, self.start_value
        if shown is not None:
            now, before = getattr(self, shown), getattr(self, f"start_{shown}")
        text = f"{objective}: {now:.4g} (median random motion {before:.4g}"
        if self.value_without_box is None:
            return f"{text})"
        # The search smooths the sign of Coulomb friction: its gain is applied to the figure.
        gain = self.value - self.value_without_box
        match objective:
            case "cond" | "cond-unit":  # ln cond
                without = now * math.exp(-gain)
            case "D":  # log det = -rank times the criterion
                without = now + self.rank * gain
            case "E":  # -2 ln of the smallest singular value
                without = now * math.exp(0.5 * gain)
            case _:
                without = now - gain
        return f"{text}; without the box: {without:.4g})"

    def _price_lines(self) -> Iterator[str]:
        """Costs of the dearest limits."""
        unit = "%" if self.objective in ("cond", "cond-unit") else "/ 100 of the criterion"
        for name, price in list(self.prices.items())[:SHOWN_PRICES]:
            yield f"  price of {name}: 1 % wider saves {price:.2g} {unit}"
        if self.prices and self.prices_balance < BALANCED:
            yield (
                f"  these prices are rough: the active limits oppose "
                f"{100 * self.prices_balance:.0f} % of the criterion's squared slope, and at an "
                "optimum all of it"
            )
        elif self.prices:
            yield "  prices are slopes at this motion: a wide change may save more or less"


# --- The design ---------------------------------------------------------------------------------


def design_motion(request: ExciteRequest, on_value: OnValue) -> ExciteResult:
    """Design the motion of a request and write it; `on_value` is called during the search."""
    start = time.perf_counter()
    # Whatever can be refused is checked before the search.
    check_seed(request.seed)
    kind = check_output(request.export, request.out)
    robot, terms, base, problem = _problem(request)
    resting = {} if kind == "csv" else {"family": RESTING}
    settings: dict[str, Any] = {"clearance": CLEARANCE, **resting, **request.settings}
    method = Optimised(objective=request.objective, **settings)
    moving = problem.dofs[method.space(problem).dofs].tolist()
    name_of = {joint.vadr: joint.name for joint in problem.joints}
    joints = tuple(name_of[dof] for dof in moving)
    drives = joint_motors(kind, joints, request.motors)
    recorded = [read_motion(Path(file), problem, joints, method) for file in request.after]
    # The same seed gives _figures the random motions that the search began with.
    rng = np.random.default_rng(request.seed)
    design = method.solve(problem, rng, recorded, on_value)
    motion = method.motion(design.C, problem)
    exported = MotionOutput([], None)
    if request.out is not None:
        commands = joint_commands(robot, motion, joints)
        exported = write_motion(Path(request.out), kind, commands, drives, request.clamp)
    return ExciteResult(
        robot=robot.name,
        task=request.task,
        payload=request.payload,
        terms=list(terms),
        objective=request.objective,
        joints=list(joints),
        seed=request.seed,
        rate=request.rate,
        **{name: getattr(method, name) for name in ("family", "harmonics", "period", "cycles")},
        **_figures(method, problem, design.C, request.seed),
        of=base.rank,
        value=design.value,
        start_value=design.start,
        value_without_box=design.without,
        prices=dict(design.prices.prices),
        prices_balance=design.prices.balance,
        evaluations=design.evaluations,
        interrupted=design.interrupted,
        rest=bool(np.abs(motion.v[[0, -1]]).max() < RESTING_SPEED),
        geometry=_geometry(problem, method),
        warnings=exported.warnings,
        file=file_text(request.out),
        export=exported.drives,
        seconds=time.perf_counter() - start,
    )


def _problem(request: ExciteRequest) -> tuple[RobotModel, tuple[str, ...], BaseMap, DesignProblem]:
    """Robot, joint terms, base parameters and the problem of their information within limits."""
    check_term_names(request.terms)
    robot = load_robot(request.robot, parse_payload(request.payload), robots_dir=request.robots_dir)
    definition = find_task(request.task)
    terms = terms_of(definition, robot, request.terms)
    task = definition.unknowns(robot, terms, request.sensor, None)
    base = structural_base(robot, task.parameters, task.rows, task.cuts)
    problem = replace(
        design_problem(robot, request.rate),
        regress=information_model(robot, base.names, task.rows, task.cuts),
        torque=torque_model(robot),
        scene=cache(partial(collision_model, robot)),  # by the height of the floor
        **_limits(robot.torque_rows, request.limits),
    )
    return robot, terms, base, problem


def _figures(method: Optimised, problem: DesignProblem, C: Array, seed: int) -> dict[str, Any]:
    """Rank and conditioning of the motion C, medians over the draws that the search began with, and
    the use of limits."""
    space = method.space(problem)
    assert problem.regress is not None
    draws = method.random_coefficients(space, np.random.default_rng(seed))
    known, grid = excitation_parameters(space, problem.regress, draws), space.curves.grid()
    random = [design_figures(known, space.motion(draw, grid)) for draw in draws]
    limits = method.report(C, problem)
    return {
        **design_figures(known, space.motion(C, grid)),
        **{
            f"start_{key}": float(np.median([r[key] for r in random]))
            for key in OWN_NUMBER.values()
        },
        "limits": {used.kind: used.to_json() for used in limits.values()},
        # A share that is NaN is a violation too: no comparison with it holds.
        "violations": [
            {"kind": used.kind, "at": used.name, "share": used.use}
            for used in limits.values()
            if not used.use <= 1.0
        ],
    }


def _limits(rows: tuple[str, ...], given: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Limits {key: (nv,)} that replace the robot's; raise UsageError for another key, count or
    sign."""
    limits = {}
    for key, values in given.items():
        if key not in LIMITS:
            raise unknown_name("limit", key, LIMITS, "Positions come from the robot.")
        numbers = np.array(values, dtype=float)
        if len(numbers) not in (1, len(rows)) or not ((numbers > 0) & (numbers <= MOST)).all():
            raise UsageError(
                f"The limit {key} needs one number above 0 and up to {MOST:g}, or {len(rows)}, one "
                f"for each of {', '.join(rows)}; got {', '.join(f'{x:g}' for x in numbers)}."
            )
        limits[key] = np.broadcast_to(numbers, len(rows)).copy()
    return limits


def _geometry(problem: DesignProblem, method: Optimised) -> dict[str, Any]:
    """Pairs of shapes that the search kept apart, and those that it did not check."""
    if problem.scene is None or (method.clearance is None and method.floor is None):
        return {"shapes": None, "ignored": [], "note": "collisions were not asked for"}
    scene = problem.scene(method.floor)
    note = "the robot's files hold none that can be read: collisions were not checked"
    if scene.shapes:
        note = f"{scene.shapes} kept apart by {method.clearance or 0.0:g} m or more"
    # Pairs that touch before the robot moves, as the links at a joint do.
    ignored = [list(pair) for pair in scene.ignored]
    if ignored:
        pairs = ", ".join(" and ".join(pair) for pair in ignored)
        note += f"; not checked, in contact in the reference configuration: {pairs}"
    return {"shapes": scene.shapes, "ignored": ignored, "note": note}
