"""All pages of the reference by their names: verbs, keys, plug-ins, words, functions, results."""

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import import_module
from typing import Any, Final

import click

from sysid_bench import types
from sysid_bench.commands.catalogue import WORDS, entries_of_kind, plugin_entry
from sysid_bench.commands.result import HIDDEN, Result
from sysid_bench.harness.suite.model import Suite
from sysid_bench.metrics import METRICS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.package_folders import plant_files
from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.reference.keys import FILES, key_tables, keys_page
from sysid_bench.reference.page import Section, Table, code, markdown_line, markdown_text
from sysid_bench.words import CELL_FIELDS, STATUSES

PLUGINS: Final[Mapping[str, tuple[str, Mapping[str, str]]]] = {
    "estimators": ("Estimators", {"estimator": "Estimators"}),
    "excitations": ("Excitations", {"excitation": "Excitations"}),
    "tasks": ("Tasks", {"task": "Tasks"}),
    "terms": ("Joint terms, and features in their place", {"term": ""}),
    "plants": (
        "Plant effects, model errors, sensor errors, simulations",
        {
            "plant": "Plant effects",
            "model_error": "Model errors",
            "sensor_error": "Sensor errors",
            "simulation": "Simulations",
        },
    ),
    "log-readers": (
        "Log readers, pipelines",
        {"log_reader": "Log readers", "pipeline": "Pipelines"},
    ),
    "executors": ("Executors", {"executor": "Executors"}),
}
"""Pages of plug-ins: title, and the heading of each kind, of several one after the other."""
_WORD_PAGES: Final[Mapping[str, str]] = {
    "filters": "Filters",
    "integrators": "Integrators",
    "statistics": "Statistics of tables",
    "intervals": "Intervals of tables",
    "statuses": "Statuses of a cell",
}
"""Titles of the pages of words that are not plug-ins; the words `terms` stand with features."""


def pages(group: click.Group) -> Mapping[str, Callable[[], Section]]:
    """Return the functions that make the pages of the reference; `group` has the verbs."""
    return {
        "index": _index,
        "commands": partial(_commands_page, group),
        **{name: partial(keys_page, name) for name in FILES},
        "conditions": _conditions,
        **{name: partial(_plugin_page, name) for name in PLUGINS},
        **{name: partial(_words_page, name) for name in _WORD_PAGES},
        "payloads": _payload_page,
        "metrics": _metrics_page,
        "python": _package_page,
        "json": _result_page,
    }


def title_by_page() -> Mapping[str, str]:
    """Return the title of each page but the index; no plug-in is imported for it."""
    return {
        "commands": "Verbs and options",
        **{name: title for name, (title, _) in FILES.items()},
        "conditions": "Conditions on cells",
        **{name: title for name, (title, _) in PLUGINS.items()},
        **_WORD_PAGES,
        "payloads": "Payloads",
        "metrics": "Metrics",
        "python": "Python API",
        "json": "JSON of results",
    }


def _index() -> Section:
    titles = title_by_page().items()
    rows = [(f"[{name}]({name}.md)", markdown_line(title)) for name, title in titles]
    return Section("# Reference", "Made from the code.", Table(("page", "about"), rows))


def _conditions() -> Section:
    """Fields that conditions on cells may name."""
    fields = [(code(name),) for name in sorted(CELL_FIELDS)]
    with_conditions = (
        code(table.heading)
        for table in key_tables(Suite)
        if {"select", "when"} & set(table.model.model_fields)
    )
    return Section(
        "# Conditions on cells",
        "`--select`, `when` and `select` compare fields with values, joined by `and`, `or` and "
        '`not`: `robot == "panda" and noise.tau < 0.01`, `estimator in ["ols", "wls"]`. A setting '
        "of a plug-in is a field as well, as `estimator.weight`. Conditions on rows also take "
        "`status` and every [metric](metrics.md).",
        Table(("field of a cell",), fields),
        "`status` is one of " + ", ".join(map(code, STATUSES)) + ", see [statuses](statuses.md).",
        f"Tables of a suite that have conditions: {', '.join(with_conditions)}.",
    )


# --- Verbs --------------------------------------------------------------------------------------

PROGRAM: Final = "sysid-bench"
EXIT_CODES: Final[Mapping[int, str]] = {
    0: "ok",
    1: "a cross-check, a gate or a check failed, a recording contradicts its model, or merged "
    "results contradict each other",
    2: "wrong usage, suite or model, or rows cannot be stored",
    3: "a cell has another status than ok, unsupported, skipped, or an identified robot errs more "
    "than zero torque on its test (torque error above 1)",
    4: "nothing was selected or measured",
    5: "scheduler or workers of the executor are gone; the same command resumes the run",
    130: "interrupted; a run is resumed by the same command",
}
"""Meaning of the exit codes of all verbs."""


def commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield (name, command) of each verb, those of a group as "baseline save"."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield prefix + name, command
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix}{name} ")


def _commands_page(group: click.Group) -> Section:
    """Each verb with its usage, description and options, from its parser."""
    codes = [(str(number), markdown_line(text)) for number, text in EXIT_CODES.items()]
    parts = [Section("## Exit codes", Table(("code", "meaning"), codes))]
    for name, command in commands(group):
        context = click.Context(command, info_name=f"{PROGRAM} {name}")
        usage = " ".join([f"{PROGRAM} {name}", *command.collect_usage_pieces(context)])
        records = filter(None, (param.get_help_record(context) for param in command.params))
        rows = [(code(option), markdown_line(text)) for option, text in records]
        options = Table(("argument or option", "meaning"), rows)
        words = markdown_text(command.help or "")
        parts.append(Section(f"## `{name}`", f"```\n{usage}\n```", words, options))
    return Section("# Verbs and options", *parts)


# --- Plug-ins and words -------------------------------------------------------------------------

_NAME: Final = r"(?:(?:van der |de )?[A-Z][\w'-]+(?:,? and |, | & | )?)+"
_SOURCE: Final = re.compile(rf"({_NAME})\(?(\d{{4}})")
_ASSUMPTION: Final = re.compile("[Aa]ssum")
_COST: Final = re.compile(
    "losed form|program|Gauss-Newton|iterat|simulations per|QR|SVD|eigenval|Newton|sigma points"
)
_SENTENCE: Final = re.compile(r"(?<=\.)\s+(?=[A-Z`])")


def _plugin_page(page: str) -> Section:
    """The plug-ins of one or a few kinds: docstring, settings; of estimators what they read,
    formula, assumptions, source and cost as well."""
    title, kinds = PLUGINS[page]
    parts: list[str | Table | Section] = []
    if page == "plants":
        levels = [entry for entry in entries_of_kind("plants") if entry["name"] in plant_files()]
        rows = [(code(entry["name"]), markdown_line(entry["title"])) for entry in levels]
        parts.append(Section("## Realism levels", Table(("plant", "what"), rows)))
    parts.append(_words(page))
    if page == "estimators":
        lines = [
            (f"[{code(name)}](#{name})", _reads(name), markdown_line("; ".join(sources(name))))
            for name in BUILTIN["estimator"]
        ]
        parts.append(Table(("name", "reads", "source"), lines))
    for kind, heading in kinds.items():
        depth = "##" if len(kinds) == 1 else "###"
        found = [_plugin(kind, name, depth) for name in BUILTIN[kind]]
        parts += found if len(kinds) == 1 else [Section(f"## {heading}", *found)]
    return Section(f"# {title}", *parts)


def _plugin(kind: str, name: str, depth: str) -> Section:
    settings = plugin_entry({"kind": kind, "name": name})["settings"]
    rows = [
        (code(key), "" if value in (None, [], {}) else code(str(value)))
        for key, value in settings.items()
    ]
    return Section(
        f"{depth} {code(name)}",
        markdown_text(str(resolve(kind, name).__doc__ or "")),
        _estimator_facts(name) if kind == "estimator" else "",
        Table(("setting", "default"), rows),
    )


def _estimator_facts(name: str) -> Table:
    sentences = _SENTENCE.split(_flat_docstring(name))
    facts = {
        "Assumes": " ".join(filter(_ASSUMPTION.search, sentences)),
        "Bias": str(getattr(resolve("estimator", name), "bias", "")),
        "Not ranked": str(getattr(resolve("estimator", name), "frame_dependent", "")),
        "Reads": _reads(name),
        "Cost": " ".join(filter(_COST.search, sentences)),
        "Source": "; ".join(sources(name)),
    }
    rows = [(key, markdown_line(text)) for key, text in facts.items() if text]
    return Table(("property", "as documented"), rows)


def sources(name: str) -> list[str]:
    """Return the publications that the docstring of an estimator names, "Huber (1964)"."""
    found = _SOURCE.findall(_flat_docstring(name))
    return list(dict.fromkeys(f"{who.strip(' ,')} ({year})" for who, year in found))


def _flat_docstring(name: str) -> str:
    return " ".join(str(resolve("estimator", name).__doc__ or "").split())


def _reads(name: str) -> str:
    """Input of the method: `solve(problem)`, or `fit(experiment)`."""
    simulates = hasattr(resolve("estimator", name), "fit")
    return "signals, simulator" if simulates else "rows of the regressor"


def _words(page: str) -> Table:
    rows = [(code(word), markdown_line(text)) for word, text in WORDS.get(page, {}).items()]
    return Table(("word", "meaning"), rows)


def _words_page(page: str) -> Section:
    """The words of one kind that suites take, each with its meaning."""
    return Section(f"# {_WORD_PAGES[page]}", _words(page))


def _metrics_page() -> Section:
    """Every metric of rows and tables with its unit, direction and formula."""
    rows = [
        (
            code(metric.name), markdown_line(metric.title),
            markdown_line(" or ".join(metric.units)),
            metric.better or "", metric.level, markdown_line(metric.formula),
        )
        for metric in METRICS.values()
    ]  # fmt: skip
    header = ("field", "title", "unit in tables", "better", "one value per", "formula")
    return Section("# Metrics", Table(header, rows))


def _payload_page() -> Section:
    titles = {entry["name"]: entry["title"] for entry in entries_of_kind("payloads")}
    return Section("# Payloads", Table(("name", "what"), [(code(x), titles[x]) for x in PAYLOADS]))


# --- Python API and JSON ------------------------------------------------------------------------

_MODULES: Final = re.compile(
    r"\b(?:sysid_bench|collections|typing|pathlib|numpy|pandas)(?:\.\w+)*\."
)
_SHORT: Final = 88
"""Letters of a signature that stands on one line."""
_PACKAGE: Final = import_module("sysid_bench")
"""By name: it imports this page for `help`, and type checkers would see a cycle."""


def _package_page() -> Section:
    """The functions and classes of `sysid_bench` and of `sysid_bench.types`, from signatures and
    docstrings."""
    found = {f"sysid_bench.{name}": getattr(_PACKAGE, name) for name in package_names()}
    for name, thing in vars(types).items():
        if inspect.isclass(thing) and thing.__module__ == types.__name__:
            found[f"sysid_bench.types.{name}"] = thing
    parts = []
    for name, thing in found.items():
        call = f"class {name}" if inspect.isclass(thing) else _call(name, thing)
        text = markdown_text(thing.__doc__ or "")
        heading = f"## {code(name.rpartition('.')[2])}"
        parts.append(Section(heading, f"```python\n{call}\n```", text, _fields(thing)))
    return Section("# Python API", *parts)


def _result_page() -> Section:
    """The fields of each result, which are the keys of the command's JSON."""
    things = {name: getattr(_PACKAGE, name) for name in package_names()}
    parts = (
        Section(f"## {code(name)}", markdown_text(thing.__doc__ or ""), _fields(thing))
        for name, thing in things.items()
        if inspect.isclass(thing) and issubclass(thing, Result) and thing is not Result
    )
    return Section("# JSON of results", *parts)


def package_names() -> list[str]:
    """Return the public names of `sysid_bench`."""
    return [name for name in _PACKAGE.__all__ if not name.startswith("_")]


def _call(name: str, function: Any) -> str:
    """Signature, with a line per argument where it is long."""
    signature = inspect.signature(function)
    answer = plain_types(inspect.formatannotation(signature.return_annotation)).strip('"')
    # Written apart, since Python quotes a postponed type.
    inner = signature.replace(return_annotation=inspect.Signature.empty)
    line = f"{name}{plain_types(str(inner))} -> {answer}"
    if len(line) <= _SHORT:
        return line
    arguments: list[str] = []
    is_keyword = False
    for argument in signature.parameters.values():
        if argument.kind is inspect.Parameter.KEYWORD_ONLY and not is_keyword:
            arguments, is_keyword = [*arguments, "*"], True
        arguments.append(plain_types(str(argument)))
    return f"{name}(\n" + "".join(f"    {one},\n" for one in arguments) + f") -> {answer}"


def plain_types(text: str) -> str:
    """Return types without the modules that they come from, default functions without address."""
    return re.sub("<function .*? at 0x[0-9a-f]+>", "...", _MODULES.sub("", text)).replace("'", '"')


def _fields(thing: Any) -> Table:
    """Fields of a record that its JSON has, with their types as written."""
    rows = []
    fields = dataclasses.fields(thing) if dataclasses.is_dataclass(thing) else ()
    for field in fields:
        if HIDDEN.items() <= field.metadata.items():
            continue
        kind = field.type if isinstance(field.type, str) else inspect.formatannotation(field.type)
        rows.append((code(field.name), code(plain_types(kind))))
    return Table(("field", "type"), rows)
