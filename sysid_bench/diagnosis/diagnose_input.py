"""Input of a diagnosis: one recording with its robot, prepared once for all checks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.diagnosis import near_model as near
from sysid_bench.diagnosis.near_model import NearModel, NearModelFit
from sysid_bench.models.model_checks import length, placeholder_reason
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.signals.filter import Butterworth, derivative
from sysid_bench.signals.log import Log
from sysid_bench.signals.log_samples import Samples
from sysid_bench.spatial import NAMES
from sysid_bench.types import Array, Trajectory

CUTOFF: Final = 10.0
"""Hz; robots move below it, see the default filter of recordings."""
BAND: Final = 0.18
"""Highest cut-off as a share of the rate: second differences amplify what lies above."""
OVERSAMPLING: Final = 5.0
"""Rate after decimation in units of the cut-off."""
STATES: Final = 100
"""Random states that show what any motion can."""
ROWS: Final = 500
"""Samples of the fits near the model: many fits are made, and neighbouring samples are alike."""
TOOL: Final = 0.1
"""Mass and size of a tool over those of its robot."""
GRAVITY: Final = 9.81


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Motion of the recorded joints: q, v, a (N, n), and sign (N, n) of v, filtered like the
    torque, so that its steps are rounded alike."""

    q: Array
    v: Array
    a: Array
    sign: Array

    def __len__(self) -> int:
        return len(self.q)

    def rows(self, rows: slice | Array) -> "JointMotion":
        """Some of the samples."""
        return JointMotion(self.q[rows], self.v[rows], self.a[rows], self.sign[rows])

    def scaled(self, factors: Array) -> "JointMotion":
        """The motion with each joint (n,) times a factor, such as -1."""
        return JointMotion(
            self.q * factors, self.v * factors, self.a * factors, self.sign * np.sign(factors)
        )

    def columns(self, order: Sequence[int]) -> "JointMotion":
        """The motion with columns in another order: joint j takes column order[j]."""
        o = list(order)
        return JointMotion(self.q[:, o], self.v[:, o], self.a[:, o], self.sign[:, o])

    def with_offset(self, offset: Array) -> "JointMotion":
        """The motion with an offset (n,) of the positions."""
        return replace(self, q=self.q + offset)

    def with_rate(self, factor: float) -> "JointMotion":
        """The motion at another rate: v times a factor, a times its square."""
        return replace(self, v=self.v * factor, a=self.a * factor**2)


@dataclass(frozen=True, eq=False)
class DiagnoseInput:
    """One recording and its robot. Joints are those of the log, in its order (n).

    Rows of `torque` and `motion` are filtered and decimated alike; `near_model` holds the normal
    equations of a fit near the model file, `joint_rows` fits that need no model parameters.
    `loaded`: an unknown load at the tool is one more link, the last one, of mass zero in the file.
    """

    log: Log
    robot: RobotModel
    loaded: bool = False

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the recorded joints (n,)."""
        return self.log.joints

    @property
    def count(self) -> int:
        """Number n of recorded joints."""
        return len(self.joints)

    def names(self, chosen: Array) -> tuple[str, ...]:
        """Names of some of the joints, by a mask (n,) or by indices."""
        return tuple(self.joints[j] for j in np.arange(self.count)[chosen])

    @cached_property
    def dofs(self) -> Array:
        """Degrees of freedom (n,) of the recorded joints."""
        return np.array([self.robot.rows.index(name) for name in self.joints], dtype=int)

    @cached_property
    def position_columns(self) -> Array:
        """Indices (n,) of the recorded joints in q."""
        qadr = {joint.dofs[0]: joint.qadr for joint in self.robot.joints}
        return np.array([qadr[name] for name in self.joints], dtype=int)

    @cached_property
    def torque_columns(self) -> Array:
        """Indices (n,) of the recorded joints among the torque rows of the robot."""
        return np.array([self.robot.torque_rows.index(name) for name in self.joints], dtype=int)

    @property
    def raw(self) -> Samples:
        """Samples of the file; see `columns`."""
        assert self.log.raw is not None
        return self.log.raw

    @cached_property
    def columns(self) -> list[int]:
        """Indices (n,) of the recorded joints among the coordinates of the description."""
        return [self.log.description.joints.index(name) for name in self.joints]

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Kinds (hinge, slide) of the recorded joints."""
        kind_of = {joint.dofs[0]: joint.kind for joint in self.robot.joints}
        return tuple(kind_of[name] for name in self.joints)

    @property
    def rate(self) -> float:
        """Rate (Hz) of the recording."""
        return self.log.recording.rate

    @cached_property
    def _low_pass(self) -> Butterworth:
        return Butterworth(3, float(min(CUTOFF, BAND * self.rate)))

    @cached_property
    def step(self) -> int:
        """Decimation."""
        return max(1, int(self.rate / (OVERSAMPLING * self._low_pass.cutoff)))

    @cached_property
    def _smooth_torque(self) -> Array:
        """Filtered torque (N, n) at the rate of the recording."""
        return self._low_pass.smooth(self.torque_samples, self.rate)

    @cached_property
    def kept(self) -> slice:
        """Samples of the recording that are kept: without the ends, decimated."""
        count = len(self.log.recording)
        edge = min(self._low_pass.edge(self.rate), count // 10)
        return slice(edge, count - edge, self.step)

    def torque_with_delay(self, j: int, lags: Array, rows: slice) -> tuple[Array, Array]:
        """Filtered torque (N', k) of a joint, `lags` (k,) samples later than each of some samples,
        and which of these (N',) have all of them."""
        index = np.arange(len(self.log.recording))[self.kept][rows]
        inside = (index + lags.min() >= 0) & (index + lags.max() < len(self.log.recording))
        return self._smooth_torque[:, j][index[inside][:, None] + lags], np.flatnonzero(inside)

    @cached_property
    def motion(self) -> JointMotion:
        """Filtered motion, decimated."""
        low_pass, rate = self._low_pass, self.rate
        # Differences of q: a recorded v may have mistakes of its own.
        q = low_pass.smooth(self.log.recording.q[:, self.position_columns], rate)
        v = derivative(low_pass, q, rate)
        a = derivative(low_pass, v, rate)
        sign = low_pass.smooth(np.sign(v), rate)
        return JointMotion(q, v, a, sign).rows(self.kept)

    @cached_property
    def torque_samples(self) -> Array:
        """Recorded torque (N, n) on the uniform grid."""
        return self.log.recording.tau[:, self.torque_columns]

    @cached_property
    def torque(self) -> Array:
        """Filtered torque (N, n), decimated."""
        return self._smooth_torque[self.kept]

    @cached_property
    def rms(self) -> Array:
        """RMS (n,) of the filtered torque."""
        return np.asarray(np.sqrt((self.torque**2).mean(axis=0)))

    @property
    def fit_rows(self) -> slice:
        """No more than ROWS of the samples of `motion`."""
        return slice(0, None, max(1, -(-len(self.motion) // ROWS)))

    @cached_property
    def fit_samples(self) -> tuple[JointMotion, Array]:
        """Motion and torque at these samples."""
        return self.motion.rows(self.fit_rows), self.torque[self.fit_rows]

    @cached_property
    def _links(self) -> tuple[tuple[str, ...], Array]:
        """Columns of the moving links, each that of its first body, and their parameters
        (k, 10)."""
        tree, names = self.robot.tree, self.robot.body_names
        theta = tree.link_parameters(self.robot.phi)
        firsts = [
            next(b for b in np.flatnonzero(tree.carrier == k) if np.allclose(tree.X[b], np.eye(10)))
            for k in range(len(theta))
        ]
        return tuple(f"{names[b]}.{name}" for b in firsts for name in NAMES), theta

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the moving links (k,), each that of its first body."""
        return tuple(name.rpartition(".")[0] for name in self._links[0][::10])

    @property
    def file_parameters(self) -> Array:
        """Parameters (k, 10) of the links in the model file, welded bodies included."""
        theta = self._links[1]
        return np.concatenate([theta, np.zeros((1, 10))]) if self.loaded else theta

    @cached_property
    def placeholder(self) -> str:
        """Reason why the file's inertias are taken for placeholders; empty where they are not."""
        return placeholder_reason(self.robot)

    @cached_property
    def holding(self) -> Array:
        """Torques (n,) that hold what each joint carries, stretched out, with a load of a tenth of
        the moving links at its end: drives are built for them. Infinite without known masses."""
        robot, parent = self.robot, self.robot.mj.body_parentid - 1  # MuJoCo counts the world
        apart = np.linalg.norm(robot.mj.body_pos[1:], axis=1)
        mass, moment = robot.phi[:, 0].copy(), np.linalg.norm(robot.phi[:, 1:4], axis=1)
        reach = np.zeros(len(mass))
        for b in range(len(mass) - 1, -1, -1):
            if (p := parent[b + 1]) >= 0:
                mass[p] += mass[b]
                moment[p] += moment[b] + mass[b] * apart[b]
                reach[p] = max(reach[p], reach[b] + apart[b])
        load = TOOL * float(self._links[1][:, 0].sum())
        turned = moment + load * (reach + TOOL * length(robot))
        bodies = robot.mj.dof_bodyid[self.dofs] - 1
        lifted = np.array([kind == "slide" for kind in self.kinds])
        held = GRAVITY * np.where(lifted, (mass + load)[bodies], turned[bodies])
        return np.full(self.count, np.inf) if self.placeholder else held

    @cached_property
    def link_std(self) -> Array:
        """Standard deviations (p,) of the link parameters."""
        theta = self._links[1]
        links = near.std_of(theta) * (near.FREE if self.placeholder else 1.0)
        return np.concatenate([links, near.load_std(theta)]) if self.loaded else links

    @cached_property
    def carrying(self) -> "DiagnoseInput":
        """The recording of a robot with an unknown load at the tool."""
        loaded = replace(self, loaded=True)
        of_links = ("link_std", "near_model", "_touched", "_directions")
        known = {name: value for name, value in vars(self).items() if name not in of_links}
        vars(loaded).update(known | {"loaded": True})  # the signals are prepared once
        return loaded

    def regressor(self, motion: JointMotion, robot: RobotModel | None = None) -> Array:
        """Columns (N, n, p) of the links along a motion of the recorded joints."""
        regression = torque_regression(robot, self._links[0]) if robot else self._regression
        return self._link_columns(regression, self.trajectory(motion))

    def _link_columns(self, regression: AnyRegression, motion: Trajectory) -> Array:
        Y = regression.dense(motion).Y[:, self.torque_columns]
        if not self.loaded:
            return Y
        tool, tree = self.robot.tool_body, self.robot.tree
        return np.concatenate([Y, Y[..., self._tool_columns] @ tree.X[tool]], axis=2)

    @property
    def _tool_columns(self) -> slice:
        """Columns of the link that carries the tool."""
        first = 10 * int(self.robot.tree.carrier[self.robot.tool_body])
        return slice(first, first + 10)

    @cached_property
    def _touched(self) -> tuple[Array, ...]:
        """Columns of the links that each joint (n,) moves."""
        p, at = len(self._links[0]), self._tool_columns
        found = []
        for row in self.torque_columns:
            links = np.unique(self._regression.row_columns[row] // 10)
            own = (10 * links[:, None] + np.arange(10)).ravel()
            tool = np.arange(p, p + 10) if self.loaded and at.start in own else own[:0]
            found.append(np.concatenate([own, tool]))
        return tuple(found)

    @cached_property
    def _directions(self) -> Array:
        """Directions (p, r) of the scaled link columns that any motion can show."""
        states = random_states(self.robot, STATES, np.random.default_rng(0))
        W = self._link_columns(self._regression, states)
        return near.independent_directions(W * self.link_std, self._touched)

    @cached_property
    def _regression(self) -> AnyRegression:
        return torque_regression(self.robot, self._links[0])

    def trajectory(self, motion: JointMotion) -> Trajectory:
        """Motion of the whole robot, the other joints at rest."""
        N = len(motion)
        q = np.tile(self.robot.mj.qpos0, (N, 1))
        v, a = np.zeros((2, N, self.robot.nv))
        q[:, self.position_columns] = motion.q
        v[:, self.dofs], a[:, self.dofs] = motion.v, motion.a
        t = np.arange(N) * self.step / self.rate
        return self.robot.completed(Trajectory(t, q, v, a, "diagnosed"))

    def normal(
        self,
        motion: JointMotion,
        W: Array | None = None,
        more: Array | None = None,
        spread: Array | float = 1.0,
        is_own: bool = True,
    ) -> NearModel:
        """Normal equations near the model along a motion of as many samples as `sparse`, with its
        own link columns or with others W (N, n, p), of another gravity where they are not
        `is_own`; `more` (N, n, k): columns that a mixing may add to the torques; `spread` (p,):
        factors on the spreads of the links."""
        W = self.regressor(motion) if W is None else W
        T = np.repeat(self.fit_samples[1][:, None], self.count, axis=1)
        T = T if more is None else np.concatenate([T, more], axis=2)
        std = self.link_std * spread
        basis = self._directions if is_own else near.independent_directions(W * std, self._touched)
        if np.ndim(spread):
            basis = np.linalg.qr(basis * np.asarray(spread)[:, None])[0]
        known, seconds = self.file_parameters.ravel(), len(self.log.recording) / self.rate
        return near.near_model(
            W, terms(motion), T, links=self._touched, basis=basis, known=known, scale=std,
            holding=self.holding, seconds=seconds,
        )  # fmt: skip

    @cached_property
    def near_model(self) -> NearModel:
        """Normal equations of the recording as it is."""
        return self.normal(self.fit_samples[0])

    def predict(self, fit: NearModelFit) -> Array:
        """Torque (N, n) of a fit along `sparse`."""
        motion = self.fit_samples[0]
        return np.asarray(
            self.regressor(motion) @ fit.links + (terms(motion) * fit.terms).sum(axis=2)
        )


def terms(motion: JointMotion) -> Array:
    """Columns (N, n, 4) of viscous and Coulomb friction, armature and offset of each joint."""
    return np.stack([motion.v, motion.sign, motion.a, np.ones_like(motion.v)], axis=2)
