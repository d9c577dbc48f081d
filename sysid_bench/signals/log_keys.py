"""Keys of a log description as written, with their types, which pydantic checks; and presets: the
column names of common recorders, as data."""

from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from sysid_bench.errors import UsageError, unknown_name, value_errors
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.units import quantity

SIGNALS: Final = ("q", "v", "tau")

COMMANDED: Final = ("q_ref", "v_ref")
"""Signals of the commanded motion, which are read where a controller is declared."""

TOLD: Final = ("q_des", "v_des", "feedforward", "kp", "kd", "magnitude")
"""Signals of a position controller, which are read where its torque replaces the measured one; the
last one is a check alone."""

BASE: Final = (
    *("orientation", "position", "velocity"),
    *("angular_velocity", "acceleration", "accelerometer"),
)
"""Signals of the motion of a floating base."""


GAIN_ADVICE: Final = (
    "write gain = [...] in N m/A (N/A), the torque constant of the data sheet, and ratio = [...] "
    "where it is the motor's; or weigh a known load with gain = 1.0, which is taken as stated: its "
    "mass over the one that --task payload finds is the gain"
)
"""Ways to the gain of a current."""


def _one_or_more(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


def _columns(value: Any) -> Any:
    return {"columns": value} if isinstance(value, (str, int, list)) else value


def _gains(value: Any) -> Any:
    """Names are columns, numbers are gains."""
    names = value if isinstance(value, (list, tuple)) else [value]
    if names and all(isinstance(name, str) for name in names):
        return {"columns": value}
    return value if isinstance(value, (Mapping, BaseModel)) else _one_or_more(value)


_Several = BeforeValidator(_one_or_more)
_Column = Annotated[int | str, Field(union_mode="left_to_right")]


def _matrix(value: Any) -> Any:
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        raise ValueError("must be a list of rows, [[1, 0], [1, 1]]")
    return tuple(tuple(row) for row in value)


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True, strict=True)


class Time(_Table):
    """Column of time stamps, or several that are added up, such as seconds and nanoseconds."""

    column: Annotated[tuple[_Column, ...], _Several]  # name or index from 1
    unit: Annotated[tuple[str, ...], _Several] = ("s",)  # of each column
    file: str | None = None  # file of the stamps, where it is another
    reader: str | dict[str, Any] | None = None  # reader of that file


def _time(value: Any) -> Any:
    return value if isinstance(value, (Mapping, Time)) else {"column": value}


_TimeKey = Annotated[Time | None, BeforeValidator(_time)]


class Signal(_Table):
    """Columns of one signal, in the order of `joints`; one number of a setting serves all joints.

    q, v = raw unit gain / ratio + offset; tau = raw unit gain ratio + offset (`gain`, `ratio`,
    `offset`), the offset in SI and in the joint's coordinate. Instead of `columns`, `match`: a
    regular expression of their names, in the order of the number that its group finds, or of the
    joint that each names. `resample`: at stamps of another file the signal is interpolated
    ("linear"), or holds its last value ("previous": commands). `unwrap`: angles jump by a turn of
    the encoder, which is added again.
    """

    columns: Annotated[tuple[_Column, ...], _Several] = ()  # names, or indices from 1
    match: str | None = None  # regular expression of the names instead
    unit: Annotated[tuple[str, ...], _Several] | None = None
    """Of the columns: rad, deg, m, N m, A, ...; default: SI."""
    gain: Annotated[tuple[float, ...], _Several] = (1.0,)  # factor of the unit
    ratio: Annotated[tuple[float, ...], _Several] = (1.0,)  # gear ratio
    offset: Annotated[tuple[float, ...], _Several] = (0.0,)  # in SI units, of the joint
    file: str | None = None  # where this signal has a file of its own
    reader: str | dict[str, Any] | None = None  # of that file
    time: _TimeKey = None  # stamps of its own, where that file has another clock
    per_row: Annotated[int, Field(gt=0)] | None = None  # of a file with one number a line
    resample: Literal["linear", "previous"] = "linear"  # at stamps of another file
    unwrap: bool = False  # whether jumps by a turn are taken out

    @model_validator(mode="after")
    def _names_columns_once(self) -> "Signal":
        if bool(self.columns) == bool(self.match):
            raise ValueError("needs columns = [...], or match = '...' instead")
        return self


_Commanded = Annotated[Signal, BeforeValidator(_columns)]
_Gains = Annotated[
    tuple[float, ...] | Signal, Field(union_mode="left_to_right"), BeforeValidator(_gains)
]


class PositionControl(_Table):
    """Torque of a position controller, where none is measured:
    tau = kp (q_des(t - delay) - q) + kd (v_des(t - delay) - v) + feedforward(t - delay).

    Commands are held: from one sample, or period of `rate`, to the next. Gains in N m/rad and
    N m s/rad, or N/m and N s/m: one for all joints, one each, or columns where they change.
    `limit`: largest torque (N m, N). `motor`: names of tables (`list motors`), one for all or one
    each, "" for another: their peak torque where no limit is stated, their line of torque over
    speed, and their armature as a prior. `delay`: a time, or "profile": unknown.
    """

    q_des: _Commanded  # commanded positions
    v_des: _Commanded | None = None  # commanded rates
    feedforward: _Commanded | None = None  # commanded torques
    magnitude: _Commanded | None = None  # sizes of currents or torques without sign: a check
    kp: _Gains  # position gains
    kd: _Gains  # rate gains
    delay: str | float = 0.0
    limit: Annotated[tuple[float, ...], _Several] | None = None
    motor: Annotated[tuple[str, ...], _Several] | None = None
    rate: str | float | None = None

    @property
    def signals(self) -> dict[str, Signal]:
        """Signals that are columns of a file, by name."""
        parts = {name: getattr(self, name) for name in TOLD}
        return {name: part for name, part in parts.items() if isinstance(part, Signal)}


def _fraction(value: Any) -> Any:
    """Return the number of "10 %"; anything but a text as it is."""
    if not isinstance(value, str):
        return value
    try:
        return quantity(value, "1")
    except UsageError as error:
        raise ValueError(str(error).rstrip(".")) from error


def _shares(value: Any) -> Any:
    values = tuple(map(_fraction, _one_or_more(value)))
    if not all(isinstance(x, float) and 0 < x < 1 for x in values):
        raise ValueError(f"must be shares between 0 and 1, as 0.02 or '2 %'; got {value!r}")
    return values


class Torque(Signal):
    """Measured torque, or `pd` in place of its columns: that of a position controller."""

    is_recorded: ClassVar[bool] = True
    gain_std: Annotated[tuple[float, ...], BeforeValidator(_shares)] = ()
    """Standard uncertainty of the gains: one factor for all joints, or one each; "2 %"."""
    pd: PositionControl | None = None

    @model_validator(mode="after")
    def _names_columns_once(self) -> "Torque":
        if (
            self.is_recorded
            and [bool(self.columns), bool(self.match), self.pd is not None].count(True) != 1
        ):
            raise ValueError(
                "needs columns = [...], match = '...', or pd = { q_des = ..., kp = ..., "
                "kd = ... } where no torque was measured"
            )
        others = self.model_fields_set - {"pd"}
        if self.pd is not None and others:
            raise ValueError(f"pd stands alone; leave {', '.join(sorted(others))} out")
        return self


class NoTorque(Torque):
    """Of a recording without torques, whose force/torque sensor is used alone."""

    is_recorded: ClassVar[bool] = False


class Wrench(Signal):
    """Six columns of a force/torque sensor, in the axes of its frame and about its origin.

    The wrench is that which the carrying part exerts on what is distal to the sensor: where a
    driver reports the reaction, `gain` = -1. Gains and offsets are one for all, or six in the order
    of the columns; `unit` likewise.
    """

    sensor: str  # name of the manifest, or a fixed joint, site or body to cut at
    first: Literal["force", "moment"] = "force"  # which three columns come first


class Base(_Table):
    """Recorded motion of a floating base, which the task `actuators` takes as given. Rates that are
    not recorded are differences of the pose; without any of position, velocity and acceleration its
    origin moves uniformly."""

    orientation: _Commanded  # quaternion from the base to the world
    order: Literal["wxyz", "xyzw"] = "wxyz"  # of the columns of the quaternion
    position: _Commanded | None = None  # of its origin in the world
    velocity: _Commanded | None = None  # of its origin, in axes of the world
    angular_velocity: _Commanded | None = None  # in its own axes, as of a gyroscope
    acceleration: _Commanded | None = None  # of its origin, in axes of the world
    accelerometer: _Commanded | None = None
    """Acceleration of its origin less gravity, in its own axes; in place of `acceleration`."""

    @model_validator(mode="after")
    def _has_one_acceleration(self) -> "Base":
        if self.acceleration is not None and self.accelerometer is not None:
            raise ValueError("write acceleration or accelerometer, not both")
        return self

    @property
    def signals(self) -> dict[str, Signal]:
        """Recorded signals by name."""
        parts = {name: getattr(self, name) for name in BASE}
        return {name: part for name, part in parts.items() if part is not None}


def _wrenches(value: Any) -> Any:
    return value if isinstance(value, (list, tuple)) or value is None else (value,)


class Source(_Table):
    """One of several files of a recording, with its own clock: `offset` is added to its stamps."""

    file: str  # path, relative to this file
    reader: str | dict[str, Any] | None = None
    """Name or table of the reader; default: by the suffix."""
    time: _TimeKey = None  # its own stamps
    offset: str | float = 0.0


class ControllerKeys(_Table):
    """Gains of the robot's controller, tau = kp (q_ref - q) + kd (v_ref - v), one for all joints or
    one each: N m/rad and N m s/rad, N/m and N s/m, on the joint side. `rate`: a multiple of the
    log's. `held`: the torque is held between the samples of the controller."""

    kp: Annotated[tuple[float, ...], _Several]  # position gains
    kd: Annotated[tuple[float, ...], _Several]  # rate gains
    rate: str | float | None = None
    held: bool = False


def _files(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    return tuple({"file": one} if isinstance(one, str) else one for one in value)


class LogKeys(_Table):
    """Keys of the file as written."""

    file: Annotated[
        str | Annotated[tuple[Source, ...], Field(min_length=1)] | None, BeforeValidator(_files)
    ] = None
    """Path, or a list of files that are joined."""
    reader: str | dict[str, Any] | None = None
    """Name or table of the reader; default: by the suffix."""
    rate: str | float | None = None  # sampling rate, where there is no `time`
    time: _TimeKey = None  # column of stamps, or a table
    period: str | float | None = None  # where the motion repeats
    joints: Annotated[tuple[str, ...], _Several]
    """Joints of the columns in their order; "-": none of the model."""
    q: Signal  # positions
    v: Signal | None = None  # rates
    tau: Torque  # torques, or currents with their gains
    wrench: Annotated[tuple[Wrench, ...], Field(strict=False), BeforeValidator(_wrenches)] = ()
    """Force/torque sensors; with one, torques may be absent."""
    base: Base | None = None  # recorded motion of a floating base
    q_ref: Signal | None = None  # commanded positions
    v_ref: Signal | None = None  # commanded rates
    controller: ControllerKeys | None = None  # gains of the robot's controller
    transmission: Annotated[tuple[tuple[float, ...], ...], BeforeValidator(_matrix)] | None = None
    """Matrix G of q = G q_motor, tau_motor = G' tau."""
    payload: str | dict[str, Any] | None = None  # what was mounted: a name or a table
    rows: tuple[int, int] | None = Field(default=None, strict=False)
    """First and last row that are read."""
    share: Annotated[float, BeforeValidator(_fraction), Field(gt=0, le=1)] = 1.0
    """First part of the rows that is read, 0.1 or "10 %"."""
    serial: str | None = None
    """Which of several robots of one type was recorded."""
    locked: dict[str, float] = Field(default_factory=dict)
    """Position of joints that did not move, rad or m."""


_MISSING: Final = {
    "tau": (
        ": write tau = { columns = [7, 8], unit = 'N m' } with the columns of the torques, unit = "
        "'A' and gain for currents; or, of commands and positions alone, tau = { pd = { q_des = { "
        "columns = [9, 10] }, kp = [..], kd = [..] } } with the gains of the position controller"
    )
}
"""Way on from a missing key."""


def check_keys(text: Mapping[str, Any], source: Path, advice: str = "") -> LogKeys:
    """Return the keys once their names and types fit; raises UsageError with all mistakes, and
    `advice` where a signal is missing."""
    absent = "wrench" in text and "tau" not in text
    try:
        return LogKeys.model_validate({**text, "tau": NoTorque()} if absent else text)
    except ValidationError as error:
        lines, values = [], []
        for problem in error.errors():
            key = ".".join(map(str, problem["loc"]))
            if problem["type"] == "extra_forbidden":
                unknown = unknown_name("key of a log description", key, _known_keys(problem["loc"]))
                lines.append(str(unknown).rstrip("."))
            elif problem["type"] == "missing":
                lines.append(f"{key} is missing{_MISSING.get(key, '')}")
            else:
                values.append(problem)
        lines += [f"{key}: {text}" for key, text in value_errors(values).items()]
        raise UsageError(f"{source}: {'; '.join(dict.fromkeys(lines))}.{advice}") from error


def _known_keys(path: tuple[Any, ...]) -> set[str]:
    """Return the keys of the table in which a key stands, with the place of the table."""
    if len(path) == 1:
        return {*LogKeys.model_fields, "preset"}
    tables: dict[Any, type[BaseModel]] = {
        "time": Time,
        "tau": Torque,
        "file": Source,
        "controller": ControllerKeys,
        "wrench": Wrench,
        "base": Base if len(path) == 2 else Signal,
    }
    table, place = Time if path[-2] == "time" else tables.get(path[0], Signal), path[:-1]
    if path[:2] == ("tau", "pd"):
        table = PositionControl if len(path) == 3 else Signal
    else:
        # The number of a file or a sensor in a list is not part of the key.
        place = tuple(part for part in place if isinstance(part, str))
    return {".".join(map(str, (*place, key))) for key in table.model_fields}


@cache
def preset_keys() -> dict[str, dict[str, Any]]:
    """Return the presets by name."""
    return parse_toml(read_text(Path(__file__).with_name("log_preset.toml")))


def with_preset(text: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Return the keys of a description, completed by those of its preset.

    Raises UsageError for an unknown preset.
    """
    given = dict(text)
    name = given.pop("preset", None)
    if name is None:
        return given
    if name not in preset_keys():
        raise UsageError(f"{source}: {unknown_name('preset', str(name), preset_keys())}")
    keys = {k: x for k, x in preset_keys()[name].items() if k not in ("title", "needs", "desired")}
    if "rate" in given:
        keys.pop("time")
    for key, value in given.items():
        before, keys[key] = keys.get(key), value
        # Of a signal the description replaces single keys.
        tables = isinstance(before, Mapping) and isinstance(value, Mapping)
        if before is not None and tables and key in (*SIGNALS, *COMMANDED):
            left_out = ("match",) if "columns" in value else ()
            keys[key] = {**{k: x for k, x in before.items() if k not in left_out}, **value}
    return keys


def find_preset(names: Collection[str]) -> str | None:
    """Return the preset whose columns a file has, None without one."""
    fitting = (name for name, keys in preset_keys().items() if set(keys["needs"]) <= set(names))
    return next(fitting, None)


def preset_note(names: Collection[str]) -> str:
    """Return a sentence that proposes the preset whose columns a file has, "" without one."""
    name = find_preset(names)
    if name is None:
        return ""
    return f" Its columns are those of {preset_keys()[name]['title']}: write preset = {name!r}."
