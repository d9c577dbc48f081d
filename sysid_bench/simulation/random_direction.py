"""Random directions of geometric errors."""

import numpy as np

from sysid_bench.types import Array


def random_direction(count: int, rng: np.random.Generator, dimension: int = 3) -> Array:
    """Return unit vectors (count, dimension), uniform on the sphere."""
    x = rng.normal(size=(count, dimension))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))
