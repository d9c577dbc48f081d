"""Fontanelli, Ficuciello, Villani, Siciliano, Modelling and identification of the da Vinci Research
Kit robotic arms, IROS 2017: Tables VI and IX, row by row, from the kinematics of Tables I and II.

Read with two corrections of the printing in Table VI (the second m3y is m2'y, the doubled I2''xx is
I2'xx + I2''xx) and two in Table IX (the doubled I2''yy of its first row is I2'yy + I2''yy, and
-I2''yy of the sixth is -I2'yy); "0.15" of its seventh row is a3^2 + d4^2 = 0.156.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.commands.basis import basis, paper_table

PSM = {
    "link1.hx": -0.683, "link2p.hy": -0.672, "link3.m": 0.146, "link3.hx": 0.033,
    "link3.hy": 0.001, "link3.hz": -0.039, "linkc.m": 0.179,
    "link1.hz + link2.hz + 1/a2 link2pp.Iyz + 1/a2 link3.Iyz": 0.013,
    "link1.Iyy + link2.Iyy + a2^2 link2p.m + link2p.Ixx + a2^2 link2pp.m - 2 a2 link2pp.hz"
    " + link2pp.Ixx + link3.Ixx + linkc.Ixx": -0.07,
    "link2.hx + a2 link2p.m + a2 link2pp.m - link2pp.hz": -0.091,
    "link2.hy - 1/a2 link2pp.Ixz - 1/a2 link3.Ixz": 0.228,
    "link2.Ixx - link2.Iyy - a2^2 link2p.m - a2^2 link2pp.m + 2 a2 link2pp.hz - link2pp.Ixx"
    " + link2pp.Izz - link3.Ixx + link3.Izz - linkc.Ixx + linkc.Izz": 0.003,
    "link2.Izz + a2^2 link2p.m + a2^2 link2pp.m - 2 a2 link2pp.hz + link2pp.Iyy + link3.Iyy"
    " + linkc.Iyy": 0.188,
    "link2p.hz - link2pp.hy - 1/a2 link2pp.Iyz - 1/a2 link3.Iyz": -0.022,
    "link2pp.hx + 1/a2 link2pp.Ixz + 1/a2 link3.Ixz": -0.246,
    "link2pp.Ixy + link3.Ixy": -0.007,
    "j1.fv": 0.133, "j1.fc": 0.064, "j1.k": 0.129, "j1.offset": 0.004, "j2.fv": 0.136,
    "j2.fc": 0.15, "j2.k": 0.35, "j2.offset": 0.071, "j3.fv": 2.695, "j3.fc": 0.496,
    "j4.fv": 0.001, "j4.fc": 0.004, "j4.k": 0.003, "j4.offset": 0.004, "j5.fv": 0.028,
    "j5.fv.j6": 0.005, "j5.fc": 0.012, "j6.fv.j5": 0.013, "j6.fv": 0.02, "j6.fc": 0.004,
}  # fmt: skip
"""Table VI: 16 inertial rows and 20 of friction, springs and offsets."""

M4 = "{0} link4.m {1} {0} link5.m {1} {0} link6.m {1} {0} link7.m"
ALL = M4.format
LAST = "{0} link5.m {1} {0} link6.m {1} {0} link7.m".format
MTM = {
    "link2.hy": 0.558, "link2.Ixy": 0.008, "link2p.hy": 0.205, "link2pp.hy": -0.541,
    "link2pp.hz": -0.484, "link3.hy": -0.014, "link4.hx": 0.008, "link4.hz": -0.034,
    "link5.hx": 0.002, "link5.hy": -0.053, "link6.hx": 0.0001, "link7.hx": 0.0001,
    "link7.hy": 0.0001, "link7.Izz": 0.0001,
    "link1.Iyy + link2.Iyy + link2p.Iyy + a2p^2 link2pp.m + link2pp.Iyy + a2^2 link3.m + link3.Izz"
    f" + {ALL('(a3^2 + a2^2)', '+')}": 0.217,
    f"link2.hx + a2 link3.m - a2/a2p link3.hx + {ALL('(a2 - a2 a3/a2p)', '+')}": -0.839,
    "link2.Ixx - link2.Iyy + link2pp.Ixx - link2pp.Iyy - a2^2 link3.m"
    f" - {ALL('a2^2', '-')}": 0.029,
    f"link2.Izz + link2pp.Izz + a2^2 link3.m + {ALL('a2^2', '+')}": 0.123,
    f"link2p.hx + a2p link2pp.m + link3.hx + {ALL('a3', '+')}": 0.031,
    "link2p.Ixx - link2p.Iyy - a2p^2 link2pp.m + link3.Ixx - link3.Izz - a3^2 link4.m + link4.Izz"
    f" + {LAST('(d4^2 - a3^2)', '+')}": -0.588,
    "link2p.Izz + a2p^2 link2pp.m + link3.Iyy + a3^2 link4.m + link4.Izz"
    f" + {LAST('(d4^2 + a3^2)', '+')}": 0.131,
    f"link2pp.hx + a2/a2p link3.hx + {ALL('a2 a3/a2p', '+')}": 0.951,
    f"link3.hz + link4.hy + {LAST('d4', '+')}": -0.186,
    f"link3.Ixz - a3 link4.hy - {LAST('a3 d4', '-')}": 0.038,
    "link4.Ixx - link4.Izz + link5.Izz": -0.037, "link4.Iyy + link5.Izz": -0.001,
    "link5.hz + link6.hy": -0.004, "link5.Ixx - link5.Izz + link6.Izz": 0.001,
    "link5.Iyy + link6.Izz": 0.002,
    "j1.fv": 0.129, "j1.fc": 0.037, "j1.k": 0.249, "j1.offset": -0.032, "j2.fv": 0.119,
    "j2.fc": 0.053, "j3.fv": 0.068, "j3.fc": 0.0001, "j4.fv": 0.066, "j4.fc": 0.034, "j4.k": 0.042,
    "j4.offset": 0.052, "j5.fv": 0.0001, "j5.fc": 0.011, "j5.k": -0.018, "j5.offset": 0.009,
    "j6.fv": 0.0001, "j6.fc": 0.005, "j6.k": 0.003, "j6.offset": -0.002, "j7.fv": 0.001,
    "j7.fc": 0.0001,
}  # fmt: skip
"""Table IX: 29 inertial rows and 22 more."""

MISSING = {
    "link6.hz + link7.hz", "link6.Ixx - link6.Izz + link7.Iyy", "link6.Iyy + link7.Iyy",
    "link7.Ixx - link7.Iyy",
}  # fmt: skip
"""Base parameters that Table IX lacks."""


def table(name: str, values: dict[str, float], folder: Path) -> dict[str, Any]:
    file = folder / "values.json"
    file.write_text(json.dumps(values))
    return paper_table(name, values=file)


@pytest.fixture(scope="module")
def psm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return table("dvrk_psm", PSM, tmp_path_factory.mktemp("psm"))


@pytest.fixture(scope="module")
def mtm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return table("dvrk_mtm", MTM, tmp_path_factory.mktemp("mtm"))


def test_table_vi(psm: dict[str, Any]) -> None:
    assert (psm["base_parameters"], psm["inertial"]) == (36, 16)
    assert {row["expression"] for row in psm["rows"]} == set(PSM)
    assert psm["missing"] == []
    assert psm["gap"] > 1e9


def test_table_ix(mtm: dict[str, Any]) -> None:
    assert (mtm["base_parameters"], mtm["inertial"]) == (55, 33)
    assert {row["expression"] for row in mtm["rows"]} == set(MTM) | MISSING
    assert set(mtm["missing"]) == MISSING
    singles = [len(row["terms"]) == 1 for row in mtm["rows"]]
    assert singles == sorted(singles, reverse=True)


def test_the_published_values_are_of_no_physical_arm(
    psm: dict[str, Any], mtm: dict[str, Any]
) -> None:
    wrong = {row["value"] for row in psm["rows"] if row["impossible"]}
    assert wrong == {-0.07}
    assert {row["value"] for row in mtm["rows"] if row["impossible"]} == {-0.001, -0.018}
    # The second numbers are those of an independent program on cvxpy.
    assert psm["smallest_change"] == pytest.approx(0.245, abs=2e-3)
    assert mtm["smallest_change"] == pytest.approx(0.229, abs=2e-3)


def test_without_zeroed_parameters_the_counts_are_those_of_all_links() -> None:
    for name, inertial, rest in (("dvrk_psm", 16, 20), ("dvrk_mtm", 46, 22)):
        result = basis(name)
        assert (result["base_parameters"], result["inertial"]) == (inertial + rest, inertial)
