"""Reading and writing of suite files; all mistakes are reported together."""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from itertools import chain
from pathlib import Path
from typing import Any, Final, get_args

from pydantic import BaseModel, ValidationError

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import LEVEL, confidence_level
from sysid_bench.experiments.simulated.composed_plant import plant_entries
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.experiments.third_party import log_reader_names, manifest_terms, term_names
from sysid_bench.harness.suite.checks import CheckInput, list_of
from sysid_bench.harness.suite.log_entries import DATASET, with_dataset
from sysid_bench.harness.suite.model import Origin, Suite
from sysid_bench.harness.suite.names import Names, default_names, no_names, static_names
from sysid_bench.harness.suite.plugin_entries import Plugin
from sysid_bench.harness.suite.toml_text import Key, key_lines, toml_line, toml_text
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.plugin_names import is_third_party, known
from sysid_bench.signals.log_description import log_description

HASHED: Final = "hashed"
"""Statement of a run whose rows all have a hash."""
_DEEPEST: Final = 30
"""Names in the key of a setting."""


def load_suite(
    path: Path, names: Names | None = None, overrides: Mapping[str, str] | None = None
) -> Suite:
    """Read the suite of a file; raises one UsageError with a line per mistake (`parse_suite`)."""
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsageError(f"The suite {str(path)!r} cannot be read: {why}.") from error
    return parse_suite(text, str(path), path.resolve().parent, names, overrides)


def parse_suite(
    text: str,
    file: str = "suite.toml",
    folder: Path | None = None,
    names: Names | None = None,
    overrides: Mapping[str, str] | None = None,
) -> Suite:
    """Read the suite of a TOML text; relative robots and plug-in files are found from `folder`.

    A frozen suite states its folder in [origin]. `overrides` are `--set` pairs. Without `names`,
    plug-ins are imported here, or, where this process has secret seeds, their source is read.
    Raises one UsageError with lines `file:line: key: value, possible values`.
    """
    data = _read(text, file)
    _check_kind(data, file)
    # Before the overrides: a mistake in one has the line of the nearest key of the file.
    known_lines = key_lines(text)
    if overrides:
        data = set_values(data, overrides)
    if folder is not None and "origin" not in data:
        # A frozen suite has its own: it must not move with the run folder.
        data["origin"] = {"folder": str(folder)}
    if confidence_level() != LEVEL:  # stated on the command line
        data["confidence"] = confidence_level()
    own = static_names() if os.environ.get(SEEDS) else default_names()
    return _validate(data, file, known_lines, names or own)


def parse_stored(text: str, file: str) -> Suite:
    """Read the suite of a run folder, whose names were checked when it was planned."""
    return _validate(_read(text, file), file, key_lines(text), no_names())


def set_values(suite: str | Mapping[str, Any], settings: Mapping[str, str]) -> dict[str, Any]:
    """Return the data of a suite with `--set` pairs: {"defaults.rate": '"100 Hz"'}.

    Values are TOML, or else strings. List elements go by number: "robot.0.use". The key "dataset"
    names the data sets of all [[log]] tables that have some, see `with_dataset`.
    """
    data = parse_toml(suite) if isinstance(suite, str) else dict(suite)
    for dotted, text in settings.items():
        value: Any = text
        with suppress(ValueError):
            parsed = parse_toml(f"value = {text}")
            # A text with a line end may hold further keys: it is a string as a whole then.
            value = parsed["value"] if len(parsed) == 1 else text
        if dotted == DATASET:
            data = with_dataset(data, list_of(value))
            continue
        path = dotted.split(".")
        if "" in path or len(path) > _DEEPEST:
            raise UsageError(
                f"--set {_short(dotted)}: a key has up to {_DEEPEST} names with one dot between "
                "them, as run.repeats or robot.0.use."
            )
        data = _put(data, path, value, dotted)
    return data


def _put(data: Any, path: list[str], value: Any, dotted: str) -> Any:
    """Return a copy of a table or list in which the value at a path is another."""
    if not path:
        return value
    head, *rest = path
    if isinstance(data, list) and head.isdigit() and int(head) < len(data):
        put = _put(data[int(head)], rest, value, dotted)
        return [*data[: int(head)], put, *data[int(head) + 1 :]]
    if not isinstance(data, Mapping):
        raise UsageError(
            f"--set {dotted}: there is no {head!r} to set in {_short(data)}; set the whole of it."
        )
    return {**data, head: _put(data.get(head, {}), rest, value, dotted)}


def suite_text(suite: Suite) -> str:
    """Return TOML that `parse_suite` reads as the same suite, with every default."""
    return toml_text(suite.model_dump(by_alias=True))


def _read(text: str, file: str) -> dict[str, Any]:
    try:
        # TOML and not YAML, which reads 10:30 as the number 630.
        return parse_toml(text)
    except ValueError as error:
        raise UsageError(f"{file}: not valid TOML: {error}.") from error


def _check_kind(data: Mapping[str, Any], file: str) -> None:
    """Raise UsageError for a file of another kind: it has keys, and those of a suite alone not."""
    if {"schema", "estimator"} & data.keys() or data.keys() <= Suite.model_fields.keys():
        return
    if "q" in data:
        raise UsageError(
            f"{file} describes a recording; it is not a suite: 'sysid-bench identify ROBOT --log "
            f"{file}' identifies a robot from it; a suite names it in [[log]]."
        )
    raise UsageError(
        f"{file} is not a suite: it has no schema and no [[estimator]], but {', '.join(data)}; "
        "'sysid-bench init suite' writes a first suite."
    )


def _validate(data: Mapping[str, Any], file: str, lines: Mapping[Key, int], names: Names) -> Suite:
    origin, defaults = data.get("origin"), data.get("defaults")
    folder = origin.get("folder") if isinstance(origin, Mapping) else None
    # "excitation.period", for every written setting, is a field of expressions.
    settings = set[str]()
    axes = dict(defaults) if isinstance(defaults, Mapping) else {}
    axes["estimator"] = data.get("estimator")
    for axis in ("plant", "excitation", "simulation", "pipeline", "estimator"):
        written = axes.get(axis)
        for spec in written if isinstance(written, list) else [written]:
            if isinstance(spec, Mapping):
                settings |= {f"{axis}.{key}" for key in spec if key != "label"}
    place = Path(folder) if isinstance(folder, str) else None
    context = CheckInput(names, place, frozenset(settings))
    try:
        # pydantic goes on behind a mistake: all of them are reported at once, with their places.
        return Suite.model_validate(data, context=context)
    except ValidationError as error:
        mistakes = [_mistake(problem, data, file, lines) for problem in error.errors()]
    # A sweep or default that is used twice has the same mistake twice.
    ordered = sorted(dict.fromkeys(mistakes), key=lambda entry: (entry[0] is None, entry[0] or 0))
    raise UsageError("\n".join(text for _, text in ordered))


def _mistake(
    problem: Any, data: Any, file: str, lines: Mapping[Key, int]
) -> tuple[int | None, str]:
    """Return line and text of a mistake."""
    key = _written_key(problem["loc"], problem["type"], data)
    line = toml_line(lines, key)
    location = f"{file}:{line}" if line else file
    dotted = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key)
    return line, f"{location}: {dotted.lstrip('.') or 'the whole file'}: {_message(problem, key)}"


def _written_key(loc: tuple[Any, ...], kind: str, data: Any) -> Key:
    """Return the location of pydantic without indices of one-value sweeps and tags of unions."""
    key: list[str | int] = []
    for position, part in enumerate(loc):
        if position == 2 and key[-1:] in (["terms"], ["held_out"]):
            is_sweep = isinstance(data, list) and all(isinstance(x, list) for x in data)
            if not data or not is_sweep:
                continue  # the index of the one value of a sweep whose values are lists
        if isinstance(data, list):
            is_there = isinstance(part, int) and part < len(data)
        else:
            is_there = isinstance(data, Mapping) and part in data
        is_missing = kind == "missing" and position == len(loc) - 1
        if is_there:
            data = data[part]
        elif not (is_missing and isinstance(data, Mapping)):
            continue
        key.append(part)
    return tuple(key)


def _message(problem: Any, key: Key) -> str:
    if problem["type"] == "extra_forbidden":
        model: type[BaseModel] = Suite
        for part in problem["loc"][:-1]:  # down to the table with the key
            keys = _keys(model)
            if part in keys:
                model = _model_in(keys[part]) or model
        known = sorted(_keys(model))
        near = get_close_matches(str(key[-1]), known, n=1, cutoff=0.5)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        got = _short(problem["input"])
        return f"unknown key (got {got}).{hint} There are: {', '.join(known)}."
    if problem["type"] == "missing":
        return "this key is missing, and it has no default."
    if problem["type"] == "tuple_type":
        return f"must be a list; got {_short(problem['input'])}."
    message = str(problem["msg"]).removeprefix("Value error, ")
    if problem["type"] == "value_error":
        return message
    return f"{message}; got {_short(problem['input'])}."


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _keys(model: type[BaseModel]) -> dict[str, Any]:
    """Return the type of each key of a table."""
    fields = model.model_fields.items()
    return {field.alias or name: field.annotation for name, field in fields}


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_model_in(argument) for argument in get_args(annotation))
    return next((model for model in inner if model is not None), None)


def with_rows(suite: Suite, *, hashed: bool) -> Suite:
    """The suite with the statement that rows of its run are hashed, or without it."""
    origin = suite.origin or Origin(folder=str(suite.folder))
    rows = HASHED if hashed else None
    return suite.model_copy(update={"origin": origin.model_copy(update={"rows": rows})})


def third_party_names(suite: Suite, robots_dir: Path | None = None) -> tuple[tuple[str, str], ...]:
    """Return (kind, name) of each third-party plug-in that a suite names, once each; `robots_dir`:
    folder of robots instead of the suite's own."""
    axes, folder = suite.defaults, robots_dir or suite.robots_folder
    own = ((plant.simulation, plant.pipeline) for plant in axes.plant)
    entries: Iterable[Plugin] = (
        *suite.estimator, *suite.metric, *axes.excitation, *chain.from_iterable(axes.held_out),
        *axes.simulation, *(axes.pipeline or ()), *filter(None, chain.from_iterable(own)),
        *chain.from_iterable(log.pipeline or () for log in suite.log),
    )  # fmt: skip
    used = [(entry.kind, entry.use) for entry in entries]
    for plant in axes.plant:
        used += [(kind, str(spec["use"])) for kind, spec in plant_entries(plant.spec)]
    used += [("task", task) for task in (*axes.task, *(log.task for log in suite.log))]
    for log in suite.log:
        used += term_names(chain.from_iterable(filter(None, (*log.terms, *log.choose))))
        used += manifest_terms(log.robot, folder, suite.folder)
        for written in (*log.train, *log.test):
            with suppress(UsageError):  # a frozen suite whose files are gone: reported by its cells
                used += log_reader_names(log_description(written, suite.folder))
    return tuple(dict.fromkeys(one for one in used if is_third_party(*one)))


def code_note(plugins: Iterable[tuple[str, str]]) -> str:
    """Return "runs code: file:x.py, mylab.methods"; empty without third-party plug-ins."""
    modules = (known(kind).get(name, name).rpartition(":")[0] for kind, name in plugins)
    text = ", ".join(dict.fromkeys(modules))
    return f"runs code: {text}" if text else ""
