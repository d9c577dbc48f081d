"""Baseline of a survey: what each model gave, one line a model, compared value by value."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.surveys.survey_record import SurveyRecord
from sysid_bench.errors import UsageError
from sysid_bench.input_files import read_text
from sysid_bench.version_fields import version_fields

_EXACT: Final = ("nv", "base_parameters", "repairs")
"""Values of a model that is ok which must be equal; repairs are counted."""


@dataclass(frozen=True)
class Change:
    """A model that differs from its baseline; `worse` where that fails."""

    model: str
    text: str
    worse: bool


def baseline_text(models: Iterable[SurveyRecord]) -> str:
    """Return the baseline of a survey as JSON, a line for each model, sorted."""
    lines = [f"  {json.dumps(m.name)}: {json.dumps(_values(m))}" for m in _sorted(models)]
    head = json.dumps(version_fields())
    return f'{{"versions": {head},\n "models": {{\n' + ",\n".join(lines) + "\n}}\n"


def read_baseline(file: Path) -> Mapping[str, Any]:
    """Return the models of a baseline; raises UsageError for a file that is not one."""
    try:
        found = json.loads(read_text(file))
        models = found["models"]
        if not all(map(_is_result, models.values())):
            raise ValueError("a model has no 'ok'")
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{file} is not the baseline of a survey ({error}); write one with --save FILE."
        ) from error
    return dict(models)


def _is_result(values: Any) -> bool:
    return isinstance(values, dict) and "ok" in values


def compare_baseline(known: Mapping[str, Any], models: Sequence[SurveyRecord]) -> list[Change]:
    """Return what differs from a baseline: models that are refused now, that have other figures or
    are gone (worse), and models that are ok now or new."""
    gone = known.keys() - {model.name for model in models}
    absent = [Change(name, "it is not there any more", worse=True) for name in gone]
    found = (_change(model, known.get(model.name)) for model in models)
    return sorted([*absent, *filter(None, found)], key=lambda change: change.model)


def _change(model: SurveyRecord, known: Mapping[str, Any] | None) -> Change | None:
    if known is None:
        return Change(model.name, "it is not in the baseline", worse=not model.ok)
    now = _values(model)
    if known["ok"] and not model.ok:
        return Change(model.name, f"refused: {model.row['reason']}", worse=True)
    if not known["ok"]:
        if model.ok:
            return Change(model.name, f"ok; it was refused: {known['cause']}", worse=False)
        return _other(model, known, now, ("cause",))
    return _other(model, known, now, _EXACT)


def _other(
    model: SurveyRecord, known: Mapping[str, Any], now: Mapping[str, Any], keys: Sequence[str]
) -> Change | None:
    texts = [f"{k}: {known.get(k)} -> {now[k]}" for k in keys if known.get(k) != now[k]]
    return Change(model.name, ", ".join(texts), worse=True) if texts else None


def _values(model: SurveyRecord) -> dict[str, Any]:
    if not model.ok:
        return {"ok": False, "cause": model.cause}
    row = model.row
    counts = {"nv": row["nv"], "base_parameters": row["base_parameters"]}
    return {"ok": True, **counts, "repairs": len(row["repairs"])}


def _sorted(models: Iterable[SurveyRecord]) -> list[SurveyRecord]:
    return sorted(models, key=lambda model: model.name)
