"""Built-in estimators keep the laws of the kit; wrong estimators are found by the violated law."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sysid_bench.apps.conformance import EXECUTOR, KITS, TestProblem, check, failed_checks
from sysid_bench.apps.conformance.estimator import (
    UNMOVED_SHARE,
    estimator_cases,
    estimator_problems,
    frame_deviation,
    with_moved_frames,
)
from sysid_bench.commands.check_plugin import KINDS as CHECKED
from sysid_bench.commands.check_plugin import check_plugin
from sysid_bench.commands.main import main
from sysid_bench.errors import EstimationError
from sysid_bench.identification.estimators.linear import OLS
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import solve, stacked_factor
from sysid_bench.plugin_names import BUILTIN, build, resolve
from sysid_bench.pytest_plugin import assert_conforms, assert_engines_agree
from sysid_bench.types import Estimate, Problem

LINEAR = sorted(
    name for name in BUILTIN["estimator"] if hasattr(resolve("estimator", name), "solve")
)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n == "log-cholesky" else ()) for n in LINEAR]
)
def test_our_estimators_keep_the_laws(name: str) -> None:
    assert_conforms(name)


@pytest.mark.parametrize("name", LINEAR)
def test_a_method_without_bias_solves_an_exact_problem(name: str) -> None:
    """A law that never applies proves nothing."""
    estimator = build("estimator", name)
    exact = [case for case in estimator_cases(False) if case.exact]
    assert any(identify(estimator, case.problem).status == "ok" for case in exact)


DECLARED = [name for name in LINEAR if getattr(resolve("estimator", name), "frame_dependent", "")]


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.long if n == "log-cholesky" else ()) for n in DECLARED],
)
def test_who_declares_that_it_depends_on_link_frames_does(name: str) -> None:
    """By more than the kit allows others, so that a ranking leaves no method out without need."""
    estimator = build("estimator", name)
    noisy = [case.problem for case in estimator_cases(False) if not case.exact]
    moved = [frame_deviation(estimator, one, identify(estimator, one)) for one in noisy]
    assert max(one for one in moved if one is not None) > UNMOVED_SHARE


def test_moved_frames_leave_torques_and_rank() -> None:
    for case in estimator_cases(False):
        problem, moved = case.problem, with_moved_frames(case.problem, np.random.default_rng(1))
        assert moved.base.rank == problem.base.rank
        np.testing.assert_allclose(moved.b, problem.b, atol=0)
        fits = [np.linalg.lstsq(one.W, one.b, rcond=None)[0] for one in (problem, moved)]
        torques = [one.W @ beta for one, beta in zip((problem, moved), fits, strict=True)]
        scale = np.abs(torques[0]).max()
        np.testing.assert_allclose(torques[0], torques[1], atol=1e-7 * scale)
        assert not np.allclose(fits[0], fits[1])


@dataclass(frozen=True)
class Favourite:
    """Least squares with one parameter of the file's choice set to zero."""

    frame_dependent: str = ""

    def solve(self, problem: Problem) -> Estimate:
        beta = beta_of(problem)
        beta[-1] = 0.0
        return Estimate(beta)


def test_an_undeclared_dependence_on_frames_is_found() -> None:
    cases = [case for case in estimator_cases(False) if not case.exact]
    assert "frames of the links" in "\n".join(failed_checks(check(Favourite(), cases)))
    declared = failed_checks(check(Favourite("it favours one"), cases))
    assert "frames of the links" not in "\n".join(declared)


# --- Wrong on purpose ---------------------------------------------------------------------------


def beta_of(problem: Problem) -> np.ndarray:
    beta = OLS().solve(problem).beta
    assert beta is not None
    return beta


@dataclass(frozen=True)
class Wrong:
    """Least squares with one mistake."""

    answer: Callable[[Problem], Any]

    def solve(self, problem: Problem) -> Any:
        return self.answer(problem)


def mutating(problem: Problem) -> Estimate:
    beta = beta_of(problem)
    problem.factors[0].R[0, 0] += 1.0
    return Estimate(beta)


def writing_to_the_input(problem: Problem) -> Estimate:
    beta = beta_of(problem)
    R = problem.factors[0].R
    R.flags.writeable = True
    R *= 1.0 + 1e-12
    R.flags.writeable = False
    return Estimate(beta)


def returning_the_prior(problem: Problem) -> Estimate:
    if problem.prior is None:
        raise EstimationError("This method needs a prior.")
    return Estimate(theta=problem.prior.theta)


calls = count()

WRONG: dict[str, tuple[Callable[[Problem], Any], str]] = {
    "biased": (lambda p: Estimate(1.001 * beta_of(p)), "recovers exact parameters"),
    "mutating": (mutating, "leaves its input unchanged"),
    "writing": (writing_to_the_input, "leaves its input unchanged"),
    "silent": (lambda p: Estimate(status="failed"), "gives a reason on failure"),
    "failing": (
        lambda p: Estimate(status="failed", reason="the solver gave up"),
        "returns an estimate",
    ),
    "zero": (lambda p: Estimate(np.zeros(p.base.rank)), "uses the data"),
    "returning the prior": (returning_the_prior, "uses the data"),
    "random": (lambda p: Estimate(beta_of(p) + 1e-13 * next(calls)), "is deterministic"),
    "depending on units": (
        lambda p: Estimate(beta_of(p) * (1 + 1e-3 * (np.abs(p.factors[0].R).max() > 200))),
        "is invariant to the unit",
    ),
    "weighing one joint": (
        lambda p: Estimate(solve(stacked_factor(p, [9.0] + [1.0] * (len(p.factors) - 1)))),
        "is invariant to the order",
    ),
    "minimum norm": (
        lambda p: Estimate(np.linalg.lstsq(p.W, p.b)[0]),
        "refuses unexcited parameters",
    ),
    "raising": (lambda p: 1 / 0, "ZeroDivisionError"),
}


def copied() -> tuple[TestProblem, ...]:
    """Test problems of this test alone: a wrong method may damage them."""
    return estimator_problems()[2:5]


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_estimator_is_caught(name: str) -> None:
    answer, law = WRONG[name]
    lines = failed_checks(check(Wrong(answer), copied()))
    assert lines
    assert any(law in line for line in lines), lines


def test_least_squares_itself_is_not_caught() -> None:
    """The wrong estimators above differ from it by their mistake alone."""
    assert failed_checks(check(Wrong(lambda p: OLS().solve(p)), copied())) == []


def test_a_declared_bias_is_accepted() -> None:
    class Shrunk(Wrong):
        bias = "shrunk by a thousandth"

    assert failed_checks(check(Shrunk(lambda p: Estimate(0.999 * beta_of(p))), copied())) == []


def test_a_null_model_has_to_be_the_prior() -> None:
    class Null(Wrong):
        bias, uses_data = "that of the prior", False

    assert failed_checks(check(Null(returning_the_prior), copied())) == []
    lines = failed_checks(check(Null(lambda p: Estimate(beta_of(p))), copied()))
    assert any("its estimate is not the prior" in line for line in lines)


# --- The command --------------------------------------------------------------------------------

MINE = """
from dataclasses import dataclass
import numpy as np
from sysid_bench.types import Estimate

@dataclass(frozen=True)
class Mine:
    factor: float = {factor}
    def solve(self, problem):
        beta, _, rank, _ = np.linalg.lstsq(problem.W, problem.b)
        if rank < problem.base.rank:
            return Estimate(status="failed", reason=f"only rank {{rank}} is excited")
        return Estimate(self.factor * beta)
"""


@pytest.mark.parametrize(("factor", "code"), [(1.0, 0), (1.1, 1)])
def test_check_plugin_finds_a_wrong_estimator(factor: float, code: int, tmp_path: Any) -> None:
    file = tmp_path / "mine.py"
    file.write_text(MINE.format(factor=factor))
    result = CliRunner().invoke(main, ["check-plugin", f"file:{file}:Mine"])
    assert result.exit_code == code, result.output
    assert ("recovers exact parameters" in result.output) == bool(code)
    assert ("keeps its laws" in result.output) == (not code)
    assert "not checked" not in result.output  # it has `solve`


def test_failed_checks_have_todays_keys_and_those_of_earlier_versions(tmp_path: Any) -> None:
    file = tmp_path / "mine.py"
    file.write_text(MINE.format(factor=1.1))
    answer = check_plugin(f"file:{file}:Mine").to_dict()
    assert answer["plugin"] == answer["estimator"] == f"file:{file}:Mine"
    for failed in answer["broken"]:
        assert failed.keys() == {"law", "case", "message", "world", "said"}
        assert (failed["case"], failed["message"]) == (failed["world"], failed["said"])
    assert "exact data give beta" in answer["broken"][0]["message"]


def test_the_command_checks_every_kind_with_a_kit() -> None:
    assert {kind.replace("-", "_") for kind in CHECKED} == {*KITS, EXECUTOR}
    assert {*KITS, EXECUTOR} <= set(BUILTIN)


def test_check_plugin_names_the_nearest_estimator() -> None:
    result = CliRunner().invoke(main, ["check-plugin", "hubert"])
    assert result.exit_code == 2
    assert "Did you mean 'huber'" in result.output


@pytest.mark.parametrize(
    "name",
    ["iv", "didim", *(pytest.param(name, marks=pytest.mark.long) for name in ("clie", "ekf"))],
)
def test_check_plugin_runs_methods_that_simulate(name: str) -> None:
    answer = check_plugin(name)
    assert answer["ok"], answer["broken"]
    assert answer["checks"] > 10
    # None of them has `solve`.
    assert "not checked: whether its answer depends on the frames" in answer.summary()


def test_engines_agree_on_a_model_and_a_broken_one_is_named(tmp_path: Path) -> None:
    assert_engines_agree("ur5", samples=5)
    (tmp_path / "broken.urdf").write_text("<robot name='x'/>")
    with pytest.raises(AssertionError, match="broken"):
        assert_engines_agree(str(tmp_path / "broken.urdf"))
