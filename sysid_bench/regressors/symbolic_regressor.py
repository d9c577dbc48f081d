"""Body regressor A (6, 10), derived with SymPy from the spatial Newton-Euler equation.

    F = G dV - ad(V)^T G V,   V = [w; v],   F = [n; f]

with the spatial inertia G = [[I, [h]x], [-[h]x, m 1]] and ad(V)^T = [[-[w]x, -[v]x], [0, -[w]x]]
(seed tool "robot-sysid", section Newton-Euler Dynamics; Featherstone 2008, eq. 2.62). Since F is
linear in phi, A = dF/dphi. In A the linear velocity occurs only in d = dv + w × v, the classical
acceleration of the body's origin, so the kernel needs w, dw and d alone; gravity enters as d - g.

    python -m sysid_bench.regressors.symbolic_regressor       prints sysid_bench/regressors/body.py
    python -m sysid_bench.regressors.symbolic_regressor c     prints the entries in kernel.c
"""

import sys
from typing import Any

import sympy as sp
from sympy.printing.c import C99CodePrinter

from sysid_bench.spatial import NAMES

W = sp.Matrix(sp.symbols("wx wy wz"))
V = sp.Matrix(sp.symbols("vx vy vz"))
DW = sp.Matrix(sp.symbols("ax ay az"))  # angular acceleration
DV = sp.Matrix(sp.symbols("dvx dvy dvz"))
D = sp.Matrix(sp.symbols("dx dy dz"))  # dv + w × v
PHI = sp.Matrix(sp.symbols(NAMES))


def body_regressor() -> sp.Matrix:
    """Return A (6, 10) = dF/dphi as a function of w, v, dw, dv.

    Rows nx ny nz fx fy fz, columns m hx hy hz Ixx Ixy Ixz Iyy Iyz Izz, in body axes at the body's
    origin.
    """
    twist, rate = sp.Matrix([W, V]), sp.Matrix([DW, DV])
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = PHI
    inertia = sp.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    h = skew(sp.Matrix([hx, hy, hz]))
    G = sp.Matrix(sp.BlockMatrix([[inertia, h], [-h, m * sp.eye(3)]]))
    adjoint_transpose = sp.Matrix(sp.BlockMatrix([[-skew(W), -skew(V)], [sp.zeros(3), -skew(W)]]))
    wrench = G * rate - adjoint_transpose * G * twist
    return wrench.jacobian(PHI).applyfunc(sp.expand)


def with_point_acceleration(A: sp.Matrix) -> sp.Matrix:
    """Return A (6, 10) with dv replaced by d - w × v; v cancels."""
    change = dict(zip(DV, D - W.cross(V), strict=True))
    return A.subs(change).applyfunc(sp.expand)


def skew(x: sp.Matrix) -> sp.Matrix:
    """Return the cross-product matrix [x]x (3, 3)."""
    return sp.Matrix([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def source() -> str:
    """Return the text of body.py."""
    A = with_point_acceleration(body_regressor())
    columns = []
    for c in range(10):
        rows = [row for row in range(6) if A[row, c] != 0]
        terms = ", ".join(f"({row}, {sp.pycode(A[row, c])})" for row in rows)
        columns.append(f"        ({terms}),  # {NAMES[c]}")
    body = "\n".join(columns)
    return f'''"""Body regressor, printed by `python -m sysid_bench.regressors.symbolic_regressor`.

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
{body}
    )
'''


FORCES = ("m", "h_force[0]", "h_force[1]", "h_force[2]", "", "", "", "", "", "")
MOMENTS = (
    "", "h_moment[0]", "h_moment[1]", "h_moment[2]",
    *(f"I_moment[{c}]" for c in range(6)),
)  # fmt: skip
"""Names of the columns in kernel.c. A moment of inertia causes no force, and a mass at the origin
no moment, so these columns have no name."""


def c_source() -> str:
    """Return the lines of the function `entries` in kernel.c.

    Raises ValueError if an entry is not zero for which kernel.c has no variable.
    """
    A = with_point_acceleration(body_regressor())
    columns = zip(NAMES, MOMENTS, FORCES, strict=True)
    return "".join(
        _c_lines(moment, A[:3, c], name) + _c_lines(force, A[3:, c], name)
        for c, (name, moment, force) in enumerate(columns)
    )


def _c_lines(variable: str, column: sp.Matrix, name: str) -> str:
    """Assignments of a column (3,) of the parameter `name`; none to a variable without name."""
    if not variable and not column.is_zero_matrix:
        raise ValueError(f"kernel.c has no variable for {column} of {name}.")
    entries = [_VectorPrinter().doprint(value) for value in column if variable]
    return "".join(f"    A->{variable}[{i}] = {entry};\n" for i, entry in enumerate(entries))


class _VectorPrinter(C99CodePrinter):  # type: ignore[misc]  # SymPy is not typed
    """C code for vectors of samples: no pow(), and zero is a vector too."""

    def _print_Pow(self, expr: Any) -> str:
        return "*".join([self._print(expr.base)] * int(expr.exp))

    def _print_Zero(self, expr: Any) -> str:
        return "zero"


if __name__ == "__main__":
    print(c_source() if sys.argv[1:] == ["c"] else source(), end="")
