"""Requests: what a verb is asked, declared once for the shell, Python, completion and reference.

A verb is a class whose fields carry their words:

    class Frames(Request["FramesResult"]):
        '''Print the forward kinematics.'''           # the help of the verb

        source: str = model("ROBOT|FILE")             # an argument of the shell
        at: Mapping[str, float] = option("Position of a joint.", default=None, ...)
        robots_dir: Path | None = robots_option()     # shared by many verbs

        def run(self) -> "FramesResult":
            '''Return the frames of a robot.'''       # the docstring of the Python function

    frames = python_function(Frames, "frames")

Fields without words are arguments of the Python function alone; fields of a class that is derived
for the shell are options of the shell alone. Modules of verbs import engines and libraries within
`run`, so that help and completion are quick.
"""

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Generic, ParamSpec, TypeVar, dataclass_transform

from sysid_bench.commands.values import parse_terms

P = ParamSpec("P")
R = TypeVar("R")

SPEC: Final = "option"
"""Key of the `Option` in the metadata of a field."""
OK, FAILED, USAGE, BAD_ANSWER, NOTHING, INTERRUPTED = 0, 1, 2, 3, 4, 130
"""Exit codes of verbs."""

OnValue = Callable[[int, float], None]
"""Listener of a search: number of evaluations, best value."""


@dataclass(frozen=True)
class Option:
    """Words of a field: an option of the shell, or with `is_argument` one of its arguments.

    `flags`: spellings; default: --name. `unit`: the text is a quantity, and the field its SI value.
    `parse`: text (several: texts) -> value. `path`: "file", "folder", or "any", which has to exist.
    `least`: smallest number. `shown`: default as help prints it. `complete`: kinds of its values
    (`completion.py`). `separated`: values are separated by commas. `when`: options, any of which
    has to stand on the line for this one to have a use, "--log" or "--task actuators"; help lists
    it there and with --help-all. `several`: given repeatedly.
    """

    help: str | Callable[[], str] = ""
    flags: str = ""
    metavar: str | None = None
    unit: str | None = None
    choices: tuple[str, ...] = ()
    parse: Callable[[Any], Any] | None = None
    path: str | None = None
    least: float | None = None
    shown: str | bool = False
    complete: str = ""
    separated: bool = False
    when: tuple[str, ...] = ()
    several: bool = False
    required: bool = True
    is_argument: bool = False


def option(
    help: str | Callable[[], str], *, default: Any = dataclasses.MISSING, **words: Any
) -> Any:
    """Field that is an option of the shell; `words` are those of `Option`."""
    return _field(default, Option(help, **words))


def argument(
    metavar: str, help: str = "", *, default: Any = dataclasses.MISSING, **words: Any
) -> Any:
    """Field that is an argument of the shell, required without a default; with `several` it takes
    all words that follow."""
    required = default is dataclasses.MISSING
    return _field(
        default, Option(help, metavar=metavar, required=required, is_argument=True, **words)
    )


def model(metavar: str, *, default: Any = dataclasses.MISSING, **words: Any) -> Any:
    """Argument that is a robot or a model file, or with `several` any number; settings of a model
    stand behind it, 'arm.urdf?tool=upper&free_base=true'."""
    return argument(metavar, default=default, **{"complete": "robots files", **words})


def _field(default: Any, spec: Option) -> Any:
    if isinstance(default, (dict, list)):
        # A fresh one for each request: dataclasses refuse a default that can be changed.
        return field(default_factory=default.copy, metadata={SPEC: spec})
    return field(default=default, metadata={SPEC: spec})


# --- Options of many verbs ----------------------------------------------------------------------


def robots_option() -> Any:
    """--robots, the folder of a user's own robots."""
    return option(
        "Folder of your own robots, <name>/robot.toml.",
        default=None, flags="--robots", path="folder", complete="folders",
    )  # fmt: skip


def task_option() -> Any:
    """--task, whose help lists the registered tasks when it is printed."""
    return option(_task_help, default="robot", shown=True, complete="tasks")


def _task_help() -> str:
    from sysid_bench.plugin_names import known  # entry points: 30 ms that no other verb waits for

    return f"{', '.join(known('task'))}; or your own, file:mine.py:Class."


def terms_option() -> Any:
    """--terms, joint terms that are unknown; None: those of the robot or the task."""
    return option(
        "Joint terms that are also unknown: viscous,coulomb,j1.k,...; or none.",
        default=None, parse=parse_terms, complete="terms", separated=True,
    )  # fmt: skip


def sensor_option() -> Any:
    """--sensor, a force/torque sensor of the manifest or a place to cut at."""
    return option(
        "Force/torque sensor: a name of the manifest, or a fixed joint, site or body to cut at.",
        default=None, metavar="NAME|PLACE",
    )  # fmt: skip


def free_base_option() -> Any:
    """--free-base of a verb that has the answer among the arguments of its Python function."""
    return option("Let the root body float.", default=None)


def logs_option(word: str, help: str, when: tuple[str, ...] = ()) -> Any:
    """`--log` or `--test`: descriptions of recordings, any number of them."""
    return option(
        help, default=(), flags=f"--{word}", path="new", metavar="LOG.toml", complete="files",
        several=True, when=when,
    )  # fmt: skip


# --- Requests -----------------------------------------------------------------------------------


@dataclass_transform(frozen_default=True, field_specifiers=(option, argument, model, field))
@dataclass(frozen=True)
class Request(Generic[R]):
    """Request of a verb. Derived classes are frozen dataclasses without saying so.

    The docstring of the class is the help of the verb, that of `run` the docstring of its Python
    function. Raises UsageError in `__post_init__` for fields that do not go together.
    """

    has_json: ClassVar[bool] = True
    """True where the shell takes --json."""

    def __init_subclass__(cls, **words: Any) -> None:
        super().__init_subclass__(**words)
        cls.__doc__ = inspect.getdoc(cls)  # that of the class above, where a shell class has none
        # Here, so that a verb is a class with fields and nothing else.
        dataclass(frozen=True, repr=False)(cls)

    def run(self) -> R:
        """Do it."""
        raise NotImplementedError

    def shell(self, as_json: bool) -> int:
        """Do it, print the result, return the exit code."""
        from sysid_bench.commands.terminal import print_result

        result = self.run()
        print_result(result, as_json)
        return self.exit_code(result)

    def exit_code(self, result: R) -> int:
        """Exit code of a result."""
        return OK

    def plugins(self) -> Iterable[tuple[str, str | None]]:
        """(kind, name) of the plug-ins that this runs; with a third-party one the shell executes
        it in a worker process."""
        return ()

    def progress(self) -> AbstractContextManager[OnValue]:
        """Listener of a search that runs in a worker process."""
        return nullcontext(lambda count, value: None)


def spec_of(entry: "dataclasses.Field[Any]") -> Option | None:
    """Words of a field; None for one of the Python function alone."""
    return entry.metadata.get(SPEC)


def python_function(request: Callable[P, Request[R]], name: str) -> Callable[P, R]:
    """Return the function of `sysid_bench` that runs a request of its arguments: its signature is
    that of the request, its docstring that of `run` and what the fields say."""

    def function(*args: P.args, **values: P.kwargs) -> R:
        return request(*args, **values).run()

    run = request.run  # type: ignore[attr-defined]
    answer = inspect.signature(run).return_annotation
    specs = [(entry.name, spec_of(entry)) for entry in dataclasses.fields(request)]  # type: ignore[arg-type]
    words = [
        f"`{key}`: {spec.help}"
        for key, spec in specs
        if spec and spec.help and isinstance(spec.help, str)
    ]
    function.__name__ = function.__qualname__ = name
    function.__module__ = request.__module__
    function.__doc__ = "\n\n".join(filter(None, (inspect.getdoc(run), " ".join(words))))
    signature = inspect.signature(request).replace(return_annotation=answer)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function
