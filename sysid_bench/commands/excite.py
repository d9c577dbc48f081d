"""Verb `excite`: the most informative motion within a robot's limits, as a file for its
controller."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, overload

from sysid_bench.commands.request import (
    FAILED,
    INTERRUPTED,
    OK,
    OnValue,
    Request,
    model,
    option,
    robots_option,
    sensor_option,
    task_option,
    terms_option,
)
from sysid_bench.commands.result import OMIT_NONE, Result, file_text
from sysid_bench.commands.values import (
    parse_boxes,
    parse_criterion,
    parse_entries,
    parse_limits,
    parse_motors,
    parse_words,
)
from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from sysid_bench.commands.excite_actuators import CommandsRequest, CommandsResult
    from sysid_bench.excitation.design_problem import DesignProblem
    from sysid_bench.excitation.information import InformationModel
    from sysid_bench.excitation.limits import LimitUse
    from sysid_bench.excitation.motion_output import MotionOutput
    from sysid_bench.excitation.optimised import Design, Optimised
    from sysid_bench.models.robot import RobotModel
    from sysid_bench.types import Array, BaseMap, Trajectory

ACTUATORS: Final = "actuators"
"""Task of position-commanded robots, whose recording is designed by its commands."""

OF_COMMANDS: Final = ("period", "joints", "iterations", "starts")
"""Settings of a search that the design of commands has, too."""

LIMITS: Final = ("v", "a", "tau")
_MOST: Final = 1e9
"""Largest limit: scaled coefficients stay far from the ends of floats."""

RESTING_SPEED: Final = 1e-3
"""Speed (rad/s, m/s) below which a motion counts as starting and ending at rest."""

SHOWN_PRICES: Final = 4
"""Active limits whose price is printed; JSON has all."""

BALANCED: Final = 0.9
"""Share of the slope that the active limits oppose below which prices are said to be rough."""

_OWN_NUMBER: Final = {
    "cond": "condition",
    "cond-unit": "condition_unit",
    "D": "log_det",
    "E": "smallest_singular_value",
}
"""Figure of a motion that an objective is about; of others the criterion itself is shown."""

_COMPARED: Final = ("condition", "condition_unit", "log_det", "smallest_singular_value")


class ExciteRequest(Request["ExciteResult"]):
    """Motion to design.

    `objective`: "cond", "cond-unit", "D", "A", "E", "predict", or weights by name. `settings` are
    those of the excitation `optimised` (family, harmonics, period, joints, ...). `limits` replaces
    the robot's: v, a, tau, one number for all degrees of freedom or one each. `export`: "csv",
    "ros2", "damiao" or "can"; `motors` by joint for the last two, of whose samples the share
    `clamp` may be clamped. `after`: CSV files of motions already recorded. `rate` in Hz.
    """

    robot: str | Path = model("ROBOT|FILE")
    objective: str | Mapping[str, float] = option(
        "cond, cond-unit, D, A, E or predict; or weights: D=1,cond=0.2.",
        default="cond", shown=True, parse=parse_criterion,
    )  # fmt: skip
    out: str | Path | None = option(
        "File of the motion.", default=None, flags="-o", path="new", complete="files"
    )
    export: str | None = option("csv (default), ros2, damiao or can.", default=None)
    task: str = task_option()
    payload: str = option(
        "Load mounted at the tool.", default="none", shown=True, complete="payloads"
    )
    sensor: str | None = sensor_option()
    terms: Sequence[str] | None = terms_option()
    settings: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Sequence[float]] = option(
        "Instead of the robot's limits: one number for all joints, or one each.",
        default={}, flags="--limit", metavar="v|a|tau=X[,X...]", several=True, parse=parse_limits,
    )  # fmt: skip
    motors: Mapping[str, Mapping[str, Any]] | None = None
    clamp: float = option("Samples that motors may clamp.", default=0.01, unit="1", shown="1 %")
    after: Sequence[str | Path] = option(
        "CSV of a motion already recorded: design the next one.",
        default=(), path="new", several=True, complete="files",
    )  # fmt: skip
    rate: float = option("Of the written samples.", default=200.0, unit="Hz", shown="200 Hz")
    seed: int = option("", default=0, least=0, shown=True)
    robots_dir: Path | None = robots_option()

    def run(self) -> "ExciteResult":
        """Design the motion, without a listener."""
        return self.design(lambda count, value: None)

    def design(self, on_value: OnValue) -> "ExciteResult":
        """Design the motion and write it; `on_value` is called during the search."""
        import numpy as np

        from sysid_bench.commands.values import check_seed
        from sysid_bench.excitation.motion_output import (
            MotionOutput,
            check_output,
            joint_commands,
            joint_motors,
            read_motion,
            write_motion,
        )

        start = time.perf_counter()
        # Whatever can be refused is checked before the search.
        check_seed(self.seed)
        kind = check_output(self.export, self.out)
        question = _question(self, kind)
        method, problem = question.method, question.problem
        drives = joint_motors(kind, question.joints, self.motors)
        recorded = [read_motion(Path(f), problem, question.joints, method) for f in self.after]
        # The same seed gives _figures the random motions that the search began with.
        rng = np.random.default_rng(self.seed)
        design = method.solve(problem, rng, recorded, on_value)
        motion = method.motion(design.C, problem)
        exported = MotionOutput([], None)
        if self.out is not None:
            commands = joint_commands(question.robot, motion, question.joints)
            exported = write_motion(Path(self.out), kind, commands, drives, self.clamp)
        return _result(self, question, design, motion, exported, time.perf_counter() - start)


def _settings_of(words: Sequence[str]) -> dict[str, int | str]:
    """Settings of KEY=VALUE; whole numbers without a unit are counts."""
    return {key: int(x) if x.isdecimal() else x for key, x in parse_entries(words)}


class ExciteCommand(ExciteRequest):
    """Design the best motion within a robot's limits, and write it for its controller.

    Exit code 1 where a limit is violated, 130 after an interrupt (the best motion is written).
    """

    period: float | None = option(
        "Default: 10 s; of actuators 20 s.", default=None, metavar="S", unit="s"
    )
    harmonics: int | None = option("Default: 5.", default=None, least=1)
    family: str | None = option(
        "fourier, fourier-polynomial or b-spline; the last two start and end at rest. "
        "Default: fourier, and fourier-polynomial for ros2, damiao and can.",
        default=None,
    )
    joints: tuple[str, ...] | None = option(
        "Joints that move; default: all.", default=None, metavar="A,B,...", parse=parse_words
    )
    margin: float | None = option(
        "Of every limit, which the search leaves. Default: 2 %.",
        default=None, metavar="SHARE", unit="1",
    )  # fmt: skip
    others: Mapping[str, Any] = option(
        "Another setting of the search: cycles (1), torque_share (90 %), clearance between links "
        "(0.01 m), floor that nothing may touch; see `sysid-bench help optimised`.",
        default={}, flags="--set", metavar="KEY=VALUE", several=True, parse=_settings_of,
    )  # fmt: skip
    iterations: int | None = option("Of the search. Default: 150.", default=None, least=1)
    starts: int | None = option("Of the search. Default: 1.", default=None, least=1)
    gains: Mapping[str, Sequence[float]] = option(
        "Task actuators: gains of the position controller (N m/rad, N m s/rad); one number for all "
        "joints, or one each. Default: those of the model's actuators.",
        default={}, flags="--gain", metavar="kp|kd=X[,X...]", several=True, parse=parse_limits,
        when=("--task actuators",),
    )  # fmt: skip
    boxes: Mapping[str, Any] = option(
        "Where a body may go, m.",
        default={}, flags="--box", metavar="BODY=X:X,Y:Y,Z:Z", several=True, parse=parse_boxes,
    )  # fmt: skip
    motor_types: str | None = option(
        "Damiao motors of the joints for --export; for --task actuators names of `list motors`, "
        "one or one each, whose torque and speed are kept.",
        default=None, flags="--motors", metavar="TYPE,TYPE,...|FILE.toml",
    )  # fmt: skip

    def plugins(self) -> Iterable[tuple[str, str | None]]:
        return [("task", self.task)]

    def progress(self) -> AbstractContextManager[OnValue]:
        from sysid_bench.commands.progress import search_progress

        return search_progress()

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_result

        request = self._of_commands() if self.task == ACTUATORS else self._of_motion()
        with self.progress() as on_value:
            result = excite(request, on_value)
        print_result(result, as_json)
        if result.interrupted:
            return INTERRUPTED
        return FAILED if result.violations else OK

    def _of_motion(self) -> ExciteRequest:
        if self.gains:
            raise UsageError(
                f"--gain: for --task {ACTUATORS} alone, whose robots are position-commanded."
            )
        settings = self._settings() | ({"boxes": self.boxes} if self.boxes else {})
        motors = None if self.motor_types is None else parse_motors(self.motor_types)
        of_motion = {entry.name: getattr(self, entry.name) for entry in fields(ExciteRequest)}
        return ExciteRequest(**of_motion | {"settings": settings, "motors": motors})

    def _settings(self) -> dict[str, Any]:
        """Settings of the excitation `optimised` that stand on the line."""
        from sysid_bench.excitation.optimised import Optimised
        from sysid_bench.plugin_settings import plugin_settings

        names = ("period", "harmonics", "family", "joints", "margin", "iterations", "starts")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return given | plugin_settings("excitation 'optimised'", Optimised, self.others)

    def _of_commands(self) -> "CommandsRequest":
        """Commands to design; raise UsageError for options that such a design does not have."""
        from sysid_bench.commands.excite_actuators import CommandsRequest

        settings = self._settings()
        given = {
            "objective": self.objective != "cond", "payload": self.payload != "none",
            "sensor": bool(self.sensor), "terms": self.terms is not None, "box": bool(self.boxes),
            "after": bool(self.after), "export": bool(self.export),
            **{name: True for name in settings if name not in OF_COMMANDS},
        }  # fmt: skip
        names = [
            f"--set {name}" if name in self.others else f"--{name}"
            for name, is_given in given.items()
            if is_given
        ]
        if names:
            raise UsageError(
                f"{', '.join(names)}: not for --task {ACTUATORS}, whose commands have "
                f"{', '.join(f'--{name}' for name in OF_COMMANDS)}, --gain, --limit and --motors."
            )
        return CommandsRequest(
            self.robot,
            gains=self.gains,
            limits=self.limits,
            motors=[name for name in parse_words(self.motor_types or "") if name],
            out=self.out,
            rate=self.rate,
            seed=self.seed,
            robots_dir=self.robots_dir,
            **settings,
        )


@overload
def excite(request: "CommandsRequest", on_value: OnValue = ...) -> "CommandsResult": ...
@overload
def excite(request: ExciteRequest | str | Path, on_value: OnValue = ...) -> "ExciteResult": ...
def excite(
    request: "ExciteRequest | CommandsRequest | str | Path",
    on_value: OnValue = lambda count, value: None,
) -> "ExciteResult | CommandsResult":
    """Design a motion and write it to `request.out`; a robot alone stands for its default request.
    A CommandsRequest asks for commands of a position controller.

    `on_value` is called during the search. Raises UsageError for unknown names, UnsupportedError
    where no motion keeps the limits.
    """
    if isinstance(request, (str, Path)):
        request = ExciteRequest(request)
    if isinstance(request, ExciteRequest):
        return request.design(on_value)
    from sysid_bench.commands.excite_actuators import excite_actuators

    return excite_actuators(request, on_value)


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
        ]
        lines += self._price_lines()
        lines += [_limit_line(kind, used) for kind, used in self.limits.items()]
        if not self.violations:
            lines.append("  no limit is violated on a grid ten times finer than that of the search")
        lines.append(f"  shapes: {self.geometry['note']}")
        return "\n".join([*lines, *self._closing_lines()])

    def _objective_text(self) -> str:
        """Objective of the search in its own unit: of the motion, of the median random motion, and
        without boxes."""
        shown = _OWN_NUMBER.get(str(self.objective))
        if shown is None:
            now, before = self.value, self.start_value
        else:
            now, before = (getattr(self, f"{prefix}{shown}") for prefix in ("", "start_"))
        text = f"{_objective_name(self.objective)}: {now:.4g} (median random motion {before:.4g}"
        if self.value_without_box is None:
            return f"{text})"
        # The search smooths the sign of Coulomb friction: its gain is applied to the figure.
        without = self._with_gain(now, self.value - self.value_without_box)
        return f"{text}; without the box: {without:.4g})"

    def _with_gain(self, figure: float, gain: float) -> float:
        """Return the objective's own figure for a criterion that is smaller by `gain`."""
        match self.objective:
            case "cond" | "cond-unit":  # ln cond
                return figure * math.exp(-gain)
            case "D":  # log det = -rank times the criterion
                return figure + self.rank * gain
            case "E":  # -2 ln of the smallest singular value
                return figure * math.exp(0.5 * gain)
            case _:
                return figure - gain

    def _price_lines(self) -> list[str]:
        """What the dearest limits cost."""
        if not self.prices:
            return []
        dearest = list(self.prices.items())[:SHOWN_PRICES]
        unit = "%" if self.objective in ("cond", "cond-unit") else "/ 100 of the criterion"
        lines = [
            f"  price of {name}: 1 % wider saves {price:.2g} {unit}" for name, price in dearest
        ]
        return [*lines, self._price_caution()]

    def _price_caution(self) -> str:
        if self.prices_balance < BALANCED:
            share = f"{100 * self.prices_balance:.0f} %"
            return (
                f"  these prices are rough: the active limits oppose {share} of the criterion's "
                "squared slope, and at an optimum all of it"
            )
        return "  prices are slopes at this motion: a wide change may save more or less"

    def _closing_lines(self) -> Iterator[str]:
        """Interruption, warnings and the file."""
        if self.interrupted:
            yield "  interrupted: this is the best feasible motion so far"
        for warning in self.warnings:
            yield f"  warning: {warning}"
        if self.file:
            yield f"  file: {self.file}"


def _objective_name(objective: str | Mapping[str, float]) -> str:
    if isinstance(objective, str):
        return objective
    return ", ".join(f"{name}={weight:g}" for name, weight in objective.items())


def _limit_line(kind: str, used: Mapping[str, Any]) -> str:
    return (
        f"  {kind:<12} {used['value']:9.4g} {used['unit']}, limit {used['limit']:.4g}, "
        f"margin {used['margin']:.3g} ({used['at']})"
    )


@dataclass(frozen=True, eq=False)
class _Question:
    """Robot, unknowns and limits of a design, before the search."""

    robot: "RobotModel"
    terms: tuple[str, ...]
    base: "BaseMap"
    problem: "DesignProblem"
    information: "InformationModel"
    method: "Optimised"
    joints: tuple[str, ...]


def _result(
    request: ExciteRequest,
    question: _Question,
    design: "Design",
    motion: "Trajectory",
    exported: "MotionOutput",
    seconds: float,
) -> ExciteResult:
    import numpy as np

    method, problem = question.method, question.problem
    return ExciteResult(
        robot=question.robot.name,
        task=request.task,
        payload=request.payload,
        terms=list(question.terms),
        objective=request.objective,
        joints=list(question.joints),
        seed=request.seed,
        rate=request.rate,
        **{name: getattr(method, name) for name in ("family", "harmonics", "period", "cycles")},
        **_figures(question, design.C, request.seed),
        **_limit_fields(method.report(design.C, problem)),
        of=question.base.rank,
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
        seconds=seconds,
    )


def _limit_fields(limits: "Mapping[str, LimitUse]") -> dict[str, Any]:
    """Fields `limits` and `violations` of the result."""
    # A share that is NaN is a violation too: no comparison with it holds.
    violated = [used for used in limits.values() if not used.use <= 1.0]
    return {
        "limits": {used.kind: used.to_json() for used in limits.values()},
        "violations": [
            {"kind": used.kind, "at": used.name, "share": used.use} for used in violated
        ],
    }


def _question(request: ExciteRequest, kind: str) -> _Question:
    from sysid_bench.commands.task_terms import check_term_names, terms_of
    from sysid_bench.excitation.collision_model import collision_model
    from sysid_bench.excitation.design_problem import design_problem
    from sysid_bench.excitation.information import information_model, torque_model
    from sysid_bench.excitation.motion_output import RESTING
    from sysid_bench.excitation.optimised import Optimised
    from sysid_bench.experiments.tasks.task import find_task
    from sysid_bench.identifiability.base_map import structural_base
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.payload import parse_payload

    check_term_names(request.terms)
    payload = parse_payload(request.payload)
    robot = load_robot(request.robot, payload, robots_dir=request.robots_dir)
    definition = find_task(request.task)
    terms = terms_of(definition, robot, request.terms)
    posed = definition.unknowns(robot, terms, request.sensor, None)
    base = structural_base(robot, posed.parameters, posed.rows, posed.cuts)
    information = information_model(robot, base.names, posed.rows, posed.cuts)
    scenes: dict[float | None, Any] = {}
    problem = replace(
        design_problem(robot, request.rate),
        regress=information,
        torque=torque_model(robot),
        scene=lambda floor: scenes.setdefault(floor, collision_model(robot, floor)),
        **_limits(robot.torque_rows, request.limits),
    )
    resting = {} if kind == "csv" else {"family": RESTING}
    settings: dict[str, Any] = {"clearance": 0.01, **resting, **request.settings}
    method = Optimised(objective=request.objective, **settings)
    return _Question(
        robot=robot,
        terms=terms,
        base=base,
        problem=problem,
        information=information,
        method=method,
        joints=_joint_names(problem, method.space(problem).dofs),
    )


def _figures(question: _Question, C: "Array", seed: int) -> dict[str, Any]:
    """Rank and conditioning of the motion C, and medians over the draws that the search began
    with."""
    import numpy as np

    from sysid_bench.excitation.optimised import design_figures, excitation_parameters

    space = question.method.space(question.problem)
    draws = question.method.random_coefficients(space, np.random.default_rng(seed))
    information = excitation_parameters(space, question.information, draws)
    grid = space.curves.grid()
    random = [design_figures(information, space.motion(draw, grid)) for draw in draws]
    medians = {f"start_{key}": float(np.median([r[key] for r in random])) for key in _COMPARED}
    return design_figures(information, space.motion(C, grid)) | medians


def _joint_names(problem: "DesignProblem", dofs: "Array") -> tuple[str, ...]:
    names = {joint.vadr: joint.name for joint in problem.joints}
    return tuple(names[int(dof)] for dof in problem.dofs[dofs])


def _limits(rows: tuple[str, ...], given: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Limits {key: (nv,)} that replace the robot's."""
    unknown = next((key for key in given if key not in LIMITS), None)
    if unknown is not None:
        raise unknown_name("limit", unknown, LIMITS, "Positions come from the robot.")
    return {key: _limit(key, values, rows) for key, values in given.items()}


def _limit(key: str, values: Sequence[float], rows: tuple[str, ...]) -> "Array":
    """One positive number for each row; raise UsageError for another count or sign."""
    import numpy as np

    numbers = np.array(values, dtype=float)
    if len(numbers) not in (1, len(rows)) or not ((numbers > 0) & (numbers <= _MOST)).all():
        raise UsageError(
            f"The limit {key} needs one number above 0 and up to {_MOST:g}, or {len(rows)}, one "
            f"for each of {', '.join(rows)}; got {', '.join(f'{x:g}' for x in numbers)}."
        )
    limit: Array = np.broadcast_to(numbers, len(rows)).copy()
    return limit


def _geometry(problem: "DesignProblem", method: "Optimised") -> dict[str, Any]:
    """Pairs of shapes that the search kept apart, and those that it did not check."""
    if problem.scene is None or (method.clearance is None and method.floor is None):
        return {"shapes": None, "ignored": [], "note": "collisions were not asked for"}
    scene = problem.scene(method.floor)
    ignored = [list(pair) for pair in scene.ignored]
    note = _checked_text(scene.shapes, method.clearance) + _ignored_text(ignored)
    return {"shapes": scene.shapes, "ignored": ignored, "note": note}


def _checked_text(shapes: int, clearance: float | None) -> str:
    if not shapes:
        return "the robot's files hold none that can be read: collisions were not checked"
    return f"{shapes} kept apart by {clearance or 0.0:g} m or more"


def _ignored_text(ignored: Sequence[Sequence[str]]) -> str:
    """Pairs that touch before the robot moves, as the links at a joint do."""
    if not ignored:
        return ""
    pairs = ", ".join(" and ".join(pair) for pair in ignored)
    return f"; not checked, in contact in the reference configuration: {pairs}"
