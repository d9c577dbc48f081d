"""Verb `excite`: the most informative motion within a robot's limits, as a file for its
controller."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar, overload

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
from sysid_bench.commands.values import (
    parse_boxes,
    parse_criterion,
    parse_entries,
    parse_limits,
    parse_motors,
    parse_words,
)
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.commands.excite_design import ExciteResult

Designed = TypeVar("Designed", covariant=True)

ACTUATORS: Final = "actuators"
"""Task of position-commanded robots, whose recording is designed by its commands."""


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
    rate: float = option("Rate of the written samples.", default=200.0, unit="Hz", shown="200 Hz")
    seed: int = option("Seed of the search.", default=0, least=0, shown=True)
    robots_dir: Path | None = robots_option()

    def run(self) -> "ExciteResult":
        """Design the motion, without a listener."""
        return self.design(lambda count, value: None)

    def design(self, on_value: OnValue) -> "ExciteResult":
        """Design the motion and write it; `on_value` is called during the search."""
        from sysid_bench.commands.excite_design import design_motion

        return design_motion(self, on_value)


def _settings_of(words: Sequence[str]) -> dict[str, int | str]:
    """Settings of KEY=VALUE; whole numbers without a unit are counts."""
    return {key: int(x) if x.isdecimal() else x for key, x in parse_entries(words)}


class ExciteCommand(ExciteRequest):
    """Design the best motion within a robot's limits, and write it for its controller.

    Exit code 1 where a limit is violated, 130 after an interrupt (the best motion is written).
    """

    period: float | None = option(
        "Length of a period. Default: 10 s; of actuators 20 s.", default=None, metavar="S", unit="s"
    )
    harmonics: int | None = option("Harmonics of the curves. Default: 5.", default=None, least=1)
    family: str | None = option(
        "fourier, fourier-polynomial or b-spline; the last two start and end at rest. "
        "Default: fourier, and fourier-polynomial for ros2, damiao and can.",
        default=None,
    )
    joints: tuple[str, ...] | None = option(
        "Joints that move; default: all.", default=None, metavar="A,B,...", parse=parse_words
    )
    margin: float | None = option(
        "Share of every limit that the search leaves. Default: 2 %.",
        default=None, metavar="SHARE", unit="1",
    )  # fmt: skip
    others: Mapping[str, Any] = option(
        "Another setting of the search: cycles (1), torque_share (90 %), clearance between links "
        "(0.01 m), floor that nothing may touch; see `sysid-bench help optimised`.",
        default={}, flags="--set", metavar="KEY=VALUE", several=True, parse=_settings_of,
    )  # fmt: skip
    iterations: int | None = option(
        "Iterations of the search. Default: 150.", default=None, least=1
    )
    starts: int | None = option("Starts of the search. Default: 1.", default=None, least=1)
    gains: Mapping[str, Sequence[float]] = option(
        "Task actuators: gains of the position controller (N m/rad, N m s/rad); one number for all "
        "joints, or one each. Default: those of the model's actuators, else assumed ones.",
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
        from sysid_bench.commands.task_terms import verb_of_task
        from sysid_bench.commands.terminal import print_result
        from sysid_bench.experiments.tasks.task import find_task

        own = verb_of_task(find_task(self.task), "excite")
        request = self._of_motion() if own is None else own(self)
        with self.progress() as on_value:
            result = request.design(on_value)
        print_result(result, as_json)
        if result.interrupted:
            return INTERRUPTED
        return FAILED if result.violations else OK

    def settings_given(self) -> dict[str, Any]:
        """Settings of the excitation `optimised` that stand on the line."""
        from sysid_bench.excitation.optimised import Optimised
        from sysid_bench.plugin_names import plugin_settings

        names = ("period", "harmonics", "family", "joints", "margin", "iterations", "starts")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return given | plugin_settings("excitation 'optimised'", Optimised, self.others)

    def _of_motion(self) -> ExciteRequest:
        if self.gains:
            raise UsageError(
                f"--gain: for --task {ACTUATORS} alone, whose robots are position-commanded."
            )
        settings = self.settings_given() | ({"boxes": self.boxes} if self.boxes else {})
        motors = None if self.motor_types is None else parse_motors(self.motor_types)
        of_motion = {entry.name: getattr(self, entry.name) for entry in fields(ExciteRequest)}
        return ExciteRequest(**of_motion | {"settings": settings, "motors": motors})


class Design(Protocol[Designed]):
    """Request of a design, of a motion or of what a task has in its place."""

    def design(self, on_value: OnValue) -> Designed:
        """Design it; `on_value` is called during the search."""


@overload
def excite(request: str | Path, on_value: OnValue = ...) -> "ExciteResult": ...
@overload
def excite(request: Design[Designed], on_value: OnValue = ...) -> Designed: ...
def excite(request: Design[Any] | str | Path, on_value: OnValue = lambda count, value: None) -> Any:
    """Design a motion and write it to `request.out`; a robot alone stands for its default request.
    A CommandsRequest asks for commands of a position controller.

    `on_value` is called during the search. Raises UsageError for unknown names, UnsupportedError
    where no motion keeps the limits.
    """
    if isinstance(request, (str, Path)):
        request = ExciteRequest(request)
    return request.design(on_value)
