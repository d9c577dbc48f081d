"""Forward selection of columns by cross-validation."""

import numpy as np
import pytest

from sysid_bench.identification.linear.column_selection import FoldRow, select_columns
from sysid_bench.types import Array


def folded(W: Array, b: Array, part: Array) -> FoldRow:
    both = np.column_stack([W, b])
    train, test = (np.linalg.qr(both[kept], mode="r") for kept in (~part, part))
    return FoldRow(np.asarray(train), np.asarray(test))


@pytest.mark.parametrize("seed", range(8))
def test_the_columns_of_the_data_are_selected_and_noise_is_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    N, k = 500, 12
    W = rng.normal(size=(2, N, k))
    beta = np.zeros(k)
    beta[[0, 1, 4, 7]] = rng.uniform(0.5, 2.0, 4) * rng.choice([-1, 1], 4)
    b = W @ beta + 0.05 * rng.normal(size=(2, N))
    labels = np.arange(N) * 5 // N
    folds = [[folded(W[i], b[i], labels == f) for i in range(2)] for f in range(5)]
    choice = select_columns(folds, [0, 1], [((i % 2,), i) for i in range(2, k)])
    assert set(choice.columns) == {0, 1, 4, 7}
    assert {column for column, _ in choice.steps} == {4, 7}
    assert choice.error_after < 0.2 * choice.error_before
    nothing = select_columns(folds, [0, 1, 4, 7], [((0,), 2), ((1,), 3)])
    assert nothing.steps == ()
    assert nothing.error_after == nothing.error_before
