"""Coefficients get the names of lengths that they are made of, and no others."""

import numpy as np
import pytest

from sysid_bench.identifiability.base_expressions import random_values, symbolic_coefficients
from sysid_bench.identifiability.feasible_error import bound_of, check_bound, feasible_error
from sysid_bench.spatial import NAMES, pseudo_inertia
from sysid_bench.types import Array, Body

LENGTHS = {"a2": 0.279, "a2p": 0.1, "a3": 0.365, "d4": 0.151}
SETS = random_values(LENGTHS)
BODY = Body("b", tuple(f"b.{name}" for name in NAMES))


@pytest.mark.parametrize(
    "words",
    ["a2", "-a2^2", "1/a3", "2 a2p", "-4 a2^2", "a2/a2p", "a2 a3/a2p", "0.5 d4", "a3 d4", "3"],
)
def test_a_monomial_is_found(words: str) -> None:
    assert symbolic_coefficients([_value(words, one) for one in SETS], SETS) == words


@pytest.mark.parametrize(
    ("first", "second", "sign"),
    [("a2^2", "a3^2", 1), ("a2 a3/a2p", "a2", -1), ("d4^2", "a3^2", -1), ("1", "a2/a3", 1)],
)
def test_a_sum_is_found_with_its_value(first: str, second: str, sign: int) -> None:
    values = [_value(first, one) + sign * _value(second, one) for one in SETS]
    words = symbolic_coefficients(values, SETS)
    assert words is not None
    assert set(words.replace(" - ", " + ").removeprefix("-").split(" + ")) == {first, second}


def test_what_no_lengths_explain_is_not_named() -> None:
    assert symbolic_coefficients([0.123, 0.234, 0.345], SETS) is None
    assert symbolic_coefficients([np.sin(one["a2"]) for one in SETS], SETS) is None


def _value(words: str, lengths: dict[str, float]) -> float:
    return float(eval(words.replace("^", "**").replace(" ", "*"), {}, lengths))


@pytest.mark.parametrize("seed", range(20))
def test_a_sum_that_cannot_be_negative_never_is(seed: int) -> None:
    """tr(Q J) with Q of either kind, over bodies that exist, is as the bound says."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(4, rng.integers(1, 5)))
    Q = half @ half.T
    Q -= (seed % 2) * rng.uniform(0.01, 1.0) * np.eye(4) * np.linalg.eigvalsh(Q)[-1]
    basis = pseudo_inertia(np.eye(10))
    coefficients = np.einsum("ij,kij->k", Q, basis)
    terms = dict(zip(BODY.columns, coefficients.tolist(), strict=True))
    possible = np.linalg.eigvalsh(Q)[0] >= -1e-9 * np.abs(Q).max()
    assert bound_of(terms, [BODY]) == (0.0 if possible else -np.inf)
    lowest = min(float(coefficients @ _body(rng)) for _ in range(200))
    if possible:
        assert lowest >= -1e-9
        assert check_bound(terms, -1.0, [BODY]) is not None
    else:
        assert check_bound(terms, -1.0, [BODY]) is None


def test_joint_terms_that_give_energy_away_are_impossible() -> None:
    assert check_bound({"j.fv": 1.0}, -0.1, [BODY]) == "cannot be negative"
    assert check_bound({"j.fv": -1.0}, 0.1, [BODY]) == "cannot be positive"
    assert check_bound({"j.offset": 1.0}, -0.1, [BODY]) is None
    assert check_bound({"j.fv.k": 1.0}, -0.1, [BODY]) is None
    assert check_bound({"b.m": 1.0, "j.k": -1.0}, -0.1, [BODY]) is None


@pytest.mark.parametrize("seed", range(5))
def test_values_of_a_body_need_no_change_and_others_their_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    K = np.eye(10)
    phi = _body(rng)
    assert feasible_error(K, phi, BODY.columns, [BODY]) < 1e-6
    wrong = phi.copy()
    wrong[0] = -1.0  # a mass: at least 1 away from any, and the rest has to follow
    assert feasible_error(K, wrong, BODY.columns, [BODY]) >= 1.0 - 1e-6


def _body(rng: np.random.Generator) -> Array:
    from sysid_bench.spatial import phi_of_pseudo_inertia

    half = rng.normal(size=(4, 4))
    return phi_of_pseudo_inertia(half @ half.T)
