"""Verbs as commands of click: their options from requests, errors, exit codes, help."""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from functools import partial, wraps
from inspect import getdoc
from pathlib import Path
from types import NoneType
from typing import Any, Final, get_args, get_type_hints

import click
from click.core import ParameterSource

from sysid_bench.commands.completion import completer
from sysid_bench.commands.request import INTERRUPTED, OK, USAGE, Option, Request, spec_of
from sysid_bench.commands.worker_execute import supervise
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.harness.work.interrupt import default_interrupt, on_interrupt, without_interrupt
from sysid_bench.units import quantity

_INTERRUPTION: Final = "Interrupted; the same command starts again, and a run goes on where it was."
_PATHS: Final[Mapping[str, Mapping[str, Any]]] = {
    "file": {"exists": True, "dir_okay": False},
    "folder": {"exists": True, "file_okay": False},
    "new folder": {"file_okay": False},
    "new file": {"dir_okay": False},
    "any": {"exists": True},
    "new": {},
}
"""Required kind of an option's path; others need not exist."""
_HELP: Final = ("-h", "--help")
HELP_ALL: Final = "--help-all"
_JSON: Final = "as_json"
GRAVITY: Final = "sysid_bench.gravity"
"""Key of the gravity on the command line in the data of click's contexts."""
MODELS: Final = "robots files"
"""Completion of the fields that name a model."""
_MODELS: Final = "basis crosscheck diagnose excite frames identify lint record robot twin"
_REMOVED: Final = {
    "--assets": (_MODELS, "write it behind the file, 'arm.xml?assets=meshes'"),
    "--tool": (_MODELS, "write it behind the file, 'arm.urdf?tool=upper'"),
    "--free-base": (_MODELS, "write it behind the file, 'arm.urdf?free_base=true'"),
    "--robots": ("lint frames diagnose twin log record show check-plugin", "name the robot's file"),
    "--json-out": ("diagnose", "use --json > FILE"),
    "--derivatives": (
        "identify",
        "use signals of a suite, or derivatives= of sysid_bench.identify",
    ),
    "--moving": ("identify", "use signals of a suite, or moving= of sysid_bench.identify"),
    "--cycles": ("excite", "use --set cycles=2"),
    "--torque-share": ("excite", "use --set torque_share=0.5"),
    "--clearance": ("excite", "use --set clearance=0.02"),
    "--floor": ("excite", "use --set floor=0"),
    "--partial": ("gate", "use run --baseline"),
    "--force": ("estimator log robot suite", "remove the file first"),
    "--all": ("list", "pipe the list, | less"),
    "--zero": ("basis", "use zero= of sysid_bench.paper_table"),
    "--values": ("basis", "use values= of sysid_bench.paper_table"),
    "--memory": ("survey", "use memory= of sysid_bench.SurveyRequest"),
    "--title": ("survey", "a report has the title of its source"),
    "--methods": ("transfer", "use methods= of sysid_bench.transfer"),
    "--levels": ("transfer", "use levels= of sysid_bench.transfer"),
}
"""Options of earlier versions: verbs that had them, and what to do in their place."""
_BEFORE: Final = {"--confidence": "--confidence 0.9", "--gravity": "--gravity 0,0,-9.81"}
"""Options of all verbs, with an example of each."""


# --- A command from a request -------------------------------------------------------------------


def click_command(request: type[Request[Any]], name: str) -> click.Command:
    """Return the command of a verb: options and arguments are the fields of its request."""
    types = get_type_hints(request)
    specs = {entry.name: spec for entry in fields(request) if (spec := spec_of(entry)) is not None}
    shown = [entry for entry in fields(request) if entry.name in specs]
    params = [_param(entry, types[entry.name], specs[entry.name]) for entry in shown]
    if request.has_json:
        params.append(click.Option(["--json", _JSON], is_flag=True, help="Print JSON."))
    return _Verb(
        name,
        callback=report_errors(partial(_execute, request, specs)),
        params=params,
        help=getdoc(request),
        conditions={key: spec.when for key, spec in specs.items() if spec.when},
    )


def _param(entry: Field[Any], annotation: Any, spec: Option) -> click.Parameter:
    """Option or argument of a field."""
    words: dict[str, Any] = {"type": _click_type(annotation, spec), "metavar": spec.metavar}
    if spec.complete:
        words["shell_complete"] = completer(spec.complete, spec.separated)
    if spec.is_argument:
        nargs = -1 if spec.several else 1
        return click.Argument([entry.name], required=spec.required, nargs=nargs, **words)
    default = None if entry.default is MISSING else entry.default
    if bool in (annotation, *get_args(annotation)):
        words = {"is_flag": True, "default": default}
    elif spec.several:
        words["multiple"] = True
    elif spec.shown:
        # What stands here is printed alone: an option that is not given leaves its field out.
        words |= {"default": default if spec.shown is True else spec.shown, "show_default": True}
    if entry.default is entry.default_factory is MISSING:
        words["required"] = True
    flags = spec.flags.split() or [f"--{entry.name.replace('_', '-')}"]
    made = _Option([*flags, entry.name], **words)
    made.words = spec.help
    return made


def _click_type(annotation: Any, spec: Option) -> "click.ParamType[Any]":
    kinds = {annotation, *get_args(annotation)} - {NoneType}
    if spec.choices:
        return click.Choice(spec.choices)
    is_path = Path in kinds and str not in kinds and spec.parse is None
    if is_path or spec.path is not None:
        return click.Path(path_type=Path, **_PATHS[spec.path or "new"])
    if spec.unit is not None or spec.parse is not None:
        return click.STRING
    if kinds & {int, float}:
        return _number_type(float not in kinds, spec.least)
    return click.STRING


def _number_type(whole: bool, least: float | None) -> "click.ParamType[Any]":
    if least is None:
        return click.INT if whole else click.FLOAT
    return click.IntRange(min=int(least)) if whole else click.FloatRange(min=least)


class _Option(click.Option):
    """Option whose help may be made when it is printed."""

    words: str | Callable[[], str] = ""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        self.help = self.words if isinstance(self.words, str) else self.words()
        return super().get_help_record(ctx)


def _execute(request: type[Request[Any]], specs: Mapping[str, Option], **values: Any) -> int:
    """Make the request of what stands on the line, and run it; return the exit code."""
    as_json = bool(values.pop(_JSON, False))
    context = click.get_current_context()
    given = {
        key: _value(specs[key], value)
        for key, value in values.items()
        # Only what was typed: the defaults of the request hold, whatever help prints as one. Click
        # 8.2 takes absent arguments for typed ones.
        if context.get_parameter_source(key) is not ParameterSource.DEFAULT and value != ()
    }
    if gravity := context.meta.get(GRAVITY):
        given |= _with_gravity(specs, given, gravity)
    asked = request(**given)
    code = supervise(asked.plugins(), asked.progress)
    return asked.shell(as_json) if code is None else code


def _with_gravity(
    specs: Mapping[str, Option], given: Mapping[str, Any], gravity: str
) -> dict[str, Any]:
    """The models on the line with this gravity; raise UsageError where there is none."""
    from sysid_bench.models.sources import with_settings  # which no other command waits for

    names = [key for key in given if specs[key].complete == MODELS]
    if not names:
        raise UsageError(
            "--gravity has a use where a robot or a model file stands on the line; in a suite, "
            "write use = 'arm.urdf?gravity=0,0,-9.81'."
        )

    def turned(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(turned, value))
        return with_settings(str(value), {"gravity": gravity})

    return {name: turned(given[name]) for name in names}


def _value(spec: Option, value: Any) -> Any:
    """Value of a field from what click has read."""
    if spec.unit is not None:
        return quantity(value, spec.unit)
    return value if spec.parse is None else spec.parse(value)


# --- Help ---------------------------------------------------------------------------------------


class _Verb(click.Command):
    """Command whose help shows the options that have a use with those that stand on the line."""

    def __init__(self, *args: Any, conditions: Mapping[str, Sequence[str]], **words: Any) -> None:
        super().__init__(*args, **words)
        self.conditions = conditions
        self._line: Sequence[str] | None = None  # None: all options

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Before parsing: `identify --log --help` gives --log no value.
        if HELP_ALL in args or any(word in args for word in _HELP):
            self._line = None if HELP_ALL in args else tuple(args)
            click.echo(self.get_help(ctx), color=ctx.color)
            ctx.exit()
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            verbs, advice = _REMOVED.get(error.option_name, ("", ""))
            if ctx.info_name in verbs.split():
                word = f"{error.option_name} is not an option of this command any more: {advice}."
                raise click.UsageError(word, ctx) from error
            if example := _BEFORE.get(error.option_name):
                word = f"{error.option_name} stands before the verb: sysid-bench {example} VERB ..."
                raise click.UsageError(word, ctx) from error
            raise

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        options = (one for one in self.get_params(ctx) if isinstance(one, click.Option))
        shown = [param for param in options if self._has_use(str(param.name))]
        rows = [row for param in shown if (row := param.get_help_record(ctx)) is not None]
        if self.conditions:
            rows.append((HELP_ALL, "Show all options and exit."))
        with formatter.section("Options"):
            formatter.write_dl(rows)
        hidden = dict.fromkeys(
            text
            for name, texts in self.conditions.items()
            if not self._has_use(name)
            for text in texts
        )
        if hidden:
            formatter.write_paragraph()
            formatter.write_text(
                f"More options have a use with {', '.join(hidden)}: name it before --help."
            )

    def _has_use(self, name: str) -> bool:
        """True for an option without condition, and for one whose condition is on the line."""
        if self._line is None or name not in self.conditions:
            return True
        line = f" {' '.join(self._line)} "
        return any(
            re.search(rf" {re.escape(text).replace(chr(92) + ' ', '[ =]')}[ =]", line)
            for text in self.conditions[name]
        )


# --- Errors and exit codes ----------------------------------------------------------------------


def report_errors(function: Callable[..., int]) -> Callable[..., None]:
    """Run a command and exit with its code; our errors become one paragraph and code 2."""

    @wraps(function)
    def guarded(*args: Any, **options: Any) -> None:
        context = click.get_current_context()
        with on_interrupt(default_interrupt):
            try:
                code = _exit_code(partial(function, *args, **options), context)
            except KeyboardInterrupt:  # a second one, while the first was reported
                without_interrupt()
                code = INTERRUPTED
        context.exit(code)

    return guarded


def _exit_code(command: Callable[[], int], context: click.Context) -> int:
    """Exit code of a command; an error is printed. An interrupted one ignores further signals."""
    try:
        code = command()
    except KeyboardInterrupt:
        without_interrupt()
        click.echo(_INTERRUPTION, err=True)
        code = INTERRUPTED
    except BrokenPipeError:  # the reader of our output has closed it, as `head` does
        # Python would complain of the closed pipe once more when it flushes at its end.
        sys.stderr.close()
        code = OK
    except (SysidBenchError, OSError) as error:
        if context.find_root().obj:  # --debug
            raise
        text = str(error)
        if isinstance(error, OSError):
            text = (
                f"{error.filename or 'a file'}: {error.strerror or error}; choose a folder that "
                "can be written (-o), on a disk with free space."
            )
        click.echo(f"sysid-bench: {text}", err=True)
        code = USAGE
    if code == INTERRUPTED:
        without_interrupt()
    return code
