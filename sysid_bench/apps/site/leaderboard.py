"""Ranks of a site as JSON, and the schema of that JSON."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.site.result_notes import result_notes
from sysid_bench.apps.site.site_run import SiteRun
from sysid_bench.apps.site.suite_version import SuiteVersion
from sysid_bench.reporting.ranking import MethodRatio, Ranking
from sysid_bench.reporting.ranking_figures import method_times
from sysid_bench.reporting.ranking_tables import verdict_of
from sysid_bench.reporting.selection import label

SCHEMA: Final = 1
"""Version of the format."""
SCHEMA_FILE: Final = Path(__file__).with_name("leaderboard.schema.json")


def leaderboard(versions: Iterable[SuiteVersion]) -> dict[str, Any]:
    """The content of leaderboard.json: finite numbers, null where there is none."""
    return {"schema": SCHEMA, "suites": [_suite(version) for version in versions]}


def leaderboard_text(versions: Iterable[SuiteVersion]) -> str:
    """The same text for the same runs."""
    return json.dumps(leaderboard(versions), indent=1, allow_nan=False) + "\n"


def _suite(version: SuiteVersion) -> dict[str, Any]:
    counts = Counter(map(label, version.cells["status"]))
    return {
        "name": version.name,
        "version": version.version,
        "title": version.title,
        "seed": version.first.suite.get("seed"),
        "page": f"suites/{version.page}.html",
        "cells": dict(sorted(counts.items())),
        "runs": [_run(run) for run in version.runs],
        "rankings": [_ranking(ranking, version) for ranking in version.ranking_list],
        "limitations": result_notes(version),
    }


def _run(run: SiteRun) -> dict[str, Any]:
    submission, checked = run.submission, run.checked
    return {
        "name": run.name,
        "package": run.package,
        "commit": run.code_version or None,
        "cpu": run.env.get("cpu"),
        "planned": run.planned,
        "rows": len(run.cells),
        "submission": None if submission is None else dict(vars(submission)),
        "checked": None
        if checked is None
        else {"seed": checked.seed, "drawable": checked.drawable, "cells": list(checked.cells)},
    }


def _ranking(ranking: Ranking, version: SuiteVersion) -> dict[str, Any]:
    seconds = method_times(version.cells)
    return {
        "name": ranking.name,
        "title": ranking.title,
        "metric": ranking.metric.name,
        "against": ranking.against,
        "margin": ranking.margin,
        "methods": [_method(ranking, one, seconds) for one in ranking.comparisons],
    }


def _method(ranking: Ranking, one: MethodRatio, seconds: Mapping[str, float]) -> dict[str, Any]:
    rank, low, high = ranking.rank_interval.get(one.method, (math.nan,) * 3)
    return {
        "method": one.method,
        "same_as": ranking.same.get(one.method),
        "rank": _finite(rank),
        "rank_interval": _pair(low, high),
        "ratio": one.ratio.value,
        "ratio_interval": _pair(one.ratio.low, one.ratio.high),
        "fallback": one.fallback.value,
        "fallback_interval": _pair(one.fallback.low, one.fallback.high),
        "cells": one.cells,
        "failed": one.failed,
        "robots": one.robots,
        "p": _finite(one.p),
        "p_holm": _finite(ranking.holm_p.get(one.method)),
        "verdict": verdict_of(ranking, one),
        "cpu_seconds": seconds.get(one.method),
    }


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _pair(low: float | None, high: float | None) -> list[float] | None:
    ends = _finite(low), _finite(high)
    return None if ends[0] is None or ends[1] is None else [ends[0], ends[1]]
