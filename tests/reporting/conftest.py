"""Fabricated runs (3 robots, 3 payloads, 2 noises, 2 estimators, some failures), a fake arm."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.types import BaseMap, CellData, Estimate, Trajectory

ROBOTS = ("ur5", "panda", "anymal_c")
PAYLOADS = ("none", "sphere-1kg", "box-2kg")
FAILURES = {
    ("panda", "box-2kg", "wls", 0): ("timeout", "The experiment passed its limit of 60 s."),
    ("anymal_c", "none", "wls", 1): ("crash", "The worker died of SIGSEGV."),
    ("anymal_c", "none", "wls", 2): ("failed", "The weights are singular: 3 of 12 rows."),
}


def fabricate(repeats: int = 3, robots: tuple[str, ...] = ROBOTS) -> pd.DataFrame:
    """Cells of a small run; "anymal_c" with "box-2kg" fails whole, in two ways."""
    rng = np.random.default_rng(0)
    rows: list[dict[str, Any]] = []
    for robot in robots:
        for payload in PAYLOADS:
            for noise in ("exact", "q 1e-4 rad, tau 0.5 %"):
                for estimator in ("ols", "wls"):
                    for repeat in range(repeats):
                        rows.append(_row(rng, robot, payload, noise, estimator, repeat, len(rows)))
    return pd.DataFrame(rows)


def _row(
    rng: np.random.Generator, robot: str, payload: str, noise: str, estimator: str, repeat: int,
    number: int,
) -> dict[str, Any]:  # fmt: skip
    scale = 3e-13 if noise == "exact" else 0.02 * (0.7 if estimator == "wls" else 1.0)
    status, reason = FAILURES.get((robot, payload, estimator, repeat), ("ok", ""))
    if (robot, payload) == ("anymal_c", "box-2kg"):
        status = "unsupported" if estimator == "wls" else "failed"
        reason = "A floating base has no closed loop."
    row = {
        "id": f"c{number:011x}",
        "experiment": f"e{number // 2:011x}",
        "robot": robot,
        "payload": payload,
        "task": "robot",
        "excitation": "fourier",
        "simulation": "inverse",
        "noise": noise,
        "repeat": repeat,
        "estimator": estimator,
        "status": status,
        "reason": reason,
        "crosscheck": "ok",
        "gap": float(rng.uniform(1e-16, 4e-15)),
        "closure": float(rng.uniform(1e-15, 4e-14)),
        "native_gap": float(rng.uniform(1e-16, 4e-15)) if robot != "anymal_c" else None,
        "repairs": ["inertia of wrist_3 made positive"] if robot == "ur5" else [],
        "rank": 43,
        "parameters": 82,
    }
    scores = {
        "torque_error": float(scale * rng.lognormal(0, 0.3)),
        "rmse_test": float(scale * 40 * rng.lognormal(0, 0.3)),
        "condition": float(rng.uniform(40, 4000)),
        "parameter_error": float(scale * rng.lognormal(0, 0.5)),
        "feasible": bool(rng.uniform() > 0.3),
        "seconds": float(rng.uniform(0.05, 2.0)),
    }
    return row | (scores if status == "ok" else dict.fromkeys(scores))


@pytest.fixture(scope="session")
def cells() -> pd.DataFrame:
    return fabricate()


@pytest.fixture(scope="session")
def many_cells() -> pd.DataFrame:
    return fabricate(repeats=12, robots=tuple(f"robot{i}" for i in range(35)))


@pytest.fixture(scope="session")
def joints(cells: pd.DataFrame) -> pd.DataFrame:
    rng = np.random.default_rng(1)
    return pd.DataFrame(
        [
            {
                "id": cell,
                "name": f"joint{j}",
                "rmse_train": float(rng.uniform(0.01, 1)),
                "rmse_test": float(rng.uniform(0.01, 1)),
                "rms": float(rng.uniform(1, 50)),
                "relative": float(rng.uniform(1e-3, 0.1)),
                "small": j == 2,
            }
            for cell in cells.loc[cells["status"] == "ok", "id"]
            for j in range(3)
        ]
    )


@pytest.fixture(scope="session")
def spec() -> dict[str, Any]:
    return {
        "name": "main",
        "title": "Held-out torque error",
        "rows": ["robot", "payload"],
        "columns": ["noise", "estimator"],
        "cells": {"metric": "torque_error", "stat": "median", "interval": "iqr"},
        "best": "min-bold",
    }


def make_evidence(
    rows: tuple[str, ...] = ("shoulder", "elbow", "wrist 3/b.x"), samples: int = 400
) -> CellData:
    """A planar arm of unit links that swings; its names hold a space, a slash and a dot."""
    n, t = len(rows), np.arange(samples) / 200
    phase = np.arange(n)
    q = 0.5 * np.sin(2 * t[:, None] + phase) + 0.3
    angle = np.cumsum(q, axis=1)
    step = 0.4 * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    positions = np.cumsum(step, axis=1) - step + np.array([0, 0, 0.5])
    quaternions = np.stack([np.cos(angle / 2), 0 * angle, -np.sin(angle / 2), 0 * angle], axis=-1)
    measured = 5 * np.cos(2 * t[:, None] + phase) / (1 + phase)
    rng = np.random.default_rng(3)
    base = BaseMap(np.eye(4, 10), np.arange(4), tuple(f"l{i}.m" for i in range(10)), 1e8, 0,
                   np.logspace(2, -2, 4))  # fmt: skip
    return CellData(
        row={"id": "c0123456789a", "robot": "fake | arm", "payload": "none", "task": "robot",
             "estimator": "ols", "status": "ok", "reason": "", "torque_error": 0.0123, "rank": 4,
             "condition": 412.5},
        motion=Trajectory(t, q, 0 * q, 0 * q),
        measured=measured + 0.05 * rng.standard_normal(measured.shape),
        predicted=measured,
        rows=rows,
        singular_values=np.array([1e3, 20.0, 3.0, 1e-2, 1e-13, 0.0]),
        gap_map=np.abs(rng.standard_normal((n, 10 * n))) * 1e-15,
        gap_columns=tuple(f"p{i}" for i in range(10 * n)),
        estimate=Estimate(beta=np.arange(4.0), covariance=np.eye(4) * 1e-4),
        base=base,
        bodies=rows,
        parents=tuple(range(-1, n - 1)),
        positions=positions,
        quaternions=quaternions,
    )  # fmt: skip


@pytest.fixture(scope="session")
def evidence() -> CellData:
    return make_evidence()


@pytest.fixture(scope="session")
def nine_joints() -> CellData:
    return make_evidence(tuple(f"joint{i}" for i in range(9)))
