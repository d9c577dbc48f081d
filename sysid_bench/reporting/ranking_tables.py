"""Tables of a ranking: verdicts, what the methods answered, and who beats whom."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain, permutations
from typing import Final

import numpy as np

from sysid_bench.errors import count_text
from sysid_bench.evaluation.intervals import ROBOTS, level_text, median_ranks
from sysid_bench.evaluation.robot_statistic import RatioFigure, least_p, robots_needed
from sysid_bench.reporting.baseline_rows import captions
from sysid_bench.reporting.ranking import ALIKE, BROKEN, MOST_FALLBACKS, MethodRatio, Ranking
from sysid_bench.reporting.tables import METRIC, NO_ENTRY, Entry, Key, Table
from sysid_bench.types import Metric

_VERDICTS: Final = (
    Metric("rank", "Rank", better="lower", digits=0),
    Metric("ratio", "Ratio of answered cases", better="lower"),
    Metric("fallback", "Ratio with the reference in place of failures", better="lower"),
    Metric("failed", "Failed", "%", "lower"),
    Metric("robots", "Robots", digits=0),
    Metric("p", "p"),
    Metric("p_holm", "p, corrected"),
    Metric("p_equivalent", "p of equivalence, corrected"),
    Metric("p_smallest", "Smallest possible p"),
    Metric("verdict", "Verdict", text=True),
)
_ANSWERS: Final = (
    Metric("cells", "Cases", digits=0),
    Metric("answered", "Answered", digits=0),
    Metric("unconverged", "Unconverged", digits=0),
    Metric("replaced", "Ratio with the reference in place of failed and unconverged answers",
           better="lower"),
    Metric("noise_free", "Noise-free cases that give the truth", text=True),
    Metric("same", "Same answers as", text=True),
    Metric("reason", "Most frequent reason of a failure", text=True),
)  # fmt: skip


def ranking_tables(ranking: Ranking) -> tuple[Table, ...]:
    """Verdicts; answers, failures and convergence; how often which method beats which."""
    caption = (
        "Cases that a ratio may come from and what the methods made of them; noise-free cases are "
        f"a law (error up to {BROKEN:g}) and have no ratio."
    )
    return (
        verdict_table(ranking),
        _table(ranking, "answers", "answers", _ANSWERS, _answer_row, (caption, ())),
        _win_table(ranking),
    )


def verdict_table(ranking: Ranking) -> Table:
    """The methods from best to worst, each against the reference."""
    replaced = "failed and unconverged answers" if ranking.is_replaced else "failures"
    caption = (
        f"{ranking.metric.title} over that of {ranking.against}: exp of the median over robots of "
        f"their mean log ratio, with the interval of order statistics that holds it in at least "
        f"{level_text()} (none below {ROBOTS.fewest} robots); ranks with the interval over robots "
        f"drawn again ({ROBOTS.draws} draws, seed {ROBOTS.seed}). "
        "p: exact signed-rank test over robots; corrected by Holm and Shaffer over all "
        f"{count_text(ranking.verdicts, 'verdict')} of the suite, and so is that of equivalence. "
        f"Verdict with the reference in place of {replaced}: better or worse where corrected p and "
        f"interval exclude 1 and the ratio is beyond {100 * ranking.margin:g} %; equivalent where "
        "the corrected sign test excludes ratios beyond that; where more "
        f"than {100 * MOST_FALLBACKS:g} % of the cases have no own answer, "
        "neither better nor equivalent."
    )
    notes = chain(_notes(ranking), captions([one.method for one in ranking.baselines]))
    return _table(ranking, "", "", _VERDICTS, _verdict_row, (caption, notes))


def _finite(x: float) -> float | None:
    return x if np.isfinite(x) else None


def _verdict_row(ranking: Ranking, one: MethodRatio) -> tuple[Entry, ...]:
    rank = ranking.rank_interval.get(one.method)
    corrected = ranking.corrected.get(one.method)
    # The reference against itself is not a comparison, nor is that of a baseline a test.
    is_reference = one.method == ranking.against or one in ranking.baselines
    tested = NO_ENTRY if is_reference or not one.robots else _number(one.p)
    return (
        NO_ENTRY if rank is None else _number(*map(_finite, rank)),
        _ratio(one.ratio, one, one.statuses),
        _ratio(one.fallback, one),
        _number(100.0 * one.failed / one.cells) if one.cells else NO_ENTRY,
        _number(one.robots),
        tested,
        *(map(_number, corrected) if corrected else (NO_ENTRY, NO_ENTRY)),
        NO_ENTRY if is_reference else _number(one.smallest_p),
        _text(verdict_of(ranking, one)),
    )


def verdict_of(ranking: Ranking, one: MethodRatio) -> str:
    """Verdict on a method; "reference" for that itself, "same as" for a copy of it, "not tested"
    for one outside of the family."""
    if one in ranking.baselines:
        return "baseline"
    if one.method == ranking.against:
        return "reference"
    if ranking.same.get(one.method) == ranking.against:
        return f"same as {ranking.against}"
    return ranking.verdict(one) or "not tested"


def _answer_row(ranking: Ranking, one: MethodRatio) -> tuple[Entry, ...]:
    kept, laws = one.laws
    return (
        _number(one.cells),
        _number(one.cells - one.failed),
        _number(one.unconverged),
        _ratio(one.replaced, one),
        _text(f"{kept} of {laws}" if laws else ""),
        _text(ranking.same.get(one.method, "")),
        _text(one.reason if one.failed else ""),
    )


def _win_table(ranking: Ranking) -> Table:
    entries: dict[tuple[Key, Key], Entry] = {
        ((ranking.method_names[i],), (ranking.method_names[j],)): _number(
            float(ranking.win_rates[i, j])
        )
        for i, j in permutations(range(len(ranking.method_names)), 2)
        if np.isfinite(ranking.win_rates[i, j])
    }
    return Table(
        name=f"{ranking.name}-wins",
        title=f"{ranking.title}: who beats whom",
        metrics=(Metric("wins", ranking.metric.title),),
        stat="mean",
        interval="none",
        row_fields=("estimator",),
        column_fields=("against",),
        rows=tuple((method,) for method in ranking.method_names),
        columns=tuple((method,) for method in ranking.method_names),
        entries=entries,
        own_caption="Share of the common cases in which the row beats the column; ties count half.",
    )


def _table(
    ranking: Ranking,
    suffix: str,
    title: str,
    metrics: tuple[Metric, ...],
    row: Callable[[Ranking, MethodRatio], tuple[Entry, ...]],
    texts: tuple[str, Iterable[str]],
) -> Table:
    """A table with a row per method and a column per metric; `texts`: its caption and notes."""
    caption, notes = texts
    columns = tuple((metric.name,) for metric in metrics)
    lines = (*ranking.comparisons, *(() if suffix else ranking.baselines))
    entries: dict[tuple[Key, Key], Entry] = {
        ((one.method,), column): entry
        for one in lines
        for column, entry in zip(columns, row(ranking, one), strict=True)
    }
    return Table(
        name=f"{ranking.name}-{suffix}" if suffix else ranking.name,
        title=f"{ranking.title}: {title}" if title else ranking.title,
        metrics=metrics,
        stat="median",
        interval="ci95",
        row_fields=("estimator",),
        column_fields=(METRIC,),
        rows=tuple((one.method,) for one in lines),
        columns=columns,
        entries=entries,
        notes=tuple(notes),
        own_caption=caption,
    )


def _notes(ranking: Ranking) -> Iterator[str]:
    cases, sizes = ranking.cases, sorted({one.robots for one in ranking.comparisons})
    # Few robots cannot reach a small p, however clear the difference: the reader has to know the
    # floor.
    robots, verdicts = max(sizes, default=0), max(ranking.verdicts, 1)
    yield (
        f"With {count_text(robots, 'robot')} p cannot be below {least_p(robots):.2g}, and after "
        f"the correction not below {min(1.0, least_p(robots) * verdicts):.2g}; the first verdict "
        f"needs {robots_needed(verdicts)} robots that all agree."
    )
    known = ((n, median_ranks(n)) for n in sizes)
    covered = [
        f"{100 * found[1]:.1f} % ({found[0]} to {n + 1 - found[0]} of {n} robots in order)"
        for n, found in known
        if found
    ]
    if covered:
        yield f"Coverage of the intervals, exact: {', '.join(covered)}."
    for first in dict.fromkeys(ranking.same.values()):
        copies = ", ".join(method for method, one in ranking.same.items() if one == first)
        yield f"Same answers as {first} (errors within {ALIKE:g}), counted once: {copies}."
    for method, reason in ranking.left_out.items():
        yield f"Not ranked: {method}: {reason}."
    r = cases.methods.index(ranking.against)
    lost = int((cases.with_ratio & cases.has_row[:, r] & np.isnan(cases.errors[:, r])).sum())
    counts = {
        f"without an answer of {ranking.against}": lost,
        "without noise": int(cases.noise_free.sum()),
        "with the true values as prior": int((cases.told & ~cases.noise_free).sum()),
    }
    left_out = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    if left_out:
        yield f"Cases without a ratio: {left_out}."


def _ratio(
    figure: RatioFigure, one: MethodRatio, failures: Mapping[str, int] | None = None
) -> Entry:
    """A ratio with its interval; `failures`: cells that it does not cover, by status."""
    failures = dict(failures or {})
    covered = one.cells - sum(failures.values())
    return Entry(figure.value, figure.low, figure.high, covered, failures)


def _number(value: float | None, *ends: float | None) -> Entry:
    low, high = ends or (None, None)
    return Entry(value, low, high, 1, {})


def _text(text: str) -> Entry:
    return Entry(None, None, None, 1, {}, text=text)
