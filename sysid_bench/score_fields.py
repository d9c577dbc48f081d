"""Figures of an estimate; `sysid_bench.types` has this type as well, and is its public path."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Score:
    """Figures of one estimate; None where a figure does not apply. metrics.py has their records.
    Torque errors are held-out and against the exact torque (the Oracle), except `rmse_train`."""

    rmse_train: float | None = None
    rmse_test: float | None = None
    torque_error: float | None = None
    torque_error_moving: float | None = None
    torque_error_weighted: float | None = None
    torque_error_sample: float | None = None
    torque_error_worst: float | None = None
    torque_error_by_motion: Mapping[str, float | None] = field(default_factory=dict)
    rank: int | None = None
    data_rank: int | None = None
    parameters: int | None = None
    rank_gap: float | None = None
    near_degenerate: int | None = None
    condition: float | None = None
    condition_unit: float | None = None
    d_optimality: float | None = None
    rollout_error: float | None = None
    parameter_error: float | None = None
    beta_error: float | None = None
    payload_error: float | None = None
    mass_error: float | None = None
    com_error: float | None = None
    inertia_error: float | None = None
    payload_mass_error: float | None = None
    payload_mass_error_relative: float | None = None
    payload_com_error: float | None = None
    payload_inertia_error: float | None = None
    payload_distance: float | None = None
    mass: float | None = None
    mass_low: float | None = None
    mass_high: float | None = None
    structural_rank: int | None = None
    excited_rank: int | None = None
    left_out: float | None = None
    standstill: float | None = None
    unpredictable: int | None = None
    sensed_torque_ratio: float | None = None
    sensed_wrench_ratio: float | None = None
    sensed_cad_ratio: float | None = None
    alone_cad_ratio: float | None = None
    coverage: Mapping[str, float] = field(default_factory=dict)  # by kind of deviation
    feasible: bool | None = None
    min_eigenvalue: float | None = None
    plausible: bool | None = None
    joints: tuple[Mapping[str, Any], ...] = ()  # name rmse_train rmse_test rms relative small
