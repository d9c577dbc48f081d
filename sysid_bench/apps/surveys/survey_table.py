"""Table of a survey: counts by package and by cause, and each refusal with its sentence."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Final

import numpy as np

from sysid_bench.apps.surveys.cause import NO_MASS
from sysid_bench.apps.surveys.survey_record import SurveyRecord, counts_by_cause
from sysid_bench.errors import count_text
from sysid_bench.version_fields import version_fields

_LONGEST: Final = 300
"""Letters of a sentence in the table."""
_WORDS: Final = 9
_NAMES: Final = re.compile(r"'[^']*'|\([^)]*\)|^.*?: (?=inertia came)")
_PLAIN: Final = re.compile(r"[a-z]+[,:;]?")


def counts_text(models: Sequence[SurveyRecord]) -> str:
    """Return the counts of a survey for the terminal, a line for each cause."""
    lines = [f"{count_text(len(models), 'model')}: {_ok(models)} ok"]
    if any(model.engines is not None for model in models):
        loadable = [model for model in models if model.is_loaded]
        lines.append(
            f"loaded by MuJoCo or Pinocchio as they stand, with moving joints: {len(loadable)}, of "
            f"which {_ok(loadable)} ok{_share(loadable)}"
        )
    lines += [f"  {count:4d}  {cause}" for cause, count in counts_by_cause(models)]
    return "\n".join(lines)


def markdown(title: str, command: str, models: Sequence[SurveyRecord]) -> str:
    """Return the report of a survey."""
    parts = [f"# {title}", f"Made by `{command}`.", *_head(models), *_groups(models)]
    parts += [*_causes(models), *_refusals(models), *_mended(models)]
    return "\n\n".join(parts) + "\n"


def _ok(models: Iterable[SurveyRecord]) -> int:
    return sum(model.ok for model in models)


def _share(models: Sequence[SurveyRecord]) -> str:
    return f" ({_ok(models) / len(models):.1%})" if models else ""


def _head(models: Sequence[SurveyRecord]) -> list[str]:
    loadable = [model for model in models if model.is_loaded]
    massive = [model for model in loadable if model.cause != NO_MASS]
    return [
        f"{len(models)} distinct model files, {_ok(models)} ok. Of these files MuJoCo or Pinocchio "
        f"loads {len(loadable)} as they stand, with moving joints: **{_ok(loadable)} ok"
        f"{_share(loadable)}**; of those in which a body that moves has a mass, {_ok(massive)} of "
        f"{len(massive)}{_share(massive)}. Neither loads {_ok(models) - _ok(loadable)} further "
        "ones, which are ok with the repairs that the cross-check lists.",
        _figures(models),
        f"Versions: {_installed()}.",
    ]


def _figures(models: Sequence[SurveyRecord]) -> str:
    worst = max((model.error for model in models if model.ok), default=0.0)
    seconds = [model.row.get("seconds_cpu") or 0.0 for model in models] or [0.0]
    return (
        f"Largest gap or closure of the models that are ok: {worst:.1e}. "
        f"CPU seconds of a model: median {np.median(seconds):.2f}, 95 % below "
        f"{np.quantile(seconds, 0.95):.2f}, largest {max(seconds):.1f}."
    )


def _installed() -> str:
    return ", ".join(f"{name} {version}" for name, version in version_fields().items() if version)


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(value: object) -> str:
    text = " ".join(str(value).split()).replace("|", "\\|")
    return text if len(text) <= _LONGEST else text[:_LONGEST] + " ..."


def _groups(models: Sequence[SurveyRecord]) -> list[str]:
    groups: dict[str, list[SurveyRecord]] = {}
    for model in models:
        groups.setdefault(model.name.partition("/")[0], []).append(model)
    rows = [(name, *_counts(group)) for name, group in groups.items()]
    return ["## Packages", _table(("folder", "models", "ok", "loadable", "ok of these"), rows)]


def _counts(models: Sequence[SurveyRecord]) -> tuple[int, ...]:
    loadable = [model for model in models if model.is_loaded]
    return len(models), _ok(models), len(loadable), _ok(loadable)


def _causes(models: Sequence[SurveyRecord]) -> list[str]:
    loadable = dict(counts_by_cause(model for model in models if model.is_loaded))
    rows = [(cause, n, loadable.get(cause, 0)) for cause, n in counts_by_cause(models)]
    return ["## Refusals by cause", _table(("cause", "models", "of the loadable"), rows)]


def _refusals(models: Sequence[SurveyRecord]) -> list[str]:
    refused = [model for model in models if not model.ok]
    loadable = [model for model in refused if model.is_loaded]
    rest = [model for model in refused if not model.is_loaded]
    return ["## Refused, and loadable", _reasons(loadable),
            "## Refused, and not loadable", _reasons(rest)]  # fmt: skip


def _reasons(models: Sequence[SurveyRecord]) -> str:
    rows = [(model.name, model.cause, model.row["reason"]) for model in models]
    return _table(("model", "cause", "sentence"), rows)


def _mended(models: Sequence[SurveyRecord]) -> list[str]:
    repaired = [set(map(_kind, model.row["repairs"])) for model in models if model.ok]
    counts = Counter(chain.from_iterable(repaired))
    rows = [pair for pair in counts.most_common() if pair[1] > 1]
    alone = len(counts) - len(rows)
    untouched = sum(not kinds for kinds in repaired)
    return [
        "## Repairs of models that are ok",
        f"{untouched} of {len(repaired)} need none; {alone} kinds of repair occur in one model.",
        _table(("repair, without names and numbers", "models"), rows),
    ]


def _kind(repair: str) -> str:
    """Plain words of a repair: no names, numbers and parentheses."""
    words = _NAMES.sub("", repair).split()
    return " ".join([word for word in words if _PLAIN.fullmatch(word)][:_WORDS]).rstrip(",:;")
