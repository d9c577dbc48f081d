"""Base wrench and joint torques of a sub-tree distal to a force/torque sensor, for any base link.

In the notation of Traversaro, Del Prete, Ivaldi and Nori, "Inertial parameters identification and
joint torques estimation with proximal force/torque sensing" (ICRA 2015), wrenches [n; f]:

    [f_beta; tau] = [Y_n; Y_c] phi - sum_l [X_l; J_l^T] f_l                       (eq. 4)

f_beta is the wrench that the environment exerts on the sub-tree at its base link beta, f_l an
external wrench on link l. Gravity enters as an acceleration -g of the base (a_g = -g in eqs. 9 and
10). tau_j is the generalised force of joint j in its own positive direction, whichever side the
base is on: for beta distal to the joint, the sub-tree of j is proximal and its axis is reversed.

Given Y_n and Y_c for the sensor's own link b, those of any beta follow by wrench transforms:

    Y_n(beta) = X Y_n(b),     Y_c(beta)_j = Y_c(b)_j - [beta distal to j] J_j Y_n(b)

X (6, 6) transforms a wrench from the sensor frame to beta. J_j (6,) is the unit twist of joint j in
the sensor frame, so that J_j f is the torque of a wrench f about its axis.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import FloatingSubtree, Instruments, SensorSubtree, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.kernel_numpy import LinkMotion, blocks, link_motions
from sysid_bench.regressors.regression import regression
from sysid_bench.spatial import matrix_of_quaternion, skew
from sysid_bench.types import Array, Regressor, Trajectory


@dataclass(frozen=True, eq=False)
class SubtreeRegressor:
    """Regressors of a sub-tree along one motion, with the base at the sensor.

    Y_n (N, 6, p): wrench [n; f] in the sensor frame; Y_c (N, k, p): torques of the k degrees of
    freedom `rows`; `columns` name the p parameters. `root` are the indices in v of the six degrees
    of freedom of the sensor frame, whose coordinates `motion` contains.
    """

    robot: RobotModel
    cut: SensorSubtree
    tree: Tree
    root: range
    motion: Trajectory
    Y_n: Array
    Y_c: Array
    dofs: tuple[int, ...]
    columns: tuple[str, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the degrees of freedom of `Y_c`."""
        return tuple(self.robot.rows[dof] for dof in self.dofs)

    def base_wrench(self, base: str | None = None) -> Array:
        """Return Y_n (N, 6, p) [n; f] at the origin of the body `base`, in its axes (None: in the
        sensor frame); raises UsageError for a body outside of the sub-tree."""
        if base is None:
            return self.Y_n
        return np.asarray(self.wrench_transform(base) @ self.Y_n)

    def joint_torque(self, base: str | None = None) -> Array:
        """Return Y_c (N, k, p) with the base at a body of the sub-tree (None: at the sensor)."""
        if base is None:
            return self.Y_c
        return np.asarray(self.Y_c - self.jacobian(base) @ self.Y_n)

    def wrench_transform(self, base: str) -> Array:
        """Return X (N, 6, 6), which transforms a wrench [n; f] at the root to the body `base`."""
        # T (N, 6, 6): twist of a body at its origin, in its axes, per unit twist of the root.
        body = _body_of(self.robot, self.cut, base)
        link = int(self.tree.carrier[body])
        moving = self.tree.links[link].dofs.tolist()
        # Pose R (3, 3), p (3,) of a body in the body of the link that carries it rigidly.
        link_body = self.tree.links[link].body
        R, p, b = np.eye(3), np.zeros(3), body + 1
        while b != link_body + 1:
            R_b = matrix_of_quaternion(np.array(self.robot.mj.body_quat[b]))
            p = np.array(self.robot.mj.body_pos[b]) + R_b @ p
            R, b = R_b @ R, int(self.robot.mj.body_parentid[b])
        to_body = np.zeros((6, 6))
        to_body[:3, :3] = to_body[3:, 3:] = R.T
        to_body[3:, :3] = -R.T @ skew(p)
        parts = [
            to_body @ _columns(state, [moving.index(dof) for dof in self.root])
            for _, state in _states(self.tree, self.motion, link)
        ]
        T = np.concatenate(parts)
        # Power is invariant: twists transform by T, wrenches by T^-T.
        return np.linalg.inv(T).transpose(0, 2, 1)

    def jacobian(self, base: str) -> Array:
        """Return J (N, k, 6): unit twists, in the root frame, of the joints between the root and
        `base`; rows of other joints are zero. J f is the joint torque of a wrench f at the root."""
        body = _body_of(self.robot, self.cut, base)
        return self.link_jacobian(int(self.tree.carrier[body]), self.dofs)

    def link_jacobian(self, link: int, dofs: Sequence[int]) -> Array:
        """Return J (N, len(dofs), 6): unit twists, in the root frame, of the degrees of freedom
        that move a link; rows of others are zero."""
        moving = self.tree.links[link].dofs.tolist()
        J = np.zeros((len(self.motion), len(dofs), 6))
        for part, state in _states(self.tree, self.motion, link):
            T = _columns(state, [moving.index(dof) for dof in self.root])
            for i, dof in enumerate(dofs):
                if dof in moving:
                    s = _columns(state, [moving.index(dof)])
                    # T maps twists of the root to twists of the link: T^-1 brings the joint's axis
                    # to the root.
                    J[part, i] = np.linalg.solve(T, s)[..., 0]
        return J


def subtree_regressor(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory
) -> SubtreeRegressor:
    """Return the regressors of a cut along a motion of the whole robot, fixed-base or floating; the
    pose, twist and acceleration of the sensor frame follow from the motion."""
    instruments = instruments_of(robot, (cut,))
    return _sub_tree(
        robot, cut, instruments, instruments.wrench_rows(cut), instruments.motion(motion)
    )


def floating_subtree_regressor(
    robot: RobotModel, alone: FloatingSubtree, motion: Trajectory
) -> SubtreeRegressor:
    """Return the regressors of an isolated sub-tree with a free base; motion q (N, nq + 7), v and a
    (N, nv + 6).

    Rows of Y_n are those of the free joint: force in world axes, then moment in body axes.
    """
    return _sub_tree(robot, alone.cut, alone, alone.wrench_rows, motion)


def base_wrench_regressor(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, base: str | None = None
) -> Regressor:
    """Return Y_n (N, 6, p), the wrench [n; f] of the sub-tree distal to a sensor, in the sensor
    frame or at the origin and in the axes of the body `base`. Traversaro et al. (2015), eq. 11."""
    subtree = subtree_regressor(robot, cut, motion)
    prefix = cut.name if base is None else base
    rows = tuple(f"{prefix}.{row.rpartition('.')[2]}" for row in cut.rows)
    return Regressor(subtree.base_wrench(base), rows, subtree.columns)


def joint_torque_regressor(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, base: str | None = None
) -> Regressor:
    """Return Y_c (N, k, p), the torques of the k degrees of freedom distal to a sensor, with the
    base at the sensor or at the body `base`. Traversaro et al. (2015), eq. 12."""
    subtree = subtree_regressor(robot, cut, motion)
    return Regressor(subtree.joint_torque(base), subtree.rows, subtree.columns)


def transform_wrench(
    instruments: Instruments,
    motion: Trajectory,
    cut: SensorSubtree,
    stop: SensorSubtree,
    wrench: Array,
) -> Array:
    """Return a wrench (N, 6) [n; f] at the sensor `stop`, transformed to the frame of the proximal
    sensor `cut`."""
    X = wrench_transform(instruments, instruments.motion(motion), cut, stop)
    return np.asarray(np.einsum("nij,nj->ni", X, wrench))


def wrench_transform(
    instruments: Instruments, motion: Trajectory, cut: SensorSubtree, stop: SensorSubtree
) -> Array:
    """Return X (N, 6, 6), which transforms wrenches [n; f] at the sensor `stop` to the frame of the
    proximal sensor `cut`, along a motion with the coordinates of all sensors."""
    link = int(instruments.tree.carrier[stop.body])
    moving = instruments.tree.links[link].dofs.tolist()
    X = np.empty((len(motion), 6, 6))
    for part, state in _states(instruments.tree, motion, link):
        T_cut, T_stop = (
            _columns(state, [moving.index(dof) for dof in instruments.wrench_rows(c)]).transpose(
                0, 2, 1
            )
            for c in (cut, stop)
        )
        X[part] = T_cut @ np.linalg.inv(T_stop)
    return X


def _sub_tree(
    robot: RobotModel,
    cut: SensorSubtree,
    measured: Instruments | FloatingSubtree,
    root: range,
    motion: Trajectory,
) -> SubtreeRegressor:
    # The inertial parameters distal to the sensor, ten per body.
    columns = tuple(column for body in cut.bodies for column in robot.bodies[body].columns)
    dofs = subtree_dofs(robot, cut)
    rows = [*root, *dofs]
    blocks_of_rows = regression(robot, columns, measured).blocks(motion)
    Y = np.concatenate([block.dense()[:, rows] for block in blocks_of_rows])
    return SubtreeRegressor(
        robot=robot,
        cut=cut,
        tree=measured.tree,
        root=root,
        motion=motion,
        Y_n=Y[:, :6],
        Y_c=Y[:, 6:],
        dofs=dofs,
        columns=columns,
    )


def subtree_dofs(robot: RobotModel, cut: SensorSubtree) -> tuple[int, ...]:
    """Return the indices in v of the degrees of freedom inside the sub-tree of a cut."""
    return tuple(
        dof
        for link in robot.tree.links
        if link.body in cut.bodies and link.body != cut.body
        for joint in link.joints
        for dof in joint.dofs
    )


def _body_of(robot: RobotModel, cut: SensorSubtree, base: str) -> int:
    """Return the index of a body of the sub-tree; raises UsageError for any other name."""
    names = [robot.body_names[b] for b in cut.bodies]
    if base not in names:
        raise unknown_name(f"body distal to the sensor {cut.name!r}", base, names)
    return cut.bodies[names.index(base)]


def _states(tree: Tree, motion: Trajectory, link: int) -> Iterator[tuple[slice, LinkMotion]]:
    """Motion of one link, block by block, with the samples of each block."""
    for part in blocks(motion):
        yield part, link_motions(tree, motion.q[part].T, motion.v[part].T, motion.a[part].T)[link]


def _columns(state: LinkMotion, indices: Sequence[int]) -> Array:
    """Twists (n, 6, k) of a link per unit rate of k of the degrees of freedom that move it."""
    return np.moveaxis(state.ZU[list(indices)], -1, 0).transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class SubtreeDrives:
    """Drives of a sub-tree along a motion, all joints of which are distal to the sensor.

    `rows`: names (d,) with `units`; G (N or 1, k, d): rates of the k degrees of freedom of the
    sub-tree per unit rate of each drive; `followers`: other joints that each moves. `partial`:
    drives that move joints on both sides of the sensor; their torques also need the parameters of
    bodies that the sensor does not carry.
    """

    rows: tuple[str, ...]
    units: tuple[str, ...]
    G: Array
    followers: tuple[tuple[str, ...], ...]
    partial: tuple[str, ...] = ()

    def reduced(self, tau: Array) -> Array:
        """Return G^T tau (N, d, ...) of torques tau (N, k, ...) of the sub-tree's joints."""
        if self.G.shape[0] == 1 and np.array_equal(self.G[0], np.eye(self.G.shape[1])):
            return tau
        G = np.broadcast_to(self.G, (len(tau), *self.G.shape[1:]))
        return np.asarray(np.einsum("nkd,nk...->nd...", G, tau))

    def joints(self, drive: int) -> tuple[int, ...]:
        """Return the indices among the k degrees of freedom of those that a drive moves."""
        return tuple(np.flatnonzero((self.G[:, :, drive] != 0.0).any(axis=0)).tolist())


def subtree_drives(robot: RobotModel, cut: SensorSubtree, q: Array) -> SubtreeDrives:
    """Return the drives distal to a sensor at closed positions q (N, nq or more)."""
    dofs = subtree_dofs(robot, cut)
    if robot.coupling is None:
        units = tuple(robot.torque_units[dof] for dof in dofs)
        names = tuple(robot.rows[dof] for dof in dofs)
        return SubtreeDrives(names, units, np.eye(len(dofs))[None], ((),) * len(dofs))
    return _coupled_drives(robot, robot.coupling, dofs, q)


def _coupled_drives(
    robot: RobotModel, coupling: Coupling, dofs: tuple[int, ...], q: Array
) -> SubtreeDrives:
    # Degrees of freedom that each independent one moves, itself included.
    pairs = zip(coupling.independent, coupling.is_coupled.T, strict=True)
    moved = [{int(dof), *coupling.dependent[column].tolist()} for dof, column in pairs]
    whole = [i for i, joints in enumerate(moved) if joints <= {*dofs}]
    partial = [i for i, joints in enumerate(moved) if joints & {*dofs} and i not in whole]
    rows = robot.torque_rows
    G = coupling.G(q[:, : robot.mj.nq])[:, list(dofs)][:, :, whole]
    return SubtreeDrives(
        rows=tuple(rows[i] for i in whole),
        units=tuple(robot.torque_units[i] for i in whole),
        G=G,
        followers=tuple(
            tuple(robot.rows[dof] for dof in sorted(moved[i] - {int(robot.torque_dofs[i])}))
            for i in whole
        ),
        partial=tuple(rows[i] for i in partial),
    )
