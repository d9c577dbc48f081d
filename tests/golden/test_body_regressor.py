"""The 6x10 body regressor as printed in the description of the tool robot-sysid ("Robotic Arm
System Identification via Spatial Dynamics Regressors"), section "Full 6×10 Regressor Matrix"."""

import re

import numpy as np
import pytest
import sympy as sp

from sysid_bench.regressors.body import entries
from sysid_bench.regressors.symbolic_regressor import body_regressor, with_point_acceleration

PRINTED = r"""
0 & 0 & \dot{v}_z + \omega_x v_y - \omega_y v_x & -\dot{v}_y + \omega_x v_z - \omega_z v_x & \dot{\omega}_x & \dot{\omega}_y - \omega_x\omega_z & \dot{\omega}_z + \omega_x\omega_y & -\omega_y\omega_z & \omega_y^2 - \omega_z^2 & \omega_y\omega_z \\
0 & -\dot{v}_z - \omega_x v_y + \omega_y v_x & 0 & \dot{v}_x + \omega_y v_z - \omega_z v_y & \omega_x\omega_z & \dot{\omega}_x + \omega_y\omega_z & -\omega_x^2 + \omega_z^2 & \dot{\omega}_y & \dot{\omega}_z - \omega_x\omega_y & -\omega_x\omega_z \\
0 & \dot{v}_y - \omega_x v_z + \omega_z v_x & -\dot{v}_x - \omega_y v_z + \omega_z v_y & 0 & -\omega_x\omega_y & \omega_x^2 - \omega_y^2 & \dot{\omega}_x - \omega_y\omega_z & \omega_x\omega_y & \dot{\omega}_y + \omega_x\omega_z & \dot{\omega}_z \\
\dot{v}_x + \omega_y v_z - \omega_z v_y & -\omega_y^2 - \omega_z^2 & -\dot{\omega}_z + \omega_x\omega_y & \dot{\omega}_y + \omega_x\omega_z & 0 & 0 & 0 & 0 & 0 & 0 \\
\dot{v}_y - \omega_x v_z + \omega_z v_x & \dot{\omega}_z + \omega_x\omega_y & -\omega_x^2 - \omega_z^2 & -\dot{\omega}_x + \omega_y\omega_z & 0 & 0 & 0 & 0 & 0 & 0 \\
\dot{v}_z + \omega_x v_y - \omega_y v_x & -\dot{\omega}_y + \omega_x\omega_z & \dot{\omega}_x + \omega_y\omega_z & -\omega_x^2 - \omega_y^2 & 0 & 0 & 0 & 0 & 0 & 0
"""  # noqa: E501
LETTERS = {r"\dot{v}_": "dv", r"\dot{\omega}_": "a", r"\omega_": "w", "v_": "v"}


def printed_entry(latex: str) -> sp.Expr:
    """One entry of the printed matrix in the symbols of the derivation."""
    names = {
        letter + axis: sp.Symbol(letter + axis) for letter in LETTERS.values() for axis in "xyz"
    }
    for written, letter in LETTERS.items():
        latex = latex.replace(written, " " + letter)
    product = re.sub(r"(?<=[xyz])\s+(?=[a-z])", "*", latex.strip()).replace("^", "**")
    return sp.sympify(product, locals=names)


TABLE = [[printed_entry(cell) for cell in row.split("&")] for row in PRINTED.split(r"\\")]


@pytest.fixture(scope="module")
def derived() -> sp.Matrix:
    return body_regressor()


def test_the_printed_table_was_read_whole() -> None:
    assert [len(row) for row in TABLE] == [10] * 6
    letters = {str(symbol) for row in TABLE for cell in row for symbol in cell.free_symbols}
    assert letters == {letter + axis for letter in ("w", "v", "a", "dv") for axis in "xyz"}


@pytest.mark.parametrize("row", range(6))
@pytest.mark.parametrize("column", range(10))
def test_every_derived_entry_is_the_printed_one(row: int, column: int, derived: sp.Matrix) -> None:
    assert sp.expand(derived[row, column] - TABLE[row][column]) == 0


def test_the_linear_velocity_cancels_in_the_classical_acceleration(derived: sp.Matrix) -> None:
    velocity = set(sp.symbols("vx vy vz dvx dvy dvz"))
    assert velocity & derived.free_symbols
    assert not velocity & with_point_acceleration(derived).free_symbols


def test_the_generated_code_evaluates_to_the_printed_matrix() -> None:
    w, v, dw, dv = np.random.default_rng(0).normal(size=(4, 3))
    letters = {"w": w, "v": v, "a": dw, "dv": dv}
    values = {name + axis: x[i] for name, x in letters.items() for i, axis in enumerate("xyz")}
    printed = np.array([[float(cell.subs(values)) for cell in row] for row in TABLE])
    A = np.zeros((6, 10))
    for column, rows in enumerate(entries(w, dw, dv + np.cross(w, v))):
        for row, value in rows:
            A[row, column] = value
    np.testing.assert_allclose(A, printed, rtol=1e-14, atol=1e-14)
