"""Pages of plug-ins: formula, assumptions and source from docstrings, settings, cost."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

from sysid_bench.commands.catalogue import WORDS, entries_of_kind, plugin_entry
from sysid_bench.metrics import METRICS
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.package_folders import plant_files
from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.reference.page_text import code, markdown_line, markdown_text, page, table

TITLES: Final[Mapping[str, str]] = {
    "estimator": "Estimators",
    "excitation": "Excitations",
    "task": "Tasks",
    "simulation": "Simulations",
    "pipeline": "Pipelines",
    "plant": "Plant effects",
    "model_error": "Model errors",
    "sensor_error": "Sensor errors",
    "term": "Features in place of joint terms",
    "log_reader": "Log readers",
    "executor": "Executors",
}
"""Kinds of plug-ins with their headings; those of one page stand one after the other."""

PAGES: Final[Mapping[str, tuple[str, ...]]] = {
    "excitations": ("excitation",),
    "tasks": ("task",),
    "terms": ("term",),
    "plants": ("plant", "model_error", "sensor_error", "simulation"),
    "log-readers": ("log_reader", "pipeline"),
    "executors": ("executor",),
}
WORD_PAGES: Final[Mapping[str, str]] = {
    "terms": "Joint terms, and features in their place",
    "filters": "Filters",
    "integrators": "Integrators",
    "statistics": "Statistics of tables",
    "intervals": "Intervals of tables",
    "statuses": "Statuses of a cell",
}
"""Titles of the pages of words that are not plug-ins."""
_NAME: Final = r"(?:(?:van der |de )?[A-Z][\w'-]+(?:,? and |, | & | )?)+"
_SOURCE: Final = re.compile(rf"({_NAME})\(?(\d{{4}})")
_ASSUMPTION: Final = re.compile("[Aa]ssum")
_COST: Final = re.compile(
    "losed form|program|Gauss-Newton|iterat|simulations per|QR|SVD|eigenval|Newton|sigma points"
)
_SENTENCE: Final = re.compile(r"(?<=\.)\s+(?=[A-Z`])")


def plugin_page(page_name: str) -> str:
    """Return one page about the plug-ins of one or a few kinds."""
    kinds = PAGES[page_name]
    parts = [part for kind in kinds for part in _kind(kind, len(kinds) > 1)]
    levels = [_plant_files()] if "plant" in kinds else []
    return page(f"# {page_title(page_name)}", *levels, *_words_of(page_name), *parts)


def page_title(page_name: str) -> str:
    """Return the title of a page of PAGES."""
    if page_name in WORD_PAGES:
        return WORD_PAGES[page_name]
    kinds = PAGES[page_name]
    return TITLES[kinds[0]] if len(kinds) == 1 else _joined(kinds)


def words_page(page_name: str) -> str:
    """Return the words of one kind that suites take, each with its meaning."""
    return page(f"# {page_title(page_name)}", *_words_of(page_name))


def _words_of(page_name: str) -> list[str]:
    rows = [(code(word), markdown_line(text)) for word, text in WORDS.get(page_name, {}).items()]
    return [table(("word", "meaning"), rows)] if rows else []


def estimator_page() -> str:
    """Return the estimators: formula, assumptions, source, cost, settings."""
    rows = [_estimator_row(name) for name in BUILTIN["estimator"]]
    header = ("name", "reads", "source")
    sections = [
        _section("estimator", name, _estimator_facts(name)) for name in BUILTIN["estimator"]
    ]
    return page("# Estimators", table(header, rows), *sections)


def metrics_page() -> str:
    """Return every metric of rows and tables with its unit, direction and formula."""
    rows = [
        (
            code(metric.name), markdown_line(metric.title),
            markdown_line(" or ".join(metric.units)),
            metric.better or "", metric.level, markdown_line(metric.formula),
        )
        for metric in METRICS.values()
    ]  # fmt: skip
    header = ("field", "title", "unit in tables", "better", "one value per", "formula")
    return page("# Metrics", table(header, rows))


def payload_page() -> str:
    """Return the payloads that have a name."""
    titles = {entry["name"]: entry["title"] for entry in entries_of_kind("payloads")}
    return page("# Payloads", table(("name", "what"), ((code(x), titles[x]) for x in PAYLOADS)))


def _joined(kinds: Iterable[str]) -> str:
    titles = [TITLES[kind] for kind in kinds]
    return ", ".join([titles[0], *(title.lower() for title in titles[1:])])


def _plant_files() -> str:
    entries = [entry for entry in entries_of_kind("plants") if entry["name"] in plant_files()]
    rows = ((code(entry["name"]), markdown_line(entry["title"])) for entry in entries)
    return page("## Realism levels", table(("plant", "what"), rows)).strip()


def _kind(kind: str, has_heading: bool) -> list[str]:
    heading = [f"## {TITLES[kind]}"] if has_heading else []
    depth = 3 if has_heading else 2
    return heading + [_section(kind, name, "", depth) for name in BUILTIN[kind]]


def _section(kind: str, name: str, facts: str = "", depth: int = 2) -> str:
    heading = f"{'#' * depth} {code(name)}"
    return page(heading, markdown_text(_doc(kind, name)), facts, _settings(kind, name)).strip()


def _doc(kind: str, name: str) -> str:
    return str(resolve(kind, name).__doc__ or "")


def _settings(kind: str, name: str) -> str:
    settings: Mapping[str, Any] = plugin_entry({"kind": kind, "name": name})["settings"]
    rows = [(code(key), _shown(value)) for key, value in settings.items()]
    return table(("setting", "default"), rows) if rows else ""


def _shown(value: Any) -> str:
    return "" if value in (None, [], {}) else code(str(value))


def _estimator_row(name: str) -> tuple[str, ...]:
    return f"[{code(name)}](#{name})", _reads(name), markdown_line("; ".join(sources(name)))


def _estimator_facts(name: str) -> str:
    facts = {
        "Assumes": _sentences_with(_ASSUMPTION, name),
        "Bias": str(getattr(resolve("estimator", name), "bias", "")),
        "Reads": _reads(name),
        "Cost": _sentences_with(_COST, name),
        "Source": "; ".join(sources(name)),
    }
    rows = [(key, markdown_line(text)) for key, text in facts.items() if text]
    return table(("property", "as documented"), rows)


def _sentences_with(words: re.Pattern[str], name: str) -> str:
    flat = " ".join(_doc("estimator", name).split())
    return " ".join(one for one in _SENTENCE.split(flat) if words.search(one))


def sources(name: str) -> list[str]:
    """Return the publications that the docstring of an estimator names, "Huber (1964)"."""
    flat = " ".join(_doc("estimator", name).split())
    found = (f"{who.strip(' ,')} ({year})" for who, year in _SOURCE.findall(flat))
    return list(dict.fromkeys(found))


def _reads(name: str) -> str:
    """Input of the method: `solve(problem)`, or `fit(experiment)`."""
    simulates = hasattr(resolve("estimator", name), "fit")
    return "signals, simulator" if simulates else "rows of the regressor"
