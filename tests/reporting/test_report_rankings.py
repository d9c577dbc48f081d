"""Laws of rankings: no figure of a method depends on who else is entered, every robot counts once,
a failure never wins, few robots claim nothing."""

import json
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.robot_statistic import equivalence_p, least_p, rank_test_p, verdict
from sysid_bench.metrics import METRICS
from sysid_bench.reporting import ranking as rankings
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.latex import Origin, to_latex
from sysid_bench.reporting.ranking import (
    RATIOS,
    MethodRatio,
    Ranking,
    correct_together,
    entry_with_cells,
    rank_cells,
)
from sysid_bench.reporting.ranking_figures import profile
from sysid_bench.reporting.ranking_tables import ranking_tables, verdict_table
from sysid_bench.reporting.tables import Entry
from sysid_bench.reporting.writers import to_csv, to_json, to_markdown

METHODS = {"wls": 1.5, "poor": 3.0, "good": 1.0, "alike": 1.5, "failing": 0.5, "restless": 0.9}
"""Size of each method's errors. "alike" differs from wls by chance; "failing" fails on every other
robot; "restless" has not converged on half of the payloads; "copy" answers as "good"."""


def fabricate(robots: int = 14, seed: int = 0, swap: str = "") -> pd.DataFrame:
    """Errors of a size of each robot, times those of a method, times chance; on the plant `swap`
    the good method is as bad as the poor one. Some rows of "poor" were never planned."""
    rng, rows = np.random.default_rng(seed), []
    for robot in range(robots):
        for plant in ("matched", "stribeck"):
            for payload in ("none", "box-2kg"):
                case = {"robot": f"r{robot}", "payload": payload, "plant": plant, "repeat": 0}
                size = 10.0 ** rng.uniform(-4, 0)
                for method, worth in METHODS.items():
                    if plant == swap and method in ("poor", "good"):
                        worth = 4.0 - worth
                    error = size * worth * rng.lognormal(0, 0.02 if method == "alike" else 0.1)
                    failed = method == "failing" and robot % 2 == 0
                    row = case | _row(method, None if failed else error)
                    row["converged"] = False if _is_restless(method, payload) else None
                    if (method, robot, payload) != ("poor", 1, "none"):
                        rows.append(row)
                    if method == "good":
                        rows.append(case | _row("copy", error * (1 + 1e-7)))
    return pd.DataFrame(rows)


def _row(method: str, error: float | None) -> dict[str, Any]:
    status, reason = ("failed", "It gave up.") if error is None else ("ok", None)
    return {"estimator": method, "status": status, "reason": reason, "torque_error": error}


def _is_restless(method: str, payload: str) -> bool:
    return method == "restless" and payload == "none"


def ranked(cells: pd.DataFrame, **spec: Any) -> list[Ranking]:
    found = rank_cells(cells, {"name": "r", "metric": "torque_error", **spec})
    return list(correct_together(found))


def compared(cells: pd.DataFrame, **spec: Any) -> dict[str, MethodRatio]:
    [ranking] = ranked(cells, **spec)
    return {one.method: one for one in ranking.comparisons}


def word(cells: pd.DataFrame, method: str, **spec: Any) -> str:
    """Verdict on one method, compared alone."""
    [ranking] = ranked(cells[cells["estimator"].isin(["wls", method])], **spec)
    return entry(ranking, method, "verdict").text


def of(cells: pd.DataFrame, method: str, **spec: Any) -> MethodRatio:
    """The comparison of one method: others do not change it."""
    return compared(cells[cells["estimator"].isin(["wls", "poor", method])], **spec)[method]


def entry(ranking: Ranking, method: str, column: str) -> Entry:
    return next(
        table.entries[(method,), (column,)]
        for table in ranking_tables(ranking)
        if ((method,), (column,)) in table.entries
    )


def figures(one: MethodRatio) -> tuple[Any, ...]:
    """All that may not depend on others."""
    parts = (one.ratio, one.fallback, one.replaced, one.robots, one.cells, one.unconverged)
    rest = (dict(one.statuses), one.laws, one.p, one.p_equivalent, one.smallest_p, one.reason)
    return (*parts, *rest, one.ratios.tobytes(), one.logs.tobytes())


# --- Who else is entered --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_no_figure_depends_on_who_else_is_entered(seed: int) -> None:
    cells = fabricate(seed=seed)
    [whole] = ranked(cells)
    alone = {one.method: figures(one) for one in whole.comparisons}
    rng = np.random.default_rng(seed)
    others = [method for method in (*METHODS, "copy") if method != "wls"]
    for _ in range(3):
        entered = {"wls", *rng.choice(others, size=rng.integers(1, 6), replace=False)}
        [part] = ranked(cells[cells["estimator"].isin(entered)].sample(frac=1, random_state=seed))
        assert set(part.method_names) == entered
        for one in part.comparisons:
            assert figures(one) == alone[one.method]


def test_ranks_and_the_correction_do_depend_on_it() -> None:
    """What may move does: the law above is not one of constants."""
    cells = fabricate()
    [whole] = ranked(cells)
    [part] = ranked(cells[~cells["estimator"].isin(["good", "copy", "failing"])])
    assert whole.rank_interval["poor"][0] > part.rank_interval["poor"][0]
    assert whole.corrected["poor"] > part.corrected["poor"]
    assert (whole.verdicts, part.verdicts) == (5, 3)


def test_the_correction_is_over_all_verdicts_of_a_suite() -> None:
    """Those of the declared families, of all rankings and of both plants; others have none."""
    cells = fabricate()
    [declared] = ranked(cells, family=["good", "copy", "poor"])
    raw = {one.method: one.p for one in declared.comparisons}
    assert set(declared.corrected) == {"good", "poor"}  # a copy is not tested twice
    smaller = min(raw["good"], raw["poor"])
    assert min(p for p, _ in declared.corrected.values()) == pytest.approx(2 * smaller)
    assert entry(declared, "copy", "verdict").text == entry(declared, "good", "verdict").text
    assert entry(declared, "alike", "verdict").text == "not tested"
    apart = ranked(cells, family=["good", "copy", "poor"], apart=["plant"])
    assert [one.verdicts for one in apart] == [4, 4]
    every = correct_together([declared, *apart])
    assert [one.verdicts for one in every] == [6, 6, 6]
    assert min(p for p, _ in every[0].corrected.values()) == pytest.approx(6 * smaller)
    assert "all 6 verdicts of the suite" in verdict_table(every[0]).description
    for wrong in ({"family": ["gud"]}, {"against": "gud"}):
        with pytest.raises(UsageError, match="good"):
            ranked(cells, **wrong)
    with pytest.raises(UsageError, match="wls"):
        ranked(cells[cells["estimator"] != "wls"])


# --- One robot, one vote --------------------------------------------------------------------------


def test_the_ratio_is_the_median_of_robots_means() -> None:
    cells = fabricate()
    table = cells.assign(case=cells["robot"] + cells["payload"] + cells["plant"]).pivot(
        index=["robot", "case"], columns="estimator", values="torque_error"
    )
    ratios = table["alike"].astype(float) / table["wls"].astype(float)
    expected = np.exp(ratios.map(np.log).groupby("robot").mean().median())
    assert of(cells, "alike").ratio.value == pytest.approx(expected, rel=1e-8)


def test_more_cells_of_one_robot_do_not_make_it_count_more() -> None:
    cells = fabricate()
    again = cells[cells["robot"] == "r3"]
    more = pd.concat([cells, *(again.assign(repeat=repeat) for repeat in (1, 2, 3))])
    for method in ("good", "alike"):
        one, two = of(cells, method), of(more, method)
        assert one.ratio.value == pytest.approx(two.ratio.value)
        assert (one.p, one.p_equivalent, one.robots) == (two.p, two.p_equivalent, two.robots)


def test_neither_the_unit_nor_the_order_of_cells_matters() -> None:
    cells = fabricate()
    [one] = ranked(cells)
    scale = cells["robot"].map({name: 10.0**i for i, name in enumerate(cells["robot"].unique())})
    other = cells.assign(torque_error=cells["torque_error"].astype(float) * scale)
    [two] = ranked(other.sample(frac=1, random_state=1))
    assert one.method_names == two.method_names
    for a, b in zip(one.comparisons, two.comparisons, strict=True):
        assert a.ratio.value == pytest.approx(b.ratio.value)
        assert a.p == b.p


def test_few_robots_have_neither_interval_nor_verdict() -> None:
    for robots in (1, 5, 6, 8, 9):
        [ranking] = ranked(fabricate(robots=robots))
        good = next(one for one in ranking.comparisons if one.method == "good")
        assert (good.ratio.low is None) == (robots < 6)
        # Five verdicts: 5 * 2^-5 > 5 %, 5 * 2^-7 is below it.
        decided = entry(ranking, "good", "verdict").text
        assert decided == ("better" if robots >= 8 else "undecided")
        assert word(fabricate(robots=robots), "good") == ("better" if robots >= 6 else "undecided")
        assert good.smallest_p == 2.0 ** (1 - robots)
        counted = f"With {robots} robot{'s' if robots > 1 else ''} p cannot"
        assert any(counted in note for note in verdict_table(ranking).notes)


# --- Verdicts, failures, convergence --------------------------------------------------------------


def test_verdicts_are_those_that_the_data_were_made_with() -> None:
    [ranking] = ranked(fabricate())
    words = {one.method: entry(ranking, one.method, "verdict").text for one in ranking.comparisons}
    assert words == {
        "wls": "reference",
        "good": "better",
        "copy": "better",
        "alike": "equivalent",
        "poor": "worse",
        "failing": "undecided",
        "restless": "better",
    }
    assert word(fabricate(), "good", margin="60 %") == "equivalent"


@pytest.mark.parametrize(("lost", "found"), [(0, "better"), (5, "better"), (6, "undecided")])
def test_a_method_that_often_falls_back_is_never_better(lost: int, found: str) -> None:
    """56 cases: five failures are 8.9 %, six are 10.7 %."""
    cells = fabricate()
    index = cells[cells["estimator"] == "good"].index[: 2 * lost : 2]
    cells.loc[index, "status"] = "failed"
    cells.loc[index, "torque_error"] = np.nan
    good = of(cells, "good")
    assert (word(cells, "good"), good.failed) == (found, lost)
    assert good.ratio.value is not None
    assert good.fallback.value is not None
    assert good.fallback.value >= good.ratio.value - 1e-12


def test_a_failure_falls_back_to_the_reference() -> None:
    [ranking] = ranked(fabricate())
    failing = of(fabricate(), "failing")
    assert failing.ratio.value == pytest.approx(0.33, rel=0.1)
    # Half of the robots have no own answer: ln 1 = 0 each.
    assert failing.fallback.value == pytest.approx(0.33**0.5, rel=0.1)
    assert entry(ranking, "failing", "failed").value == pytest.approx(50.0)
    assert entry(ranking, "failing", "ratio").failures == {"failed": 28}
    assert entry(ranking, "failing", "reason").text == "It gave up."
    everything = fabricate()
    lost = everything["estimator"] == "poor"
    everything.loc[lost, "status"] = "crash"
    everything.loc[lost, "torque_error"] = np.nan
    assert word(everything, "poor") == "undecided"  # equal to the reference it is not


def test_unconverged_answers_are_accepted_or_replaced() -> None:
    cells = fabricate()
    accepted, replaced = (of(cells, "restless", unconverged=u) for u in ("accepted", "replaced"))
    assert figures(accepted)[:3] == figures(replaced)[:3]  # both are printed in any case
    assert accepted.unconverged == 28
    assert accepted.fallback.value == pytest.approx(0.6, rel=0.1)
    assert accepted.replaced.value == pytest.approx(np.sqrt(0.6), rel=0.1)
    words = [word(cells, "restless", unconverged=one) for one in ("accepted", "replaced")]
    assert words == ["better", "undecided"]
    assert of(cells.drop(columns="converged"), "restless").unconverged == 0


def test_equal_answers_count_once_and_are_named() -> None:
    [ranking] = ranked(fabricate())
    assert dict(ranking.same) == {"copy": "good"}
    assert "copy" not in ranking.rank_interval
    assert "copy" not in ranking.corrected
    assert any("as good" in note and "copy" in note for note in verdict_table(ranking).notes)
    twin = fabricate()
    twin = pd.concat([twin, twin[twin["estimator"] == "wls"].assign(estimator="twin")])
    [ranking] = ranked(twin)
    assert entry(ranking, "twin", "verdict").text == "same as wls"


# --- Every figure by its definition, one case at a time -------------------------------------------


def drawn(seed: int, metric: str) -> pd.DataFrame:
    """Cells of four methods on nine robots, in which all that can be is: failures, no value, no
    row, no convergence, errors at the floor and just above it, exact data and a stated truth."""
    rng, rows, floor = np.random.default_rng(seed), [], METRICS[metric].floor
    for robot, repeat in product(range(9), range(4)):
        case = {
            "robot": f"r{robot}",
            "repeat": repeat,
            "plant": "matched",
            "signals": "none, exact",
        }
        case["noise"] = "exact" if repeat == 3 else "tau 1 %"
        case["prior"] = "truth" if robot == 8 and repeat == 1 else "mass 20 %"
        for method in ("wls", "one", "two", "three"):
            kind = rng.choice(["row", "none", "failed", "empty", "floor"], p=[0.8, *[0.05] * 4])
            error = float(rng.lognormal(0.3 * (method == "two"), 0.5))
            error = rng.choice([0.9e-6, 1e-6, 1.1e-6, error]) if repeat == 3 else error
            error = floor * rng.choice([0.5, 1.0, 1.5]) if kind == "floor" else error
            row: dict[str, Any] = {
                "estimator": method,
                "status": "timeout" if kind == "failed" else "ok",
            }
            row[metric] = None if kind in ("failed", "empty") else error
            row["converged"] = [None, True, False][rng.integers(3)]
            rows += [case | row] if kind != "none" else []
    return pd.DataFrame(rows)


@pytest.mark.parametrize("metric", ["parameter_error", "torque_error"])
@pytest.mark.parametrize("seed", range(6))
def test_every_figure_is_that_of_its_definition(seed: int, metric: str) -> None:
    cells, floor = drawn(seed, metric), METRICS[metric].floor
    cells = cells.astype({"converged": object, metric: float})
    keys = ["robot", "repeat", "noise", "prior"]
    of_reference = cells[cells["estimator"] == "wls"].set_index(keys)[metric].to_dict()
    unconverged = ["accepted", "replaced"][seed % 2]
    for method, one in compared(cells, metric=metric, unconverged=unconverged).items():
        logs: dict[str, dict[str, list[float]]] = {
            name: {} for name in ("ratio", "fallback", "replaced")
        }
        statuses, count, restless, laws = Counter[str](), 0, 0, [0, 0]
        for row in cells[cells["estimator"] == method].to_dict("records"):
            error, case = row[metric], tuple(row[key] for key in keys)
            if row["noise"] == "exact":
                laws = [laws[0] + (error <= 1e-6), laws[1] + 1]
                continue
            reference = of_reference.get(case, np.nan)
            if row["prior"] == "truth" or not reference > floor or error <= floor:
                continue
            count += 1
            own = np.log(error / reference)
            for name, replaced in (("ratio", None), ("fallback", 0.0), ("replaced", 0.0)):
                value = replaced if np.isnan(own) else own
                if name == "replaced" and row["converged"] is False:
                    value = 0.0
                if value is not None:
                    logs[name].setdefault(row["robot"], []).append(value)
            if np.isnan(own):
                statuses["no value" if row["status"] == "ok" else row["status"]] += 1
            else:
                restless += row["converged"] is False
        means = {
            name: np.array([np.mean(v) for v in found.values()]) for name, found in logs.items()
        }
        for name, values in means.items():
            assert getattr(one, name).value == pytest.approx(np.exp(np.median(values)), rel=1e-8)
        deciding = means["replaced" if unconverged == "replaced" else "fallback"]
        assert (one.cells, one.unconverged, one.laws) == (count, restless, tuple(laws))
        assert (dict(one.statuses), one.failed) == (dict(statuses), statuses.total())
        assert one.robots == len(deciding)
        rounded = np.where(np.abs(deciding) < 1e-8, 0.0, deciding)
        assert one.p == pytest.approx(rank_test_p(rounded))
        assert one.smallest_p == least_p(int(np.count_nonzero(rounded)))
        own = count - statuses.total() - (restless if unconverged == "replaced" else 0)
        assert one.p_equivalent == pytest.approx(equivalence_p(rounded, 0.1))
        assert one.fallbacks == count - own
        if method != "wls":
            found = verdict(rounded, 0.1, one.p, one.p_equivalent)
            often = own < 0.9 * count and found != "worse"
            given = word(cells, method, metric=metric, unconverged=unconverged)
            assert given == ("undecided" if often else found)
        assert len(one.ratios) == count


@pytest.mark.parametrize("seed", range(4))
def test_ranks_and_wins_are_those_of_their_definition(seed: int) -> None:
    cells = drawn(seed, "parameter_error").astype({"converged": object, "parameter_error": float})
    [ranking] = ranked(cells, metric="parameter_error")
    medians = [np.nanmedian(one.logs) for one in ranking.comparisons]
    assert medians == sorted(medians)
    floor, keys = METRICS["parameter_error"].floor, ["robot", "repeat", "noise", "prior"]
    kept = cells[(cells["noise"] != "exact") & (cells["prior"] != "truth")]
    by_method = {
        name: {
            tuple(row[key] for key in keys): np.inf if np.isnan(row["parameter_error"])
            else max(row["parameter_error"], floor)
            for row in group.to_dict("records")
        }
        for name, group in kept.groupby("estimator")
    }  # fmt: skip
    for i, one in enumerate(ranking.method_names):
        for j, other in enumerate(ranking.method_names):
            a, b = by_method[one], by_method[other]
            wins = [(a[k] < b[k]) + 0.5 * (a[k] == b[k]) for k in a if k in b]
            assert ranking.win_rates[i, j] == pytest.approx(np.mean(wins))


@pytest.mark.parametrize(("share", "is_copy"), [(0.9e-4, True), (1.1e-4, False), (-0.9e-4, True)])
def test_answers_are_the_same_up_to_a_ten_thousandth(share: float, is_copy: bool) -> None:
    cells = fabricate(robots=7)
    copy = cells["estimator"] == "copy"
    good = cells.loc[cells["estimator"] == "good", "torque_error"].to_numpy(dtype=float)
    cells.loc[copy, "torque_error"] = good * (1 + share * np.linspace(0, 1, len(good)))
    [ranking] = ranked(cells)
    assert dict(ranking.same) == ({"copy": "good"} if is_copy else {})
    first = cells.index[copy][0]
    cells.loc[first, "status"] = "failed"  # copies fail alike
    cells.loc[first, "torque_error"] = np.nan
    [ranking] = ranked(cells)
    assert not ranking.same


def test_a_method_that_depends_on_link_frames_is_not_ranked() -> None:
    """Nor counted in the correction; tables and rankings say which, and why."""
    cells, reason = fabricate(), "it favours an axis"
    cells["frame_dependent"] = cells["estimator"].map({"poor": reason})
    [ranking] = ranked(cells, family=["good", "poor"])
    assert "poor" not in ranking.method_names
    assert ranking.verdicts == 1
    assert f"Not ranked: poor: {reason}." in verdict_table(ranking).notes
    table = {"name": "t", "rows": ["estimator"], "metrics": ["torque_error"]}
    assert any("poor" in note for note in build_table(cells, table).notes)
    # A family of such methods alone is not that of all others.
    [ranking] = ranked(cells, family=["poor"])
    assert ranking.verdicts == 0
    # The reference stays, since all ratios refer to it.
    [ranking] = ranked(cells, against="poor")
    assert "poor" in ranking.method_names


def test_a_part_of_a_run_has_the_members_of_the_family_that_ran() -> None:
    cells = fabricate(robots=2)
    part = cells[cells["estimator"].isin(["wls", "good"])]
    for family, kept in ((["poor", "good", "none"], ["good"]), (["poor"], ["wls"]), (None, [])):
        entry = entry_with_cells({"name": "r", "family": family}, part)
        assert entry == {"name": "r", "family": kept}
    # None of them has a verdict, as a family of which no member ran; without one, all have.
    for family, tested in ((["poor"], ()), (None, ("good",))):
        [one] = ranked(part, **entry_with_cells({"name": "r", "family": family}, part))
        assert one.tested == tested


def test_a_title_is_the_given_one_and_names_the_group() -> None:
    cells, name = fabricate(robots=3), METRICS["torque_error"].title
    assert [one.title for one in ranked(cells)] == [f"Methods by {name}"]
    assert [one.title for one in ranked(cells, title="Mine")] == ["Mine"]
    titles = [one.title for one in ranked(cells, title="Mine", apart=["plant"])]
    assert titles == ["Mine: matched", "Mine: stribeck"]
    assert [one.name for one in ranked(cells, apart=["plant"])] == ["r-matched", "r-stribeck"]


# --- No ratio to a zero ---------------------------------------------------------------------------


def test_cells_without_noise_are_a_law_and_have_no_ratio() -> None:
    noisy = fabricate().assign(noise="tau 1 %", plant="matched", signals="none, exact")
    noisy["repeat"] = noisy.groupby(["robot", "payload", "estimator"]).cumcount()
    exact = noisy.assign(noise="exact", torque_error=noisy["torque_error"].astype(float) * 1e-9)
    broken = exact["estimator"] == "poor"
    exact.loc[broken, "torque_error"] = 1e-3
    both = pd.concat([noisy, exact])
    before, after = compared(noisy), compared(both)
    for method in METHODS:
        one, two = before[method], after[method]
        assert one.ratio == two.ratio
        rows = int((exact["estimator"] == method).sum())
        ok = int(exact.loc[exact["estimator"] == method, "torque_error"].notna().sum())
        assert two.laws == (0 if method == "poor" else ok, rows)
    [ranking] = ranked(both)
    assert entry(ranking, "poor", "noise_free").text == "0 of 54"
    # A filter, or a plant that the model lacks, leaves an error that is not one of rounding.
    for biased in (both.assign(signals="butter, from q"), both.assign(plant="stribeck")):
        assert of(biased, "good").laws == (0, 0)


def test_rounding_and_the_truth_have_no_ratio() -> None:
    cells = fabricate()
    first = cells["robot"] == "r0"
    zero = cells.copy()
    zero.loc[first & (zero["estimator"] == "wls"), "torque_error"] = 0.0
    assert of(zero, "good").robots == 13
    told = cells.assign(prior=np.where(first, "truth", "mass 20 %"))
    assert figures(of(told, "good"))[:-1] == figures(of(cells[~first], "good"))[:-1]
    [ranking] = ranked(told.assign(prior="truth"))
    assert [one.robots for one in ranking.comparisons] == [0] * 7
    assert "with the true values as prior" in to_markdown(verdict_table(ranking))


def test_limits_belong_to_what_they_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error at the floor is rounding; a law is kept, and an answer a copy, up to their limit."""
    floor = max(METRICS["torque_error"].floor, float(np.finfo(float).tiny))
    for error, robots in ((floor, 13), (float(np.nextafter(floor, 1.0)), 14)):
        for method in ("wls", "good"):
            cells = fabricate()
            rows = (cells["robot"] == "r0") & (cells["estimator"] == method)
            cells.loc[rows, "torque_error"] = error
            assert of(cells, "good").robots == robots
    cells = fabricate(robots=2)
    cells = cells[cells["estimator"].isin(["wls", "good"])].assign(noise="exact", plant="matched")
    for error, kept in ((rankings.BROKEN, 4), (float(np.nextafter(rankings.BROKEN, 1.0)), 0)):
        one = compared(
            cells.drop_duplicates(["robot", "payload", "estimator"]).assign(torque_error=error)
        )
        assert one["good"].laws == (kept, 4)
    monkeypatch.setattr(rankings, "ALIKE", 0.25)
    for other, is_copy in ((1.25, True), (0.75, True), (1.2500001, False), (0.7499999, False)):
        cells = fabricate(robots=2)
        cells = cells[cells["estimator"].isin(["wls", "good"])]
        cells["torque_error"] = np.where(cells["estimator"] == "wls", 1.0, other)
        [found] = ranked(cells)
        assert bool(found.same) == is_copy


@pytest.mark.parametrize("value", [False, np.False_, 0, 0.0])
def test_an_answer_has_converged_unless_its_row_says_otherwise(value: Any) -> None:
    cells = fabricate(robots=2)

    def said(one: Any) -> pd.DataFrame:
        given = [one if method == "good" else None for method in cells["estimator"]]
        return cells.assign(converged=pd.Series(given, cells.index, dtype=object))

    assert of(said(value), "good").unconverged == 8
    for other in (None, True, 1, np.nan, "no"):
        assert of(said(other), "good").unconverged == 0
    assert of(cells.drop(columns="converged"), "good").unconverged == 0


def test_one_method_is_no_ranking_and_two_are() -> None:
    cells = fabricate(robots=2)
    with pytest.raises(UsageError, match="leaves wls"):
        ranked(cells[cells["estimator"] == "wls"])
    assert len(compared(cells[cells["estimator"].isin(["wls", "good"])])) == 2


def test_the_reason_of_a_method_is_its_most_frequent_one() -> None:
    cells = fabricate(robots=6)
    lost = cells.index[(cells["estimator"] == "failing") & (cells["status"] == "failed")]
    cells.loc[lost, "reason"] = ["seldom" if n % 3 == 0 else "often" for n in range(len(lost))]
    assert of(cells, "failing").reason == "often"
    assert of(cells, "good").reason == ""


def test_profiles_are_drawn_from_a_tenth_to_a_hundred_times() -> None:
    assert RATIOS[[0, -1]] == pytest.approx([0.1, 100.0])
    assert len(RATIOS) == 301
    np.testing.assert_allclose(np.diff(np.log10(RATIOS)), 0.01)


# --- Groups, formats, profiles --------------------------------------------------------------------


def test_plants_are_ranked_apart() -> None:
    cells = fabricate(swap="stribeck")
    words = {r.name: entry(r, "good", "verdict").text for r in ranked(cells, apart=["plant"])}
    assert words == {"r-matched": "better", "r-stribeck": "worse"}


def test_every_format_has_verdicts_and_intervals() -> None:
    [ranking] = ranked(fabricate())
    one = of(fabricate(), "poor")
    for table in ranking_tables(ranking):
        lines = to_csv(table).splitlines()
        assert len(json.loads(to_json(table))["entries"]) == len(lines) - 1 == len(table.entries)
    table = verdict_table(ranking)
    low = f"{one.fallback.low:.2f}"
    for text in (to_markdown(table), to_latex(table, Origin("run", "hash", "command"))):
        assert "worse" in text
        assert low in text
    found = {(e["estimator"], e["metric"]): e for e in json.loads(to_json(table))["entries"]}
    assert found["poor", "verdict"]["text"] == "worse"
    assert found["poor", "fallback"]["low"] == one.fallback.low
    assert "10000 draws, seed 0" in table.description
    assert any("98.7 % (3 to 12 of 14 robots in order)" in note for note in table.notes)


def test_profiles_rise_to_the_share_of_answers() -> None:
    [ranking] = ranked(fabricate())
    shares = ranking.profile
    assert shares.shape == (len(RATIOS), 7)
    assert (np.diff(shares, axis=0) >= 0).all()
    assert shares[-1, ranking.method_names.index("failing")] == pytest.approx(0.5)
    assert shares[-1, ranking.method_names.index("poor")] == pytest.approx(1.0)


def test_a_profile_is_the_same_picture_every_time(tmp_path: Path) -> None:
    [ranking] = ranked(fabricate(robots=3))
    one, two = (profile.write(tmp_path / f"{i}.pdf", ranking).read_bytes() for i in range(2))
    assert one == two
    assert profile.svg(ranking).startswith("<svg")
    with pytest.raises(UsageError, match=r"\.pdf, \.png or \.svg"):
        profile.write(tmp_path / "profile.jpg", ranking)
