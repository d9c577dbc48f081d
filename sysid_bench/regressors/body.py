"""Body regressor, printed by `python -m sysid_bench.regressors.symbolic_regressor`.

Do not edit: `tests/regressors/test_symbolic_regressor.py` derives it again and compares.
"""

from sysid_bench.types import Array

# fmt: off


def entries(w: Array, alpha: Array, d: Array) -> tuple[tuple[tuple[int, Array], ...], ...]:
    """Return the non-zero entries of the body regressor A (6, 10), as (row, value) by column.

    The wrench [n; f] of a body is A phi, at its origin and in its axes. w and alpha (3, ...) are
    its angular velocity and acceleration, d (3, ...) the classical acceleration of its origin minus
    gravity, all in body axes.
    """
    wx, wy, wz = w
    ax, ay, az = alpha
    dx, dy, dz = d
    return (
        ((3, dx), (4, dy), (5, dz)),  # m
        ((1, -dz), (2, dy), (3, -wy**2 - wz**2), (4, az + wx*wy), (5, -ay + wx*wz)),  # hx
        ((0, dz), (2, -dx), (3, -az + wx*wy), (4, -wx**2 - wz**2), (5, ax + wy*wz)),  # hy
        ((0, -dy), (1, dx), (3, ay + wx*wz), (4, -ax + wy*wz), (5, -wx**2 - wy**2)),  # hz
        ((0, ax), (1, wx*wz), (2, -wx*wy)),  # Ixx
        ((0, ay - wx*wz), (1, ax + wy*wz), (2, wx**2 - wy**2)),  # Ixy
        ((0, az + wx*wy), (1, -wx**2 + wz**2), (2, ax - wy*wz)),  # Ixz
        ((0, -wy*wz), (1, ay), (2, wx*wy)),  # Iyy
        ((0, wy**2 - wz**2), (1, az - wx*wy), (2, ay + wx*wz)),  # Iyz
        ((0, wy*wz), (1, -wx*wz), (2, az)),  # Izz
    )
