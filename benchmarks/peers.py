"""One arm in each peer's representation, called through the fastest public interface of the peer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import roboticstoolbox as rtb

from armlab.robots import Robot

WORLD_AXES = pin.LOCAL_WORLD_ALIGNED


class Pinocchio:
    """Pinocchio model whose joint frames are armlab's link frames.

    Parameters
    ----------
    links : (n, 10) link parameters, in the same order in Pinocchio and armlab; None: massless.
    """

    def __init__(self, robot: Robot, links: np.ndarray | None = None) -> None:
        self.model = pin.Model()
        self.model.gravity.linear = np.array(robot.gravity)
        joint = 0
        for i, (frame, name) in enumerate(zip(robot.frames, robot.joint_names)):
            kind = pin.JointModelPZ() if robot.prismatic[i] else pin.JointModelRZ()
            joint = self.model.addJoint(joint, kind, pin.SE3(frame), name)
            if links is not None:
                inertia = pin.Inertia.FromDynamicParameters(links[i])
                self.model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        tool = pin.Frame("tool", joint, 0, pin.SE3(robot.frames[-1]), pin.FrameType.OP_FRAME)
        self.tool = self.model.addFrame(tool)
        self.data = self.model.createData()

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return T_base_tool in the fastest of four ways that were tested."""
        pin.forwardKinematics(self.model, self.data, q)
        return pin.updateFramePlacement(self.model, self.data, self.tool).homogeneous

    def forward_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T_base_tool and J; computeFrameJacobian is faster than computeJointJacobians with getFrameJacobian."""
        J = pin.computeFrameJacobian(self.model, self.data, q, self.tool, WORLD_AXES)
        return pin.updateFramePlacement(self.model, self.data, self.tool).homogeneous, J

    def forward_batch(self, q: np.ndarray) -> np.ndarray:
        """Return (N, 4, 4) from a loop, because Pinocchio's Python interface has no batch functions."""
        T = np.empty((len(q), 4, 4))
        for row, into in zip(q, T):
            into[...] = self.forward(row)
        return T

    def forward_jacobian_batch(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 4, 4) and (N, 6, n) from a loop."""
        T, J = np.empty((len(q), 4, 4)), np.empty((len(q), 6, q.shape[1]))
        for row, into_T, into_J in zip(q, T, J):
            into_T[...], into_J[...] = self.forward_jacobian(row)
        return T, J


def elementary_transforms(robot: Robot) -> rtb.ETS:
    """Return the robotics toolbox's compiled sequence with the fewest elements: one constant and one joint per link."""
    sequence = []
    for frame, slides, *limits in zip(robot.frames, robot.prismatic, robot.q_min, robot.q_max):
        joint = rtb.ET.tz if slides else rtb.ET.Rz
        sequence += [rtb.ET.SE3(frame), joint(qlim=np.array(limits))]
    return rtb.ETS([*sequence, rtb.ET.SE3(robot.frames[-1])])


def closed_loop_inverse(robot: Robot, tolerance: float, starts: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return inverse kinematics as Pinocchio users write it: a Python loop around the Jacobian.

    It follows Pinocchio's example (log6 of the relative pose as the error, with its derivative Jlog6), but uses full
    Newton steps damped by the squared error, clips postures to the limits, and restarts randomly after 30 steps.
    """
    peer, rng = Pinocchio(robot), np.random.default_rng(0)
    model, data, tool = peer.model, peer.data, peer.tool
    identity = np.eye(6)

    def solve(T_base_tool: np.ndarray) -> np.ndarray:
        goal, q = pin.SE3(T_base_tool), np.array(robot.q_home)
        for _ in range(starts):
            for _ in range(30):
                pin.forwardKinematics(model, data, q)
                between = pin.updateFramePlacement(model, data, tool).actInv(goal)
                error = pin.log6(between).vector
                if np.linalg.norm(error[:3]) <= tolerance and np.linalg.norm(error[3:]) <= tolerance:
                    return q
                J = pin.Jlog6(between.inverse()) @ pin.computeFrameJacobian(model, data, q, tool, pin.LOCAL)
                damped = J @ J.T + 0.1 * (error @ error) * identity + 1e-12 * identity
                q = np.clip(q + J.T @ np.linalg.solve(damped, error), robot.q_min, robot.q_max)
            q = rng.uniform(robot.q_min, robot.q_max)
        return q

    return solve


class PlainNumpy:
    """Straightforward NumPy kinematics of revolute joints: stacks of 4×4 matrices, multiplied in cache-sized blocks."""

    BLOCK = 3000  # fastest of the tested sizes from 100 to 10000

    def __init__(self, robot: Robot) -> None:
        self.n = robot.n
        self.frames = np.array(robot.frames)

    def forward(self, q: np.ndarray, T: np.ndarray | None = None) -> np.ndarray:
        """Return (N, 4, 4), written to `T` if given."""
        T = np.empty((len(q), 4, 4)) if T is None else T
        for rows in _blocks(len(q), self.BLOCK):
            T[rows] = self._links(q[rows])[-1] @ self.frames[-1]
        return T

    def forward_jacobian(
        self, q: np.ndarray, out: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 4, 4) and (N, 6, n), written to `out` if given."""
        T, J = out or (np.empty((len(q), 4, 4)), np.empty((len(q), 6, self.n)))
        for rows in _blocks(len(q), self.BLOCK):
            links = self._links(q[rows])
            T[rows] = links[-1] @ self.frames[-1]
            for i, link in enumerate(links):
                z = link[:, :3, 2]
                J[rows, :3, i] = np.cross(z, T[rows, :3, 3] - link[:, :3, 3])
                J[rows, 3:, i] = z
        return T, J

    def _links(self, q: np.ndarray) -> list[np.ndarray]:
        sines, cosines = np.sin(q), np.cos(q)
        links, T = [], np.eye(4)
        for i in range(self.n):
            Z = np.zeros((len(q), 4, 4))
            Z[:, 0, 0] = Z[:, 1, 1] = cosines[:, i]
            Z[:, 1, 0], Z[:, 0, 1] = sines[:, i], -sines[:, i]
            Z[:, 2, 2] = Z[:, 3, 3] = 1.0
            T = T @ self.frames[i] @ Z
            links.append(T)
        return links


class FastNumpy:
    """Fastest NumPy kinematics: a structure of arrays in blocks that fit into the cache.

    A block of B poses is an array (4, 3, B) of columns x, y, z, p. A joint rotates x and y by vector arithmetic; a
    constant pose is one matrix product, (4, 4) by (4, 3 B). For revolute joints.
    """

    BLOCK = 6000  # fastest of the tested sizes from 500 to 16000

    def __init__(self, robot: Robot) -> None:
        self.n = robot.n
        self.steps = [np.ascontiguousarray(frame.T) for frame in robot.frames]

    def forward(self, q: np.ndarray, T: np.ndarray | None = None) -> np.ndarray:
        """Return (N, 4, 4), written to `T` if given."""
        T = np.empty((len(q), 4, 4)) if T is None else T
        for rows in _blocks(len(q), self.BLOCK):
            _write(self._columns(q[rows], None), T[rows])
        return T

    def forward_jacobian(
        self, q: np.ndarray, out: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 4, 4) and (N, 6, n), written to `out` if given."""
        T, J = out or (np.empty((len(q), 4, 4)), np.empty((len(q), 6, self.n)))
        for rows in _blocks(len(q), self.BLOCK):
            axes = np.empty((self.n, 2, 3, len(q[rows])))  # z and p of every link
            columns = self._columns(q[rows], axes)
            _write(columns, T[rows])
            (zx, zy, zz), (lx, ly, lz) = np.moveaxis(axes[:, 0], 1, 0), np.moveaxis(columns[3] - axes[:, 1], 1, 0)
            J[rows, 0] = (zy * lz - zz * ly).T
            J[rows, 1] = (zz * lx - zx * lz).T
            J[rows, 2] = (zx * ly - zy * lx).T
            J[rows, 3:] = axes[:, 0].transpose(2, 1, 0)
        return T, J

    def _columns(self, q: np.ndarray, axes: np.ndarray | None) -> np.ndarray:
        count = len(q)
        sines, cosines = np.sin(q.T), np.cos(q.T)
        columns = np.repeat(self.steps[0][:, :3, None], count, axis=2)
        for i in range(self.n):
            x, y = columns[0], columns[1]
            turned = cosines[i] * x + sines[i] * y
            columns[1] = cosines[i] * y - sines[i] * x
            columns[0] = turned
            if axes is not None:
                axes[i] = columns[2:]
            columns = (self.steps[i + 1] @ columns.reshape(4, -1)).reshape(4, 3, count)
        return columns


def _blocks(count: int, size: int) -> list[slice]:
    return [slice(start, start + size) for start in range(0, count, size)]


def _write(columns: np.ndarray, T: np.ndarray) -> None:
    T[:, :3] = columns.transpose(2, 1, 0)
    T[:, 3] = (0.0, 0.0, 0.0, 1.0)
