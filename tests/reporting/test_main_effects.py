"""Main effects of a two-way table: exact for products, and shares of one whole."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sysid_bench.reporting.build_table import effect_notes, main_effects
from sysid_bench.reporting.table_entries import Entries
from sysid_bench.reporting.tables import Entry

ratios = st.lists(st.floats(0.01, 100.0), min_size=2, max_size=5)


@example(r=[1.0, 1.0], c=[45.0, 45.0, 45.0])
@given(r=ratios, c=ratios)
def test_a_product_has_no_interaction(r: list[float], c: list[float]) -> None:
    rows, columns = np.array(r), np.array(c)
    found = main_effects(np.outer(rows, columns))
    np.testing.assert_allclose(found.rows, rows / np.exp(np.log(rows).mean()))
    np.testing.assert_allclose(found.columns, columns / np.exp(np.log(columns).mean()))
    assert found.shares[2] < 1e-9


@given(seed=st.integers(0, 999), shape=st.tuples(st.integers(2, 5), st.integers(2, 5)))
def test_the_shares_are_parts_of_one_whole(seed: int, shape: tuple[int, int]) -> None:
    values = np.exp(np.random.default_rng(seed).normal(size=shape))
    found, swapped = main_effects(values), main_effects(values.T)
    assert sum(found.shares) == pytest.approx(1.0)
    assert found.shares[:2] == pytest.approx(swapped.shares[1::-1])
    assert np.log(found.rows).sum() == pytest.approx(0.0, abs=1e-12)
    # A common unit changes no ratio.
    np.testing.assert_allclose(main_effects(7.0 * values).columns, found.columns)


def test_notes_name_both_sides_and_what_has_no_number() -> None:
    numbers = {("a", "x"): 0.1, ("a", "y"): 0.2, ("b", "x"): 0.4, ("b", "y"): 0.8, ("c", "x"): None}
    entries: Entries = {((r,), (c,)): Entry(x, None, None, 1, {}) for (r, c), x in numbers.items()}
    notes = list(effect_notes(entries, (("estimator",), ("pipeline",))))
    assert "estimator: a 0.5, b 2; pipeline: x 0.707, y 1.41." in notes[0]
    assert notes[1] == (
        "Share of the variance of the logarithms: estimator 80 %, pipeline 20 %, both together 0 %."
    )
    assert notes[2].endswith("numbers: c.")
    (short,) = effect_notes({key: entries[key] for key in list(entries)[:2]}, (("r",), ("c",)))
    assert "need two rows" in short
