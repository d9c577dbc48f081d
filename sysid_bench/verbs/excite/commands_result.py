"""Request for commands that separate delay and armature, and its answer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.actuators.command_design import OTHERS, RESIDUAL
from sysid_bench.commands.result import Result

GAINS: Final = ("kp", "kd")


@dataclass(frozen=True)
class CommandsRequest:
    """Commands to design for a position-commanded robot with known links.

    `gains`: kp (N m/rad, N/m) and kd of its controller, one number or one for each joint; those of
    the model's position actuators where they are absent. `limits`: v, tau, alike, in place of the
    robot's. `motors`: names of tables, one or one for each joint, whose torque, speed and armature
    count as well. `joints` that move (None: all); `period` (s) of the recording with both sets of
    gains, `rate` in Hz; `starts` and `iterations` of the search.
    """

    robot: str | Path
    gains: Mapping[str, Sequence[float]] = field(default_factory=dict)
    limits: Mapping[str, Sequence[float]] = field(default_factory=dict)
    motors: Sequence[str] = ()
    out: str | Path | None = None
    joints: Sequence[str] | None = None
    period: float = 20.0
    rate: float = 200.0
    starts: int = 6
    iterations: int = 12
    seed: int = 0
    robots_dir: Path | None = None


@dataclass(frozen=True, eq=False, repr=False)
class CommandsResult(Result):
    """Designed commands of a position controller. `gains`: kp and kd of each joint, first those
    given, then those of the second part, which are shares of them. Predicted for residuals of 5 %
    of each joint's torque: `delay_std` (s), `armature_std` (by joint, of the assumed armature), and
    `delay_open` (s), the error of the delay that such residuals allow; `one_gain_delay_open`: under
    the first gains alone. `limits` by kind: the largest share used, and its joint."""

    robot: str
    task: str
    joints: list[str]
    seed: int
    rate: float
    period: float
    gains: dict[str, list[list[float]]]
    delay_std: float
    delay_open: float
    one_gain_delay_open: float
    armature_std: dict[str, float]
    assumed: dict[str, dict[str, float]]
    limits: dict[str, dict[str, Any]]
    violations: list[dict[str, Any]]
    evaluations: int
    warnings: list[str]
    file: str | None
    seconds: float
    interrupted: bool = False

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Gains, what the recording tells, use of the limits and the file."""
        worst = max(self.armature_std, key=lambda name: self.armature_std[name])
        lines = [
            f"{self.robot}, task {self.task}: commands of {len(self.joints)} joints for "
            f"{self.period:g} s at {self.rate:g} Hz, {self._gains_text()}",
            f"  with residuals of {100 * RESIDUAL:.0f} % of the torque the delay is open by "
            f"{1e3 * self.delay_open:.2g} ms; under the first gains alone by "
            f"{1e3 * self.one_gain_delay_open:.2g} ms",
            f"  deviations: delay {1e3 * self.delay_std:.2g} ms, armature up to "
            f"{100 * self.armature_std[worst]:.2g} % ({worst})",
            *(
                f"  {kind:<9} {100 * used['share']:5.1f} % of the limit ({used['at']})"
                for kind, used in self.limits.items()
            ),
        ]
        if not self.violations:
            few, many = OTHERS
            lines.append(
                f"  limits hold in simulation, also with {few:g} and {many:g} times the assumed "
                "armature and friction"
            )
        lines += [f"  warning: {warning}" for warning in self.warnings]
        if self.file:
            lines.append(
                f"  file: {self.file}; record q with it: in the log, q_des, kp and kd of tau.pd "
                "are its columns JOINT.q_des, JOINT.kp and JOINT.kd"
            )
        return "\n".join(lines)

    def _gains_text(self) -> str:
        first, second = ([self.gains[name][k] for name in GAINS] for k in range(2))
        shares = [b[0] / a[0] for a, b in zip(first, second, strict=True)]
        words = [
            f"{name} times {share:g}"
            for name, share in zip(GAINS, shares, strict=True)
            if share != 1.0
        ]
        return f"the second half with {' and '.join(words)}"
