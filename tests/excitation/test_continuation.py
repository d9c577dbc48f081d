"""Continuation in the limits of a box, prices of limits, and the margin of a search."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.commands.excite import ExciteRequest, excite
from sysid_bench.commands.excite_design import BALANCED
from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_cost import DesignCost, limit_sensitivity
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.optimised import (
    Design,
    Optimised,
    design_criterion,
    excitation_parameters,
)
from sysid_bench.excitation.search import WIDENED, Search, scale_limits
from tests.closeness import assert_close
from tests.excitation.test_optimised import brief
from tests.robots import named_robot

SCARA = named_robot("scara")
BOX = {SCARA.body_names[SCARA.tool_body]: [[0.1, 0.9], [-0.5, 0.5], [-1.0, 1.0]]}


def _made(**settings: object) -> Optimised:
    return Optimised("cond", harmonics=2, period=5.0, iterations=12, **settings)  # type: ignore[arg-type]


def _solved(method: Optimised, given: DesignProblem) -> Design:
    return method.solve(given, np.random.default_rng(0))


@pytest.fixture(scope="module")
def boxed() -> tuple[DesignProblem, Design, Design]:
    """A problem, its design, and its design within a box."""
    given = brief(SCARA)
    return given, _solved(_made(), given), _solved(_made(boxes=BOX), given)


def test_a_box_costs_and_the_motion_keeps_it(boxed: tuple[DesignProblem, Design, Design]) -> None:
    given, free, held = boxed
    assert free.without is None
    assert held.without is not None
    assert held.without <= held.value + 1e-12
    uses = _made(boxes=BOX).report(held.C, given)
    assert all(used.use <= 1.0 for used in uses.values())
    assert _made(boxes=BOX).report(free.C, given)["box"].use > 1.0


def test_widened_limits_are_used_less_by_the_factor(
    boxed: tuple[DesignProblem, Design, Design],
) -> None:
    given, _, held = boxed
    method = _made(boxes=BOX)
    limits = method.limits(given)
    motion = method.space(given).motion(held.C, np.linspace(0.0, 4.9, 30))
    (box,) = (limit for limit in limits if limit.kind == "box")
    wide = tuple(scale_limits(limits, WIDENED, 2.0))
    assert [limit.kind for limit in wide] == [limit.kind for limit in limits]
    (other,) = (limit for limit in wide if limit.kind == "box")
    assert_close(2 * other.use(motion), box.use(motion))
    G = np.ones_like(box.use(motion))
    for half, whole in zip(other.slopes(motion, G), box.slopes(motion, G), strict=True):
        assert_close(2 * half, whole)
    assert "box" not in {limit.kind for limit in scale_limits(limits, WIDENED, np.inf)}


def _evaluation(method: Optimised, given: DesignProblem) -> DesignCost:
    space = method.space(given)
    draws = method.random_coefficients(space, np.random.default_rng(0))
    assert given.regress is not None
    information = excitation_parameters(space, given.regress, draws)
    criterion = design_criterion(method.objective, information, space, draws)
    return DesignCost(space, information.smooth, criterion, method.limits(given, 0.98))


@pytest.mark.long
def test_prices_predict_what_wider_limits_save() -> None:
    """At an optimum, limits of one kind 2 % wider lower ln cond by 2 % of the sum of their prices:
    searched again from the optimum, since another start may end in another optimum."""
    given = brief(SCARA)
    method = replace(_made(), iterations=300)
    design = _solved(method, given)
    prices = list(design.prices.prices.values())
    assert prices == sorted(prices, reverse=True)
    assert BALANCED < design.prices.balance <= 1.0

    def best(kind: str, factor: float) -> float:
        whole = _evaluation(method, given)
        limits = tuple(scale_limits(whole.limits, [kind], factor))
        evaluation = replace(whole, limits=limits)
        Search(evaluation).solve_bounded(design.C, 100, (1000.0, 1000.0))
        return evaluation.best

    for kind in ("position", "velocity", "acceleration"):
        price = sum(p for name, p in design.prices.prices.items() if name.startswith(kind))
        saved = best(kind, 1.0) - best(kind, 1.02)
        assert saved == pytest.approx(0.02 * price, rel=0.3, abs=1e-3), kind


def test_limits_without_effect_have_no_price() -> None:
    given = brief(SCARA)
    method = _made()
    C = 0.3 * method.random_coefficients(method.space(given), np.random.default_rng(1))[0]
    assert limit_sensitivity(_evaluation(method, given), C).prices == {}


def test_prices_of_a_motion_that_is_not_an_optimum_are_rough() -> None:
    given = brief(SCARA)
    method = _made()
    space = method.space(given)
    C = method.random_coefficients(space, np.random.default_rng(1))[0]
    evaluation = _evaluation(method, given)
    largest = evaluation.smooth_limits(C, 1000.0)[0].max()
    assert limit_sensitivity(evaluation, 0.99 * C / largest).balance < BALANCED
    settings = {"harmonics": 2, "period": 5.0, "iterations": 3, "clearance": None}
    made = excite(ExciteRequest("scara", objective="cond", settings=settings))
    for balance, said in ((0.5, True), (0.95, False)):
        priced = replace(made, prices={"velocity elbow": 0.2}, prices_balance=balance)
        assert ("these prices are rough" in priced.summary()) == said


@pytest.mark.parametrize(
    ("objective", "expected"),
    [
        ("cond", 50 / np.e),
        ("cond-unit", 5 / np.e),
        ("D", 90 + 12),
        ("E", 0.2 * np.e**0.5),
        ("A", 2),
    ],
)
def test_what_a_box_costs_is_in_the_unit_of_the_objective(objective: str, expected: float) -> None:
    """A criterion that is smaller by one: every figure gets better, by its own definition."""
    settings = {"harmonics": 2, "period": 5.0, "iterations": 3, "clearance": None}
    made = excite(ExciteRequest("scara", objective="cond", settings=settings))
    boxed = replace(
        made, objective=objective, value=3.0, value_without_box=2.0, rank=12, condition=50.0,
        condition_unit=5.0, log_det=90.0, smallest_singular_value=0.2,
    )  # fmt: skip
    assert f"without the box: {expected:.4g})" in boxed.summary()


def test_the_margin_is_a_setting() -> None:
    given = brief(SCARA)
    for margin in (0.3, 0.01):
        method = _made(margin=margin)
        used = max(use.use for use in method.report(_solved(method, given).C, given).values())
        assert used <= 1.02 * (1 - margin)
    for wrong in (-0.1, 0.5, np.nan):
        with pytest.raises(UsageError, match="margin"):
            _made(margin=wrong)


def test_the_answer_begins_with_the_number_of_the_objective() -> None:
    request = ExciteRequest(
        "scara",
        objective="cond-unit",
        settings={"harmonics": 2, "period": 5.0, "iterations": 12, "clearance": None},
    )
    result = excite(request)
    second = result.summary().splitlines()[1]
    assert second.startswith(f"  cond-unit: {result['condition_unit']:.4g} (median random motion")
    assert result["value_without_box"] is None
    for name in list(result["prices"])[:1]:
        assert f"price of {name}: 1 % wider saves" in result.summary()


@pytest.mark.parametrize("factor", [1.005, 1.01])
def test_a_motion_beyond_its_limits_is_pulled_inside_by_the_least_move(
    boxed: tuple[DesignProblem, Design, Design], factor: float
) -> None:
    given, _, held = boxed
    method = _made(boxes=BOX)
    space = method.space(given)
    assert given.regress is not None
    information = excitation_parameters(space, given.regress, [held.C])
    criterion = design_criterion(method.objective, information, space, [held.C], ())
    finer = DesignCost(space, information.smooth, criterion, method.limits(given), density=10)
    outside = factor * held.C
    assert finer.largest_use(outside) > 1.0
    inside = Search(finer).nearest_feasible(outside)
    assert 0.99 < finer.largest_use(inside) <= 1.0
    assert np.abs(inside - outside).max() <= 2 * (factor - 1) * np.abs(held.C).max()
