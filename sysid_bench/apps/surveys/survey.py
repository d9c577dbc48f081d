"""Results of a survey: a record for each model with the cause of its refusal, the baseline that the
records are compared with, value by value, and the table.

Causes are found in the sentences of refused models: for counts, never in their place."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, count_text
from sysid_bench.input_files import read_text
from sysid_bench.types import Row
from sysid_bench.version_fields import version_fields

DISAGREE: Final = "the engines disagree"
RAW: Final = "exception without a sentence"
OTHER: Final = "other"
NO_MASS: Final = "no mass: not a model of dynamics"
_STATUS: Final[Mapping[str, str]] = {
    "timeout": "no answer within the time limit",
    "memory": "no answer within the memory limit",
    "crash": "crash of an engine",
    "lost": "killed from outside",
}
_SENTENCES: Final = (
    (RAW, r"^\w+(Error|Exception|Warning): "),
    ("no moving joint", r"no moving joint"),
    (NO_MASS, r"not a model of dynamics"),
    ("an included file is absent", r"the file of <\w+ file=.* does not exist"),
    ("inertia from meshes that are absent", r"meshes that do not exist|the mesh .* is not defined"),
    ("a file outside the source", r"lies outside the model's folder"),
    ("equalities hold all joints", r"equalities fix all joints"),
    ("larger than the product takes", r"their product may be|elements; simplify|with \d+ degrees"),
    ("unexpanded xacro", r"which xacro has not expanded"),
    ("numbers that are none", r"write three finite numbers|must be a finite number"),
    ("links or joints that do not fit together", r"not one of its links|has no link|root link"),
    ("no well-formed XML", r"not well-formed XML|DOCTYPE"),
    ("a part of a model", r"part to be included"),
    ("MuJoCo cannot read it", r"^MuJoCo cannot read"),
    ("MuJoCo cannot compile it", r"^MuJoCo cannot compile"),
)


def cause_of(row: Mapping[str, Any]) -> str:
    """Return the cause of a refusal, "" for a model that is ok."""
    if row["status"] == "ok":
        return ""
    # Ended from outside: there is no sentence to read a cause from.
    if row["status"] in _STATUS:
        return _STATUS[row["status"]]
    if row.get("nv") is not None:
        # Figures without "ok": both engines read the model, and differ.
        return DISAGREE if "on the tree" not in row["reason"] else "closed chain not reproduced"
    # The first that fits: what an engine says of its own comes last.
    found = (cause for cause, pattern in _SENTENCES if re.search(pattern, row["reason"]))
    return next(found, OTHER)


@dataclass(frozen=True)
class SurveyRecord:
    """One model: the row of its cross-check, and the row of what the engines read of its file as it
    stands (None where it was not computed)."""

    name: str
    row: Row
    engines: Row | None

    @property
    def ok(self) -> bool:
        """True for a model that the cross-check accepts."""
        return bool(self.row["status"] == "ok")

    @property
    def cause(self) -> str:
        """Cause of the refusal, "" for none."""
        return cause_of(self.row)

    @property
    def is_loaded(self) -> bool:
        """True where an engine reads moving joints from the file as it stands."""
        read = self.engines or {}
        counts = (read.get("mujoco"), read.get("pinocchio"))
        return any(isinstance(count, int) and count > 0 for count in counts)

    @property
    def error(self) -> float:
        """Largest of gap and closure, 0 for a refused model."""
        coupling: Mapping[str, Any] = self.row.get("coupling") or {}
        figures = [part.get(key) for part in (self.row, coupling) for key in ("gap", "closure")]
        return max((float(figure) for figure in figures if figure is not None), default=0.0)


def counts_by_cause(models: Iterable[SurveyRecord]) -> list[tuple[str, int]]:
    """Return the causes of refusals with their number, the most frequent first."""
    counts = Counter(model.cause for model in models if not model.ok)
    return sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))


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
    lines = [
        f"  {json.dumps(m.name)}: {json.dumps(_values(m))}"
        for m in sorted(models, key=lambda model: model.name)
    ]
    head = json.dumps(version_fields())
    return f'{{"versions": {head},\n "models": {{\n' + ",\n".join(lines) + "\n}}\n"


def read_baseline(file: Path) -> Mapping[str, Any]:
    """Return the models of a baseline; raises UsageError for a file that is not one."""
    try:
        found = json.loads(read_text(file))
        models = found["models"]
        if not all(isinstance(one, dict) and "ok" in one for one in models.values()):
            raise ValueError("a model has no 'ok'")
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{file} is not the baseline of a survey ({error}); write one with --save FILE."
        ) from error
    return dict(models)


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
    if model.ok and not known["ok"]:
        return Change(model.name, f"ok; it was refused: {known['cause']}", worse=False)
    if known["ok"] and not model.ok:
        return Change(model.name, f"refused: {model.row['reason']}", worse=True)
    now, keys = _values(model), _EXACT if model.ok else ("cause",)
    texts = [f"{k}: {known.get(k)} -> {now[k]}" for k in keys if known.get(k) != now[k]]
    return Change(model.name, ", ".join(texts), worse=True) if texts else None


def _values(model: SurveyRecord) -> dict[str, Any]:
    if not model.ok:
        return {"ok": False, "cause": model.cause}
    row = model.row
    # Counts, and no gaps: rounding differs between machines.
    counts = {"nv": row["nv"], "base_parameters": row["base_parameters"]}
    return {"ok": True, **counts, "repairs": len(row["repairs"])}


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
    groups: dict[str, list[SurveyRecord]] = {}
    for model in models:
        groups.setdefault(model.name.partition("/")[0], []).append(model)
    loadable = [model for model in models if model.is_loaded]
    causes = dict(counts_by_cause(loadable))
    packages = []
    for name, group in groups.items():
        read = [model for model in group if model.is_loaded]
        packages.append((name, len(group), _ok(group), len(read), _ok(read)))
    tables = {
        "Packages": _table(("folder", "models", "ok", "loadable", "ok of these"), packages),
        "Refusals by cause": _table(
            ("cause", "models", "of the loadable"),
            [(cause, n, causes.get(cause, 0)) for cause, n in counts_by_cause(models)],
        ),
        "Refused, and loadable": _reasons(loadable),
        "Refused, and not loadable": _reasons([one for one in models if not one.is_loaded]),
    }
    parts = [f"# {title}", f"Made by `{command}`.", *_head(models)]
    for head, table in tables.items():
        parts += [f"## {head}", table]
    return "\n\n".join([*parts, *_mended(models)]) + "\n"


def _ok(models: Iterable[SurveyRecord]) -> int:
    return sum(model.ok for model in models)


def _share(models: Sequence[SurveyRecord]) -> str:
    return f" ({_ok(models) / len(models):.1%})" if models else ""


def _head(models: Sequence[SurveyRecord]) -> list[str]:
    loadable = [model for model in models if model.is_loaded]
    massive = [model for model in loadable if model.cause != NO_MASS]
    worst = max((model.error for model in models if model.ok), default=0.0)
    seconds = [model.row.get("seconds_cpu") or 0.0 for model in models] or [0.0]
    installed = (f"{name} {version}" for name, version in version_fields().items() if version)
    return [
        f"{len(models)} distinct model files, {_ok(models)} ok. Of these files MuJoCo or Pinocchio "
        f"loads {len(loadable)} as they stand, with moving joints: **{_ok(loadable)} ok"
        f"{_share(loadable)}**; of those in which a body that moves has a mass, {_ok(massive)} of "
        f"{len(massive)}{_share(massive)}. Neither loads {_ok(models) - _ok(loadable)} further "
        "ones, which are ok with the repairs that the cross-check lists.",
        f"Largest gap or closure of the models that are ok: {worst:.1e}. "
        f"CPU seconds of a model: median {np.median(seconds):.2f}, 95 % below "
        f"{np.quantile(seconds, 0.95):.2f}, largest {max(seconds):.1f}.",
        f"Versions: {', '.join(installed)}.",
    ]


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = []
    for row in (heads, ["---"] * len(heads), *rows):
        cells = [" ".join(str(value).split()).replace("|", "\\|") for value in row]
        cut = (text if len(text) <= _LONGEST else text[:_LONGEST] + " ..." for text in cells)
        lines.append(f"| {' | '.join(cut)} |")
    return "\n".join(lines)


def _reasons(models: Sequence[SurveyRecord]) -> str:
    rows = [(one.name, one.cause, one.row["reason"]) for one in models if not one.ok]
    return _table(("model", "cause", "sentence"), rows)


def _mended(models: Sequence[SurveyRecord]) -> list[str]:
    repaired = [set(map(_kind, model.row["repairs"])) for model in models if model.ok]
    counts = Counter(chain.from_iterable(repaired))
    # Kinds that occur once are many, and say nothing of the models in common.
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
