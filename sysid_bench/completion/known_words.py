"""Verbs, options and the kinds of their values, from the parser and the registries."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from itertools import chain
from typing import Any, Final

import click

from sysid_bench import plugin_names
from sysid_bench.metrics import METRICS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.reference.pages import title_by_page
from sysid_bench.verbs.list_names import KINDS
from sysid_bench.verbs.runs.report import FORMATS
from sysid_bench.verbs.suite_words import WORDS
from sysid_bench.words import CELL_FIELDS, FINDINGS

VALUES: Final[Mapping[str, tuple[str, ...]]] = {
    "robot": ("robots", "files"),
    "robots": ("robots", "files"),
    "model": ("robots", "files"),
    "models": ("robots", "files"),
    "of": ("robots", "files"),
    "suite": ("suites", "files"),
    "run suite": ("suites", "runs", "files"),
    "run_folder": ("runs", "folders"),
    "runs": ("runs", "folders"),
    "submissions": ("runs", "folders"),
    "before": ("runs", "files"),
    "after": ("runs", "files"),
    "excite after": ("files",),
    "identifier": ("cells",),
    "what": ("cells",),
    "table name": ("tables",),
    "show name": ("robots", "suites", "datasets", "plants", "names"),
    "list kind": ("kinds",),
    "fetch name": ("datasets", "collections", "folders"),
    "source": ("collections", "folders"),
    "lint models": ("robots", "collections", "files"),
    "sets": ("datasets", "folders"),
    "methods": ("estimators",),
    "levels": ("plants",),
    "transfer truth": ("truths",),
    "check-plugin name": ("files",),
    "topic": ("topics", "names"),
    "shell": ("shells",),
    "estimator": ("estimators",),
    "task": ("tasks",),
    "payload": ("payloads",),
    "pipeline": ("pipelines",),
    "terms": ("terms",),
    "candidates": ("terms",),
    "metrics": ("metrics",),
    "sort": ("fields", "metrics"),
    "tolerances": ("metrics",),
    "executor": ("executors",),
    "accept": ("findings",),
    "filter_text": ("filters",),
    "prior": ("priors",),
    "form": ("formats",),
    "select": ("fields",),
    "show": ("fields", "metrics"),
    "record": ("fields",),
    "robots_dir": ("folders",),
}
"""Kinds of the values of an option or argument, by its name or by "verb name"."""

FREE: Final = frozenset((
    "also", "at", "base", "boxes", "clamp", "clearance", "contacts", "export", "family", "floor",
    "gains", "gravity", "joints", "limits", "margin", "massless", "memory", "motors", "name",
    "noise", "objective", "period", "rate", "sensor", "settings", "shard", "share", "shared",
    "timeout", "title", "tool", "torque_share", "zero",
))  # fmt: skip
"""Options whose values are the user's own."""

_LISTED: Final = ("show", "terms", "candidates", "metrics", "accept", "methods", "levels")
"""Options whose value is a list with commas."""


def known_words() -> dict[str, Any]:
    """Return the tree of the verbs, and the words that only an installation changes, by kind."""
    main = import_module("sysid_bench.cli").main
    plugins = {
        f"{kind.replace('_', '-')}s": sorted(plugin_names.known(kind))
        for kind in plugin_names.BUILTIN
    }
    words: dict[str, list[str]] = {
        **plugins,
        **{kind: list(words) for kind, words in WORDS.items()},
        "terms": [*WORDS["terms"], *plugins["terms"]],
        "metrics": sorted({*METRICS, *plugins["metrics"]}),
        "payloads": list(PAYLOADS),
        "executors": ["local", "dask://", "slurm:"],
        "findings": list(FINDINGS),
        "priors": ["model", "none"],
        "formats": list(FORMATS),
        "fields": sorted(CELL_FIELDS),
        "kinds": list(KINDS),
        "topics": list(title_by_page()),
        "shells": ["bash", "zsh", "fish"],
        "truths": ["wls", "lmi"],
    }
    named = (*plugins, *WORDS, "payloads")
    words["names"] = sorted({name for kind in named for name in words[kind]})
    return {"verb": _verb("", main), "words": words}


def _verb(name: str, command: click.Command) -> dict[str, Any]:
    params = command.get_params(click.Context(command))
    options = [one for one in params if isinstance(one, click.Option)]
    return {
        "title": command.get_short_help_str(60),
        "verbs": _inner_verbs(name, command),
        "arguments": [_param(name, one) for one in params if isinstance(one, click.Argument)],
        "options": dict(chain.from_iterable(_options(name, one) for one in options)),
    }


def _inner_verbs(name: str, command: click.Command) -> dict[str, Any]:
    inner = command.commands if isinstance(command, click.Group) else {}
    shown = {key: one for key, one in inner.items() if not one.hidden}
    return {key: _verb(f"{name} {key}".strip(), one) for key, one in shown.items()}


def _options(verb: str, option: click.Option) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each spelling of an option with its kinds of values."""
    for word in (*option.opts, *option.secondary_opts):
        yield word, _param(verb, option)


def _param(verb: str, param: click.Parameter) -> dict[str, Any]:
    """Kinds of values of an option or argument."""
    is_option = isinstance(param, click.Option)
    return {
        "title": (param.help or "").partition(".")[0] if isinstance(param, click.Option) else "",
        "takes_value": not is_option or not (param.is_flag or param.count),  # type: ignore[attr-defined]
        "kinds": list(kinds_of(verb, param)),
        "choices": list(getattr(param.type, "choices", ())),
        "several": param.nargs == -1,
        "listed": param.name in _LISTED,
    }


def kinds_of(verb: str, param: click.Parameter) -> tuple[str, ...]:
    """Return the kinds of the values of an option or argument; none for a value of one's own."""
    name = param.name or ""
    found = VALUES.get(f"{verb} {name}") or VALUES.get(name)
    if found is None and isinstance(param.type, click.Path):
        return ("files",) if param.type.file_okay else ("folders",)
    return found or ()
