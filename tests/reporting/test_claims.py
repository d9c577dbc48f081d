"""Claims from rows whose errors are known: verdicts, pairs, lost answers, absent rows."""

from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.evaluation.robot_statistic import median_figure, rank_figure, ratio_figure
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.claims import (
    ClaimFinding,
    ClaimRows,
    claim_findings,
    correct_findings,
)

ROBOTS = ("ur5", "panda", "so100", "z1", "scara", "tx40", "kinova")
FACTORS = {"wls": 1.0, "good": 0.5, "bad": 3.0}
CLAIM: dict[str, Any] = {
    "name": "first", "statement": "Good is better", "source": "nobody 2026", "level": ("L1",),
    "select": 'estimator == "good"', "against": 'estimator == "wls"', "statistic": "ratio",
    "metric": "torque_error", "meets": None, "direction": "at most", "threshold": (1.0,),
    "over": "robot", "gate": False, "missing": None,
}  # fmt: skip


def cells(seed: int = 0, robots: tuple[str, ...] = ROBOTS) -> pd.DataFrame:
    """Errors of three methods at two levels, twice; at L2 all methods err alike."""
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for robot, plant, repeat in product(robots, ("L1", "L2"), (0, 1)):
        case = rng.uniform(0.01, 0.1)
        for method, factor in FACTORS.items():
            error = case * (factor if plant == "L1" else rng.uniform(0.8, 1.25))
            rows.append(
                {"id": f"{len(rows):012x}", "robot": robot, "plant": plant, "repeat": repeat,
                 "estimator": method, "status": "ok", "reason": None, "run": "0",
                 "noise": "low", "torque_error": error, "stats.steps": 2.0}
            )  # fmt: skip
    return pd.DataFrame(rows)


def found(lines: pd.DataFrame, **changes: Any) -> ClaimFinding:
    """The first finding of the claim with some keys changed."""
    rows = ClaimRows(
        suite="tested",
        lines=lambda kind: lines,
        choose=lambda text, row: Expression.parse(text).holds(row),
        fields=lambda text: Expression.parse(text).fields,
        metrics=METRICS,
    )
    return next(claim_findings({**CLAIM, **changes}, rows))


def test_verdicts_are_those_of_the_known_errors() -> None:
    lines = cells()
    better = found(lines)
    assert (better.verdict, better.count, better.cells, better.lost) == ("holds", 7, 14, 0)
    assert better.value == pytest.approx(0.5)
    assert found(lines, select='estimator == "bad"').verdict == "fails"
    assert found(lines, level=("L2",)).verdict == "open"
    assert found(lines, statistic="difference", threshold=(0.0,)).verdict == "holds"
    ranks = {
        method: found(
            lines, statistic="rank", select=f'estimator == "{method}"', threshold=(9.0,),
            against=f'estimator in ["wls", "good", "bad"] and estimator != "{method}"',
        ).value
        for method in FACTORS
    }  # fmt: skip
    assert ranks == {"good": 1.0, "wls": 2.0, "bad": 3.0}


@pytest.mark.parametrize("seed", range(4))
def test_other_rows_change_nothing(seed: int) -> None:
    lines = cells(seed)
    rng = np.random.default_rng(seed)
    for level in ("L1", "L2"):
        whole = found(lines, level=(level,))
        used = (lines["plant"] == level) & lines["estimator"].isin(["good", "wls"])
        others = lines[~used].assign(torque_error=rng.uniform(0, 1e6, (~used).sum()))
        mixed = pd.concat([others, lines[used]]).sample(frac=1.0, random_state=seed)
        for fewer in (lines[used], mixed.reset_index(drop=True)):
            assert found(fewer, level=(level,)) == whole


def test_cells_without_an_answer_count_as_the_reference_and_forbid_holding() -> None:
    lines = cells()
    good = lines.index[(lines["estimator"] == "good") & (lines["plant"] == "L1")]
    one = lines.copy()
    one.loc[good[:1], "status"] = "failed"
    assert (found(one).verdict, found(one).lost) == ("holds", 1)
    three = lines.copy()
    three.loc[good[:3], "status"] = "failed"
    finding = found(three)
    assert (finding.verdict, finding.reason) == ("open", "3 of 14 cells have no answer")
    everything = lines.copy()
    everything.loc[good[1:], "status"] = "timeout"
    assert found(everything, direction="at least", threshold=(0.99,)).value == pytest.approx(1.0)


def test_pairs_are_of_one_case_and_one_run() -> None:
    lines = cells()
    for label in ("noise", "run"):
        other = lines.assign(**{label: lines["estimator"].map({"wls": "1"}).fillna("2")})
        assert found(other).reason == "no case has rows of both selections"
    twice = pd.concat([lines, lines.assign(run="1")], ignore_index=True)
    assert found(twice).value == pytest.approx(0.5)
    assert (found(twice).cells, found(twice).count) == (28, 7)
    # What the selections compare may differ: here the plant, and the noise that follows from it.
    plants = lines.assign(noise=lines["plant"])
    across = found(
        plants, level=(), select='estimator == "good" and plant == "L1"',
        against='estimator == "good" and plant == "L2"',
    )  # fmt: skip
    assert (across.verdict, across.cells, across.level) == ("holds", 14, "L1")


def test_few_robots_leave_a_claim_open() -> None:
    finding = found(cells(robots=ROBOTS[:5]))
    assert (finding.verdict, finding.reason) == ("open", "5 robots: no interval")


@pytest.mark.parametrize("robots", [ROBOTS[:1], ROBOTS])
def test_cells_decide_nothing_however_many_they_are(robots: tuple[str, ...]) -> None:
    lines = pd.concat([cells(seed, robots) for seed in range(8)], ignore_index=True)
    for select in ('estimator == "good"', 'estimator == "bad"'):
        finding = found(lines, select=select, over="cell")
        assert (finding.verdict, finding.low, finding.high) == ("open", None, None)
        assert "one robot may have all of them" in finding.reason
        assert finding.value == pytest.approx(0.5 if "good" in select else 3.0)


def test_shares_count_failures() -> None:
    lines = cells()
    share: dict[str, Any] = {
        "statistic": "share", "metric": None, "against": None, "direction": "at least",
        "meets": 'status == "ok" and torque_error < 1', "threshold": (1.0,),
    }  # fmt: skip
    assert found(lines, **share).verdict == "open"  # seven robots of seven do not show all
    share["threshold"] = (0.55,)
    assert found(lines, **share).verdict == "holds"
    one = lines.copy()
    one.loc[(lines["estimator"] == "good") & (lines["robot"] == "ur5"), "status"] = "failed"
    assert found(one, **share).verdict == "open"
    assert found(one, **{**share, "threshold": (1.0,)}).verdict == "fails"
    lines.loc[lines["estimator"] == "good", "status"] = "crash"
    assert found(lines, **share).verdict == "fails"


def test_equal_coverages_are_open_with_the_reason() -> None:
    lines = cells().assign(torque_error=1.0)
    changes: dict[str, Any] = {"statistic": "coverage", "against": None, "threshold": (2.0,)}
    finding = found(lines, **changes)
    assert (finding.verdict, finding.reason) == ("open", "7 robots: no interval (no spread)")


@pytest.mark.parametrize("lost", ["first", "middle", "last", "all", "refused"])
@pytest.mark.parametrize("statistic", ["ratio", "difference", "rank", "median", "share"])
def test_a_method_that_loses_answers_does_not_hold(statistic: str, lost: str) -> None:
    lines = cells()
    own = lines.index[(lines["estimator"] == "good") & (lines["plant"] == "L1")]
    parts = {"first": own[:2], "middle": own[6:8], "last": own[-2:]}
    status = "unsupported" if lost == "refused" else "failed"
    changes: dict[str, Any] = {"statistic": statistic, "threshold": (3.0,)}
    if statistic in ("median", "share"):
        changes["against"] = None
    if statistic == "share":
        changes |= {"metric": None, "meets": 'status == "ok"', "direction": "at least"}
        changes["threshold"] = (0.55,)
    assert found(lines, **changes).verdict == "holds"
    lines.loc[parts.get(lost, own), "status"] = status
    finding = found(lines, **changes)
    assert finding.verdict != "holds"
    assert finding.reason or finding.verdict == "fails"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"level": ("L4",)}, "no rows at L4"),
        ({"select": 'estimator == "none"'}, "no rows of the claim"),
        ({"against": 'estimator == "none"'}, "no rows of the reference"),
        ({"metric": "seconds"}, "no row has the metric seconds"),
        ({"over": "payload"}, "no row has the label payload"),
        ({"missing": "a thermometer"}, "needs a thermometer"),
    ],
)
def test_what_is_absent_is_named(changes: dict[str, Any], reason: str) -> None:
    finding = found(cells(), **changes)
    assert finding.verdict == "not testable"
    assert finding.reason.startswith(reason)


def test_methods_that_do_not_apply_have_no_rows() -> None:
    lines = cells()
    chosen = lines["estimator"] == "good"
    lines.loc[chosen, ["status", "reason"]] = ["unsupported", "needs a controller"]
    assert found(lines).reason == "no rows of the claim (14 unsupported: needs a controller)"


def test_counts_of_methods_are_metrics() -> None:
    steps: dict[str, Any] = {"statistic": "median", "metric": "stats.steps", "against": None}
    assert found(cells(), **steps, threshold=(3.0,)).verdict == "holds"
    assert found(cells(), **steps, threshold=(1.0,)).verdict == "fails"


def test_values_are_held_against_the_ranges_of_the_other_units() -> None:
    rng = np.random.default_rng(0)
    lines = pd.DataFrame([
        {"id": f"{n}", "excitation": f"run {n}", "estimator": "good", "status": "ok",
         "plant": plant, "reason": None, "run": "0", "parameter": f"joint{p}.fc",
         "estimate": float(rng.normal()) + (9.0 if plant == "L2" and n == 0 else 0.0),
         "verdict": "at bound" if p == 0 and n == 3 else "identifiable"}
        for plant in ("L1", "L2") for n in range(8) for p in range(60)
    ])  # fmt: skip
    changes = {"statistic": "left-out", "metric": None, "against": None, "over": "excitation",
               "direction": "within", "threshold": (0.8, 0.97)}  # fmt: skip
    same = found(lines, **changes)
    # Of 60 parameters one is on its bound in a run.
    assert (same.count, same.cells) == (8, 8 * 59)
    assert same.value == pytest.approx(0.9, abs=0.05)
    apart = found(lines, level=("L2",), **changes)
    assert apart.value is not None
    assert apart.low is not None
    assert apart.low < 0.8
    few = found(lines[lines["excitation"].isin(["run 0", "run 1"])], **changes)
    assert few.verdict == "not testable"


# --- Every figure by its definition, one case at a time -------------------------------------------


def drawn(seed: int) -> pd.DataFrame:
    """Rows of four methods at two levels, in which all that can be is: failures, refusals, no
    value, infinite values, rounding, and two rows of one case."""
    rng, rows = np.random.default_rng(seed), []
    floor = METRICS["parameter_error"].floor  # errors up to it are rounding
    for robot, plant, repeat in product(ROBOTS, ("L1", "L2"), range(4)):
        for method in ("good", "wls", "bad", "odd"):
            for _ in range(1 + (rng.random() < 0.1)):
                kind = rng.choice(["ok", "failed", "unsupported", "none", "inf", "tiny"],
                                  p=[0.85, 0.05, 0.02, 0.02, 0.03, 0.03])  # fmt: skip
                value = {"none": np.nan, "inf": np.inf, "tiny": floor}.get(kind, rng.lognormal())
                rows.append(
                    {"robot": robot, "plant": plant, "repeat": repeat, "estimator": method,
                     "run": "0", "status": kind if kind in ("failed", "unsupported") else "ok",
                     "reason": None, "parameter_error": float(value)}
                )  # fmt: skip
    return pd.DataFrame(rows)


def by_case(lines: pd.DataFrame, method: str) -> dict[tuple[str, int], float]:
    """Mean of the answers of each case of a method at L1, NaN where there is none."""
    chosen = lines[(lines["estimator"] == method) & (lines["plant"] == "L1")]
    found: dict[tuple[str, int], list[float]] = {}
    for row in chosen.to_dict("records"):
        if row["status"] != "unsupported":
            values = found.setdefault((row["robot"], row["repeat"]), [])
            is_answer = row["status"] == "ok" and np.isfinite(row["parameter_error"])
            values += [row["parameter_error"]] * int(is_answer)
    return {case: float(np.mean(v)) if v else np.nan for case, v in found.items()}


def robot_means(values: dict[tuple[str, int], float]) -> dict[str, float]:
    robots: dict[str, list[float]] = {}
    for (robot, _), value in values.items():
        if not np.isnan(value):
            robots.setdefault(robot, []).append(value)
    return {robot: float(np.mean(robots[robot])) for robot in sorted(robots)}


def logs_of(own: dict[Any, float], against: dict[Any, float]) -> dict[Any, float]:
    """ln of the ratio of each case with a reference; 0 without an own answer, none of rounding."""
    floor, found = METRICS["parameter_error"].floor, {}
    for case in own.keys() & against.keys():
        if not np.isnan(against[case]):
            value = against[case] if np.isnan(own[case]) else own[case]
            if value > floor and against[case] > floor:
                found[case] = float(np.log(value / against[case]))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_every_figure_is_that_of_its_definition(seed: int) -> None:
    lines = drawn(seed)
    own, wls = by_case(lines, "good"), by_case(lines, "wls")
    pairs = [case for case in own if not np.isnan(wls.get(case, np.nan))]
    metric = {"metric": "parameter_error", "threshold": (1.0,)}
    logs = np.array([*robot_means(logs_of(own, wls)).values()])
    differences = {c: (wls[c] if np.isnan(own[c]) else own[c]) - wls[c] for c in pairs}
    apart = np.array([*robot_means(differences).values()])
    for statistic, figure in (("ratio", ratio_figure(logs)), ("difference", median_figure(apart))):
        finding = found(lines, statistic=statistic, **metric)
        assert finding.value == pytest.approx(figure.value)
        assert (finding.low, finding.high) == pytest.approx((figure.low, figure.high))
        assert (finding.count, finding.cells) == (figure.count, len(pairs))
        assert finding.lost == sum(np.isnan(own[case]) for case in pairs)
    good = lines[(lines["estimator"] == "good") & (lines["plant"] == "L1")]
    good = good[good["status"] != "unsupported"]
    answers = good["parameter_error"].where(
        (good["status"] == "ok") & np.isfinite(good["parameter_error"])
    )
    medians = answers.groupby(good["robot"]).mean().to_numpy()
    finding = found(lines, statistic="median", against=None, **metric)
    assert finding.value == pytest.approx(np.median(medians))
    assert (finding.cells, finding.lost) == (len(good), int(answers.isna().sum()))
    met = (good["status"] == "ok") & (good["parameter_error"] < 1)
    share = met.groupby(good["robot"]).mean().to_numpy(dtype=float)
    finding = found(
        lines, statistic="share", metric=None, against=None,
        meets='status == "ok" and parameter_error < 1',
    )  # fmt: skip
    assert finding.value == pytest.approx(share.mean())
    assert (finding.cells, finding.lost) == (len(good), 0)


@pytest.mark.parametrize("seed", range(4))
def test_a_rank_is_among_the_robots_that_all_methods_answer(seed: int) -> None:
    lines = drawn(seed)
    lines.loc[(lines["estimator"] == "odd") & (lines["robot"] == "ur5"), "status"] = "failed"
    own = by_case(lines, "good")
    of_others = [
        robot_means(logs_of(own, by_case(lines, other))) for other in ("bad", "odd", "wls")
    ]
    robots = [robot for robot in sorted(ROBOTS) if all(robot in one for one in of_others)]
    table = np.array([[0.0, *(-one[robot] for one in of_others)] for robot in robots])
    figure, finding = (
        rank_figure(table),
        found(lines, statistic="rank", against='estimator != "good"', metric="parameter_error"),
    )
    assert "ur5" not in robots
    assert (finding.value, finding.count) == (figure.value, len(robots))
    assert (finding.low, finding.high) == (figure.low, figure.high)


def test_an_interval_of_the_bootstrap_has_no_p_and_no_part_in_the_correction() -> None:
    """A sign test of eight robots is never below 2^-7; far ends of a bootstrap are."""
    lines = cells(robots=tuple(f"r{k}" for k in range(8)))
    rank = found(
        lines, statistic="rank", against='estimator != "good"', direction="at most",
        threshold=(1.0,),
    )  # fmt: skip
    ratio = found(lines, statistic="ratio")
    assert (rank.p, rank.verdict) == (None, "holds")
    assert ratio.p is not None
    assert ratio.p >= 2.0**-7 * (1 - 1e-3)
    assert correct_findings([rank] * 9 + [ratio])[-1] == correct_findings([ratio])[0]


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, "cell"), ({"select": 'joint == "j1"'}, "joint"), ({"over": "joint"}, "joint"),
        ({"metric": "joint_error"}, "joint"), ({"meets": "joint_error < 1"}, "joint"),
        ({"statistic": "left-out", "metric": None}, "left-out"),
    ],
)  # fmt: skip
def test_a_claim_looks_at_the_lines_of_its_fields(changes: dict[str, Any], wanted: str) -> None:
    asked: list[str] = []

    def lines(kind: str) -> pd.DataFrame:
        asked.append(kind)
        return cells()[:0]

    fields = ClaimRows(
        "s", lines, lambda text, row: True, lambda t: Expression.parse(t).fields, METRICS
    )
    next(claim_findings({**CLAIM, **changes}, fields))
    assert asked == [wanted]


def test_one_row_is_tested_and_decides_nothing() -> None:
    lines = cells(robots=ROBOTS[:1])
    one = lines[(lines["plant"] == "L1") & (lines["repeat"] == 0)]
    for statistic, against in (("ratio", CLAIM["against"]), ("median", None)):
        finding = found(one, statistic=statistic, against=against)
        assert (finding.verdict, finding.count, finding.cells) == ("open", 1, 1)


def test_what_is_not_testable_counts_nothing() -> None:
    for changes in ({"missing": "a thermometer"}, {"level": ("L4",)}, {"metric": "seconds"}):
        finding = found(cells(), **changes)
        assert (finding.count, finding.cells, finding.lost) == (0, 0, 0)
        assert (finding.value, finding.low, finding.high) == (None, None, None)
        assert finding.level == changes.get("level", ("L1",))[0]
    assert found(cells(), missing="a thermometer", level=()).level == "-"


@pytest.mark.parametrize("of", [20, 30])
def test_a_tenth_of_the_cells_may_be_lost(of: int) -> None:
    """At a tenth a claim still holds, with one more it is open."""
    lines = pd.concat([cells(repeat).assign(run=str(repeat)) for repeat in range(5)])
    lines = lines[(lines["plant"] == "L1")].reset_index(drop=True)
    own = lines.index[lines["estimator"] == "good"]
    lines = lines.drop(own[of:])
    for lost, verdict in ((of // 10, "holds"), (of // 10 + 1, "open")):
        fewer = lines.copy()
        fewer.loc[own[:of][:: of // lost][:lost], "status"] = "failed"
        finding = found(fewer, statistic="median", against=None)
        assert (finding.verdict, finding.lost, finding.cells) == (verdict, lost, of)
