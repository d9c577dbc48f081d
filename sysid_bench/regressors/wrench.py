"""Base wrench and joint torques of a sub-tree behind a force/torque sensor, for any base link.

In the notation of Traversaro, Del Prete, Ivaldi and Nori, "Inertial parameters identification and
joint torques estimation with proximal force/torque sensing" (ICRA 2015), wrenches [n; f]:

    [f_beta; tau] = [Y_n; Y_c] phi - sum_l [X_l; J_l^T] f_l                       (eq. 4)

f_beta is the wrench that the rest of the world exerts on the sub-tree at its base link beta, f_l
an external wrench on link l. Gravity enters as an acceleration -g of the base (a_g = -g in eqs. 9
and 10). tau_j is the generalised force of joint j in its own positive direction, whichever side is
base: where beta lies behind the joint, the links before it are its sub-tree and its axis counts
reversed.

With Y_n and Y_c for the sensor's own link b, all others follow from rigid transforms of wrenches:

    Y_n(beta) = X Y_n(b),     Y_c(beta)_j = Y_c(b)_j - [beta behind j] M_j Y_n(b)

X (6, 6) moves a wrench from the sensor frame to beta, M_j (6,) projects it onto the joint's axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import FloatingSubtree, Instruments, SensorCut, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.kernel_numpy import LinkMotion, blocks, link_motions
from sysid_bench.regressors.regression import regression
from sysid_bench.spatial.rotation import matrix_of_quaternion, skew
from sysid_bench.types import Array, Regressor, Trajectory


@dataclass(frozen=True, eq=False)
class SubtreeRegressors:
    """Y_n (N, 6, p) at the sensor frame and Y_c (N, k, p) of one motion, base at the sensor; `rows`
    are the k degrees of freedom of the sub-tree, `columns` its p parameters."""

    robot: RobotModel
    cut: SensorCut
    tree: Tree
    root: range
    motion: Trajectory  # with the places of the root
    Y_n: Array
    Y_c: Array
    dofs: tuple[int, ...]
    columns: tuple[str, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the degrees of freedom of `Y_c`."""
        return tuple(self.robot.rows[dof] for dof in self.dofs)

    def base_wrench(self, base: str | None = None) -> Array:
        """Y_n (N, 6, p) [n; f] at the origin of the body `base`, in its axes (None: the sensor)."""
        if base is None:
            return self.Y_n
        return self.wrench_transform(base) @ self.Y_n

    def joint_torque(self, base: str | None = None) -> Array:
        """Y_c (N, k, p) with the base at a body of the sub-tree (None: at the sensor)."""
        if base is None:
            return self.Y_c
        return self.Y_c - self.jacobian(base) @ self.Y_n

    def wrench_transform(self, base: str) -> Array:
        """X (N, 6, 6): a wrench at the root, moved to the body `base`."""
        T = self._twists(body_of(self.robot, self.cut, base))
        return np.linalg.inv(T).transpose(0, 2, 1)

    def jacobian(self, base: str) -> Array:
        """M (N, k, 6): what a wrench at the root is on every joint between the root and `base`;
        zero rows for the others."""
        body = body_of(self.robot, self.cut, base)
        return self.link_jacobian(int(self.tree.carrier[body]), self.dofs)

    def link_jacobian(self, link: int, dofs: Sequence[int]) -> Array:
        """M (N, len(dofs), 6) of degrees of freedom before a link; zero rows for the others."""
        own = self.tree.links[link].dofs.tolist()
        M = np.zeros((len(self.motion), len(dofs), 6))
        for part, state in _states(self.tree, self.motion, link):
            T = _columns(state, [own.index(dof) for dof in self.root])
            for i, dof in enumerate(dofs):
                if dof in own:
                    s = _columns(state, [own.index(dof)])
                    M[part, i] = np.linalg.solve(T, s)[..., 0]
        return M

    def _twists(self, body: int) -> Array:
        """T (N, 6, 6): the twist of a body at its origin, in its axes, per unit of the root's."""
        link = int(self.tree.carrier[body])
        own = self.tree.links[link].dofs.tolist()
        R, p = _pose_in_link(self.robot, body, self.tree.links[link].body)
        to_body = np.zeros((6, 6))
        to_body[:3, :3] = to_body[3:, 3:] = R.T
        to_body[3:, :3] = -R.T @ skew(p)
        parts = [
            to_body @ _columns(state, [own.index(dof) for dof in self.root])
            for _, state in _states(self.tree, self.motion, link)
        ]
        return np.concatenate(parts)


def sub_tree(robot: RobotModel, cut: SensorCut, motion: Trajectory) -> SubtreeRegressors:
    """The regressors of a cut along a motion (N, nq) (N, nv) of the whole robot: base pose, twist
    and acceleration are those that the motion gives the sensor, on a fixed or floating base."""
    instruments = instruments_of(robot, (cut,))
    return _sub_tree(robot, cut, instruments, instruments.root(cut), instruments.motion(motion))


def floating_subtree_regressors(
    robot: RobotModel, alone: FloatingSubtree, motion: Trajectory
) -> SubtreeRegressors:
    """The same of the sub-tree on its own: motions (N, nq + 7) (N, nv + 6) with its free base. The
    rows of Y_n are then the free joint's: force in world axes, then moment in body axes."""
    return _sub_tree(robot, alone.cut, alone, alone.root, motion)


def base_wrench_regressor(
    robot: RobotModel, cut: SensorCut, motion: Trajectory, base: str | None = None
) -> Regressor:
    """Y_n (N, 6, p) [n; f] of the parameters behind a sensor, at the sensor or at any body there.

    Traversaro et al. (2015), eq. 11.
    """
    made = sub_tree(robot, cut, motion)
    prefix = cut.name if base is None else base
    rows = tuple(f"{prefix}.{row.rpartition('.')[2]}" for row in cut.rows)
    return Regressor(made.base_wrench(base), rows, made.columns)


def joint_torque_regressor(
    robot: RobotModel, cut: SensorCut, motion: Trajectory, base: str | None = None
) -> Regressor:
    """Y_c (N, k, p) of the k degrees of freedom behind a sensor, base at the sensor or at any body
    there. Traversaro et al. (2015), eq. 12."""
    made = sub_tree(robot, cut, motion)
    return Regressor(made.joint_torque(base), made.rows, made.columns)


def transferred_wrench(
    instruments: Instruments, motion: Trajectory, cut: SensorCut, stop: SensorCut, wrench: Array
) -> Array:
    """What a wrench (N, 6) at the sensor `stop` is at the sensor `cut` before it (N, 6)."""
    X = wrench_transform(instruments, instruments.motion(motion), cut, stop)
    return np.asarray(np.einsum("nij,nj->ni", X, wrench))


def wrench_transform(
    instruments: Instruments, motion: Trajectory, cut: SensorCut, stop: SensorCut
) -> Array:
    """X (N, 6, 6) of wrenches at the sensor `stop`, moved to the sensor `cut` before it; along a
    motion with the places of all sensors."""
    link = int(instruments.tree.carrier[stop.body])
    own = instruments.tree.links[link].dofs.tolist()
    X = np.empty((len(motion), 6, 6))
    for part, state in _states(instruments.tree, motion, link):
        T_cut, T_stop = (
            _columns(state, [own.index(dof) for dof in instruments.root(at)]).transpose(0, 2, 1)
            for at in (cut, stop)
        )
        X[part] = T_cut @ np.linalg.inv(T_stop)
    return X


def subtree_parameters(robot: RobotModel, cut: SensorCut) -> tuple[str, ...]:
    """Names of the parameters behind a sensor, ten per body."""
    return tuple(column for body in cut.bodies for column in robot.bodies[body].columns)


def _sub_tree(
    robot: RobotModel,
    cut: SensorCut,
    measured: Instruments | FloatingSubtree,
    root: range,
    motion: Trajectory,
) -> SubtreeRegressors:
    columns = subtree_parameters(robot, cut)
    dofs = subtree_dofs(robot, cut)
    rows = [*root, *dofs]
    parts = [
        block.dense()[:, rows] for block in regression(robot, columns, measured).blocks(motion)
    ]
    Y = np.concatenate(parts)
    return SubtreeRegressors(
        robot, cut, measured.tree, root, motion, Y[:, :6], Y[:, 6:], dofs, columns
    )  # fmt: skip


def subtree_dofs(robot: RobotModel, cut: SensorCut) -> tuple[int, ...]:
    """Places in v of the degrees of freedom inside of the sub-tree of a cut."""
    return tuple(
        dof
        for link in robot.tree.links
        if link.body in cut.bodies and link.body != cut.body
        for joint in link.joints
        for dof in joint.dofs
    )


def body_of(robot: RobotModel, cut: SensorCut, base: str) -> int:
    """The index of a body of the sub-tree; UsageError for any other name."""
    names = [robot.body_names[b] for b in cut.bodies]
    if base not in names:
        raise unknown_name(f"body behind the sensor {cut.name!r}", base, names)
    return cut.bodies[names.index(base)]


def _pose_in_link(robot: RobotModel, body: int, link_body: int) -> tuple[Array, Array]:
    """R (3, 3), p (3,) of a body in the one that carries it rigidly."""
    R, p, b = np.eye(3), np.zeros(3), body + 1
    while b != link_body + 1:
        R_b = matrix_of_quaternion(np.array(robot.mj.body_quat[b]))
        p = np.array(robot.mj.body_pos[b]) + R_b @ p
        R, b = R_b @ R, int(robot.mj.body_parentid[b])
    return R, p


def _states(tree: Tree, motion: Trajectory, link: int):  # type: ignore[no-untyped-def]
    """(samples, LinkMotion) of one link, block by block."""
    for part in blocks(motion):
        yield part, link_motions(tree, motion.q[part].T, motion.v[part].T, motion.a[part].T)[link]


def _columns(state: LinkMotion, places: Sequence[int]) -> Array:
    """Twists (n, 6, k) of a link per unit rate of some of its degrees of freedom."""
    return np.moveaxis(state.ZU[list(places)], -1, 0).transpose(0, 2, 1)
