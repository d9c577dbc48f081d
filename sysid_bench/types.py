"""Data types that packages exchange: arrays and labels only.

Letters: N samples, nq positions, nv velocities (degrees of freedom), p unknowns, r base parameters.
Units are SI; a degree of freedom is an angle (rad, N m) or a length (m, N). A method has access to
`Recording`, `Prior`, `Problem` and `Experiment`; `Oracle` and `Truth` are for scoring alone
(`tests/test_layers.py`).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion on a time grid (s), in the coordinates of the MuJoCo model (free joint: linear
    velocity in the world frame, angular velocity in the body frame)."""

    t: Float[Array, " N"]
    q: Float[Array, "N nq"]
    v: Float[Array, "N nv"]
    a: Float[Array, "N nv"]
    name: str = ""
    period: float | None = None  # s; None where the motion is not periodic

    def __len__(self) -> int:
        return len(self.t)

    @property
    def period_samples(self) -> int:
        """Samples per period; 0 where the motion is not periodic, where samples are missing, or
        where rounding to whole samples adds up to half a sample over the recording."""
        if self.period is None or len(self.t) < 2:
            return 0
        steps = np.diff(self.t)
        step = float(steps.mean())
        if steps.max() > 1.5 * step:
            return 0
        samples = round(self.period / step)
        off = abs(self.period / step - samples) * len(self.t)  # phase error, times the period
        return samples if off < 0.5 * samples else 0


@dataclass(frozen=True, eq=False)
class Controller:
    """Declared joint controller tau = kp (q_ref - q) + kd (v_ref - v) at `rate`. v contains the
    derivative of the encoder error, low-passed at `velocity_cutoff`. The torque is `held` between
    samples (zero-order hold), else it follows the velocity between them."""

    kp: Float[Array, " rows"]
    kd: Float[Array, " rows"]
    rate: float  # Hz
    velocity_cutoff: float  # Hz, first order
    held: bool = True


@dataclass(frozen=True, eq=False)
class Recording:
    """Sensor data of one recording: signals, rate, commanded motion, controller. `tau` belongs to
    `rows`; q, v and a of dependent joints are computed from the independent ones. `v` and `a` are
    None until a filter has derived them from q (or an ideal sensor measured them)."""

    t: Float[Array, " N"]
    q: Float[Array, "N nq"]
    tau: Float[Array, "N rows"]
    rate: float  # Hz
    rows: tuple[str, ...]  # names of the independent degrees of freedom
    v: Float[Array, "N nv"] | None = None
    a: Float[Array, "N nv"] | None = None
    commanded: Trajectory | None = None
    controller: Controller | None = None
    period: float | None = None  # s
    wrench: Float[Array, "N k"] | None = None  # [n; f] of each force/torque sensor, in their order
    wrench_rows: tuple[str, ...] = ()  # names of its columns

    def __len__(self) -> int:
        return len(self.t)

    @property
    def motion(self) -> Trajectory:
        """Measured motion; raises ValueError while v and a are None."""
        if self.v is None or self.a is None:
            raise ValueError("This recording has no velocity and acceleration; filter it first.")
        return Trajectory(self.t, self.q, self.v, self.a, "measured", self.period)


@dataclass(frozen=True, eq=False)
class Oracle:
    """Ground truth of one simulated motion, for scoring alone."""

    motion: Trajectory  # exact
    tau: Float[Array, "N rows"]  # noise-free torque of the independent degrees of freedom
    encoders: Trajectory | None = None  # motion of the motors, where encoders measure that
    step: float | None = None  # s, of the simulation of a closed loop

    @property
    def measured(self) -> Trajectory:
        """Exact motion of what the encoders measure: the motors, or the links."""
        return self.motion if self.encoders is None else self.encoders


@dataclass(frozen=True, eq=False)
class Truth:
    """True parameters of the plant, in the order of `Problem.parameters`."""

    parameters: tuple[str, ...]
    theta: Float[Array, " p"]


@dataclass(frozen=True, eq=False)
class Regressor:
    """Dense regressor Y of tau = Y theta along a motion: for small motions and references."""

    Y: Float[Array, "N rows p"]
    rows: tuple[str, ...]
    columns: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class BaseMap:
    """Identifiable combinations beta = K theta, the base parameters; `K[:, pivots]` is 1.

    `rank` counts singular values above 1e-5 of the largest (SI columns, random states); `gap` is
    the ratio of the last kept to the first dropped one; `near_degenerate` counts dropped ones above
    1e-12.
    """

    K: Float[Array, "r p"]
    pivots: Int[Array, " r"]
    parameters: tuple[str, ...]
    gap: float
    near_degenerate: int
    singular_values: Float[Array, " k"]
    row_space: Float[Array, "r p"] | None = None
    """Orthonormal basis of the row space of K, more accurate than K where its entries are large."""

    dropped: Float[Array, "d p"] | None = None
    """A factor of the near-degenerate directions: |dropped theta| is the size of the torque that
    beta = K theta leaves out, on the scale of `singular_values`."""

    @property
    def rank(self) -> int:
        """Number r of base parameters."""
        return len(self.pivots)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pivot parameters, one per base parameter."""
        return tuple(self.parameters[i] for i in self.pivots)

    def embed(self, beta: Float[Array, " r"]) -> Float[Array, " p"]:
        """Return theta with beta at the pivots and zero elsewhere: it gives the same torques."""
        theta = np.zeros(self.K.shape[1])
        theta[self.pivots] = beta
        return theta


@dataclass(frozen=True, eq=False)
class Factor:
    """R factor of the QR factorisation of [W_i | b_i], all samples of one row (joint) i.

    `columns` are the base parameters that this row depends on; the last column of R is b.
    """

    row: str
    columns: Int[Array, " k"]
    R: Float[Array, "m k1"]
    samples: int


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior knowledge of a method: mean theta0 and standard deviations."""

    theta: Float[Array, " p"]
    std: Float[Array, " p"]


@dataclass(frozen=True, eq=False)
class BodyExtents:
    """Extent of a body: corners (m, body frame) of the box that contains its centre of mass, and
    the volume (m^3) that contains its mass."""

    low: Float[Array, "3"]
    high: Float[Array, "3"]
    volume: float


@dataclass(frozen=True)
class Body:
    """One body and the names of its ten parameters, `m` ... `Izz`."""

    name: str
    columns: tuple[str, ...]


RowBlock = tuple[Float[Array, "n rows r"], Float[Array, "n rows"]]


@runtime_checkable
class SparseBlocks(Protocol):
    """Blocks of a problem that can also be read without the zeros of W."""

    def by_row(self, overlap: int = 0) -> Iterator[tuple[int, list[Array], Array]]:
        """Yield (index of the first sample, W (k, n) of each row in the columns of its factor,
        valid until the next block, b (n, rows)); a block begins with the last `overlap` samples of
        the one before."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Identification problem W beta = b, as R factors per row; `blocks()` yields all samples."""

    parameters: tuple[str, ...]  # p unknowns
    base: BaseMap
    rows: tuple[str, ...]
    factors: tuple[Factor, ...]  # one per row
    bodies: tuple[Body, ...]
    blocks: Callable[[], Iterator[RowBlock]] = field(repr=False)
    samples: int = 0
    prior: Prior | None = None
    kinds: tuple[str, ...] = ()  # of rows, "joint N m", "base N": only equal kinds are compared
    torque: Float[Array, " rows"] | None = None  # RMS of each row's total torque; None: that of b
    mean: Float[Array, " rows"] | None = None  # of each row's total torque; None: not known
    file: Float[Array, " p"] | None = None  # values of the model file; None: the prior's mean
    period: int = 0  # samples per period; 0: not periodic
    repetition: float = 0.0  # samples after which q repeats without a period of the data; 0: never
    signed: tuple[str, ...] | None = None  # not negative in feasible fits; None: friction, rotors
    motions: tuple["Problem", ...] = ()  # those of the single motions; (): there is one alone

    @cached_property
    def stacked(self) -> tuple[Float[Array, "M r"], Float[Array, " M"]]:
        """(W, b) of all samples in time order; its memory grows with N, so prefer `factors`."""
        Ws, bs = zip(*self.blocks(), strict=True)
        W = np.concatenate([block.reshape(-1, self.base.rank) for block in Ws])
        b = np.concatenate([values.ravel() for values in bs])
        W.flags.writeable = b.flags.writeable = False  # shared by all estimators of an experiment
        return W, b

    @property
    def W(self) -> Float[Array, "M r"]:
        """Stacked base regressor (N * rows, r)."""
        return self.stacked[0]

    @property
    def b(self) -> Float[Array, " M"]:
        """Stacked right-hand side (N * rows,)."""
        return self.stacked[1]


@dataclass(frozen=True, eq=False)
class Run:
    """One of several recordings of the same commanded motion, with or without the payload."""

    loaded: bool
    recording: Recording  # filtered as the suite says


def _unchanged(x: Array) -> Array:
    return x


@dataclass(frozen=True, eq=False)
class Experiment:
    """Data of an estimator that simulates or models the noise, in addition to its `problem`.

    `regress(motion)` yields blocks of the base regressor (n, rows, r) along any motion.
    `simulate(theta)` runs the method's model with theta (p,) under the declared controller, or
    under the one given as a second argument, along the commanded motion and returns a noise-free
    Recording with exact v and a; it raises UnsupportedError without a declared controller.
    `known(motion)` is the torque (n, rows) of the known parameters. `runs` are all recordings in
    time order where the suite has some without the payload; `recording` is then the first loaded
    one. `forward` makes compiled steps of the model that `regress` and `known` describe (None:
    there are none). `filter_rows(x)` processes values x (N, rows, ...) at the samples of
    `recording` as the pipeline has processed W and b of `problem`. `moving`: on recordings of a
    real robot, the samples of `recording` at which each joint moves.
    """

    problem: Problem
    recording: Recording  # filtered as the suite says
    raw: Recording  # as the sensors gave it
    regress: Callable[[Trajectory], Iterator[Float[Array, "n rows r"]]] = field(repr=False)
    simulate: Callable[..., Recording] = field(repr=False)
    known: Callable[[Trajectory], Float[Array, "n rows"]] = field(repr=False)
    runs: tuple[Run, ...] = ()
    filter_rows: Callable[[Array], Array] = field(default=_unchanged, repr=False)
    moving: Array | None = None  # (N, rows)
    forward: Any = field(default=None, repr=False)


EstimateStatus = Literal["ok", "failed", "unsupported"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of an estimator. `beta` (r,) are base parameters; `theta` (p,) all parameters, where
    the method determines them, with beta = K theta. `covariance` is by the method's own formula;
    `sigma` the noise of each row by which least squares has divided, so that residuals give a
    covariance as well.

    An iterative method that has not converged returns its last accepted iterate with the status
    "ok" and `converged` False; `iterations` and `stop`, the reason for which it stopped, go with
    it. `converged` is None for a method without iterations. `simulations` are runs of the closed
    loop over the recording; `identify` counts those of `Experiment.simulate` where it is None.
    """

    beta: Float[Array, " r"] | None = None
    theta: Float[Array, " p"] | None = None
    covariance: Float[Array, "r r"] | None = None
    status: EstimateStatus = "ok"
    reason: str = ""
    stats: Mapping[str, float] = field(default_factory=dict)
    sigma: Float[Array, " rows"] | None = None
    converged: bool | None = None
    iterations: int | None = None
    simulations: int | None = None
    stop: str = ""


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


@dataclass(frozen=True, eq=False)
class MetricInput:
    """Data of one finished cell that a metric is computed from; the truth enters through `score`.

    `problem` is what the estimator solved. `held_out` has a problem per motion in the same base
    parameters, in the order of time; its b is the exact torque, on recordings the measured one.
    """

    estimate: Estimate
    problem: Problem
    held_out: Mapping[str, Problem]
    score: Score


Better = Literal["lower", "higher"]
Level = Literal["cell", "joint", "parameter", "interval", "interval-repeats", "repeats"]
Need = Literal["held-out", "truth", "theta", "sensor", "load", "noise", "repeats"]


@dataclass(frozen=True)
class Metric:
    """A column of the results; `name` is the field of the row.

    `unit` may hold alternatives ("N m|N": rotary|linear). `digits` are significant ones, 0 for
    whole numbers. Values below `floor` are rounding and compare as equal. `level`: one value per
    cell, joint, parameter, kind of interval, or for all repeats. `needs` must be there for a value;
    `compute` gives it for a cell (None: computed with the scores).
    """

    name: str
    title: str
    unit: str = ""
    better: Better | None = None
    level: Level = "cell"
    needs: tuple[Need, ...] = ()
    formula: str = ""
    digits: int = 3
    floor: float = 0.0
    scale: float = 1.0  # of tables and reports: units of `unit` in one SI unit of the row
    text: bool = False  # words, of which there is no statistic
    ranked: bool = False  # a [[ranking]] may divide it by the smallest of a case
    shown: bool = False  # in the report's table of all cells and beside a recording
    key: str = ""  # in the row's entry of a joint or parameter
    compute: Callable[[MetricInput], float | None] | None = None

    @property
    def units(self) -> tuple[str, ...]:
        """The alternatives of the unit; empty for a pure number."""
        return tuple(self.unit.split("|")) if self.unit else ()

    @property
    def heading(self) -> str:
        """Title and unit in plain text, "Held-out RMSE (N·m, N)"."""
        units = ", ".join(unit.replace(" ", "·") for unit in self.units)
        return f"{self.title} ({units})" if units else self.title

    @property
    def arrow(self) -> str:
        """The direction of better values as one character; empty where there is none."""
        arrows = {"lower": "\N{DOWNWARDS ARROW}", "higher": "\N{UPWARDS ARROW}"}
        return arrows.get(self.better or "", "")


ShapeKind = Literal["mesh", "box", "sphere", "cylinder", "capsule", "ellipsoid"]


@dataclass(frozen=True, eq=False)
class Shape:
    """Visual shape of a body. `size`: scale of a mesh (3,), half lengths of a box or ellipsoid
    (3,), (radius, half length) of a cylinder or capsule along z, (radius,) of a sphere."""

    body: int  # index into CellData.bodies
    kind: ShapeKind
    size: tuple[float, ...]
    position: Float[Array, "3"]  # m, in the body frame
    quaternion: Float[Array, "4"]  # w x y z
    file: str = ""  # of a mesh


@dataclass(frozen=True, eq=False)
class Curve:
    """Curves of one figure over time: `series` by name, (K,) each, and the limits that they keep
    where there are any."""

    name: str
    t: Float[Array, " K"]  # s
    series: Mapping[str, Float[Array, " K"]]
    unit: str = ""
    limits: tuple[float, float] | None = None  # lowest and highest value, in `unit`


@dataclass(frozen=True, eq=False)
class CellData:
    """Data for the figures of one cell, made by re-executing it."""

    row: Mapping[str, Any]  # the row as stored (Row)
    motion: Trajectory  # the measured motion
    measured: Float[Array, "N n"]
    predicted: Float[Array, "N n"] | None
    rows: tuple[str, ...]
    singular_values: Float[Array, " k"]
    gap_map: Float[Array, "rows p"]  # max over samples of |Y - Y_pin|
    gap_columns: tuple[str, ...]
    estimate: Estimate | None
    base: BaseMap | None
    bodies: tuple[str, ...] = ()
    parents: tuple[int, ...] = ()  # -1: the world
    positions: Float[Array, "N bodies 3"] | None = None  # m, world
    quaternions: Float[Array, "N bodies 4"] | None = None  # w x y z
    shapes: tuple[Shape, ...] = ()
    curves: tuple[Curve, ...] = ()
    joints: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Places in q and v of hinges and slides."""


Row = dict[str, Any]
"""One line of cells/*.jsonl: `id experiment robot payload task excitation simulation noise repeat
estimator status reason`, then the fields of Score, versions and fingerprint. JSON values only."""
