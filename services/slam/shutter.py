"""The rolling shutter: an image's rows are read one after another while the camera moves.

A camera that turns by 60 degrees a second and takes 20 ms to read its rows shears the image by a degree. Features are
brought back to where they would have been seen when the middle row was read: from the camera's velocity, to first
order, after Hedborg, Forssen, Felsberg and Ringaby, "Rolling shutter bundle adjustment" (2012), section 3. How long the
rows take is nobody's word but learned from what the poses cannot explain; a global shutter comes out as zero.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.atlas import Atlas
from services.slam.camera import CameraModel
from services.slam.features import Features, Roll, grid_of
from services.slam.linear import cholesky_solve
from services.slam.motion import Velocity
from services.slam.observe import CHI2_MONO, MIN_Z_M, huber_weight, jacobian, pose_jacobian, residual
from services.slam.tracking import Tracked

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_BELIEF = 0.02
"""Share of a frame's information that counts: its residuals err together."""
_START_SIGMA_S = 0.01
_LEAST_SIGMA_S = 0.002
"""Never surer than this: what was learned while the map was still sheared itself is forgotten."""
_SHOWN = 0.4
"""Share of an error in the readout time that the residuals show: keyframes sheared alike hide the rest."""
_TURN_SIGMA_RAD_S = 0.15
"""How far the turning is from what the frames before say."""
_LEAST_S = 0.004
"""A shorter readout is taken for none: a global shutter stays one."""
_SURE = 2.5
"""Standard deviations from zero at which a readout is believed."""
_MOST_S = 0.05
_ADJUST_S = 0.003
"""The map as a whole is adjusted when the readout has changed by so much since."""
_STEP_S = 0.0005
"""The map's keyframes follow when the readout has changed by so much."""


class Shutter:
    """Knows the readout time as far as it is known, and what each keyframe's features were moved by."""

    def __init__(self, atlas: Atlas, camera: CameraModel) -> None:
        self._atlas = atlas
        self._camera = camera
        self._rows = (len(atlas.keyframes.cell_start[0]) - 1) // camera.cols
        self._readout_s = 0.0
        self._information = _START_SIGMA_S**-2
        self._slopes: dict[int, F32] = {}
        """Of each keyframe by serial: (N, 2) pixels that its features move per second of readout."""
        self._moving: tuple[int, Features, Velocity | None] | None = None
        """Serial and features of a keyframe just made, and the velocity before it."""
        self._adjusted_s = 0.0
        self.readout_s = 0.0
        """What the features are corrected by: zero until it is sure."""

    def straighten(self, features: Features, velocity: Velocity) -> None:
        """Place features as the middle row's moment saw them, in place."""
        roll = features.roll
        if roll is None:
            return
        roll.slope = self._slopes_at(features, roll, velocity)
        if self.readout_s != 0.0 or features.uv is not roll.read:
            features.uv = roll.read + self.readout_s * roll.slope
            features.cell_start, features.cell_items = grid_of(features.uv, self._camera.cols, self._rows)

    def learn(self, frame: Tracked) -> bool:
        """Take from a located frame's residuals what they say of the readout time; return whether the whole map was moved."""
        roll = frame.features.roll
        if roll is None or not roll.slope.any():
            return False
        A, b = self._unexplained(frame, -roll.slope[:, :, None])
        if A[0, 0] < 1e-9:
            return False
        known = _BELIEF * float(A[0, 0])
        self._information = min(self._information + known, _LEAST_SIGMA_S**-2)
        measured_s = self.readout_s + float(b[0] / A[0, 0]) / _SHOWN
        self._readout_s += min(known / self._information, 1.0) * (measured_s - self._readout_s)
        self._readout_s = min(max(self._readout_s, -_MOST_S), _MOST_S)
        sure = abs(self._readout_s) > max(_LEAST_S, _SURE * self._information**-0.5)
        target = self._readout_s if sure else 0.0
        if abs(target - self.readout_s) <= _STEP_S:
            return False
        return self._adopt(target)

    def turn_rate(self, frame: Tracked, velocity: Velocity) -> Velocity:
        """Return the velocity with the turning that the frame's own shear tells, and ``velocity`` believed to 0.15 rad/s."""
        roll = frame.features.roll
        if roll is None or self.readout_s == 0.0:
            return velocity
        A, b = self._unexplained(frame, -self.readout_s * turn_slopes(roll.read, roll.row, self._camera.array))
        change = np.linalg.solve(A + np.eye(3) / _TURN_SIGMA_RAD_S**2, b)
        return Velocity(velocity.v_m_s, velocity.w_rad_s + change)

    def _unexplained(self, frame: Tracked, G: F64) -> tuple[F64, F64]:
        """Return the normal equations of ``unexplained`` for the frame's points with measured depth."""
        p, f = self._atlas.points, frame.features
        index = np.flatnonzero(frame.point >= 0)
        index = index[p.parallax[frame.point[index]] < 0.0]
        obs = np.column_stack([f.uv[index], f.disparity[index]])
        info = np.column_stack([1.0 / self._camera.variance[f.octave[index]], f.info[index]])
        points = p.pos[frame.point[index]]
        return unexplained(frame.R, frame.t, points, obs, info, np.ascontiguousarray(G[index]), self._camera.array)

    def _adopt(self, readout_s: float) -> bool:
        """Correct all keyframes by another readout time; return whether the map is owed an adjustment as a whole."""
        change = readout_s - self.readout_s
        self.readout_s = readout_s
        kf = self._atlas.keyframes
        for k in self._atlas.slots:
            slope = self._slopes.get(int(kf.serial[k]))
            if slope is not None:
                self._shift(int(k), np.float32(change) * slope)
        owed = abs(readout_s - self._adjusted_s) > _ADJUST_S
        if owed:
            self._adjusted_s = readout_s
        return owed

    def keep(self, serial: int, features: Features, before: Velocity | None) -> None:
        """Remember a new keyframe, and the velocity that led to it; forget ended ones."""
        if features.roll is None:
            return
        self._moving = serial, features, before
        self._slopes[serial] = features.roll.slope.astype(np.float32)
        if len(self._slopes) > 2 * len(self._atlas.slots) + 16:
            alive = set(self._atlas.keyframes.serial[self._atlas.slots].tolist())
            self._slopes = {s: slope for s, slope in self._slopes.items() if s in alive}

    def settle(self, after: Velocity | None) -> tuple[int, Features, Velocity] | None:
        """Correct the last frame, if it became a keyframe, by the mean of the velocities before and ``after`` it.

        Returns the keyframe's slot, its features and that mean.
        """
        moving, self._moving = self._moving, None
        if moving is None or after is None:
            return None
        serial, features, before = moving
        k, roll = self._atlas.slot_of(serial), features.roll
        if k < 0 or roll is None or serial not in self._slopes:
            return None
        mean = after
        if before is not None:
            mean = Velocity(0.5 * (before.v_m_s + after.v_m_s), 0.5 * (before.w_rad_s + after.w_rad_s))
        was, now = self._slopes[serial], self._slopes_at(features, roll, mean).astype(np.float32)
        self._slopes[serial] = now
        if self.readout_s != 0.0:
            self._shift(k, np.float32(self.readout_s) * (now - was))
        return k, features, mean

    def _slopes_at(self, features: Features, roll: Roll, velocity: Velocity) -> F64:
        return slopes(roll.read, roll.row, features.depth, self._camera.array, velocity.v_m_s, velocity.w_rad_s)

    def _shift(self, k: int, by: F32) -> None:
        kf = self._atlas.keyframes
        n = len(by)
        kf.uv[k, :n] += by
        uv = kf.uv[k, :n].astype(np.float64)
        kf.cell_start[k], kf.cell_items[k, :n] = grid_of(uv, self._camera.cols, self._rows)


@njit(cache=True, nogil=True)
def slopes(read: F64, row: F64, depth: F64, camera: F64, v: F64, w: F64) -> F64:
    """Return (N, 2) how far features at ``read`` (N, 2) belong from there, pixels per second of readout.

    ``row`` (N,) share of the readout since the middle row, ``depth`` (N,) metres, 0 = so far that only turning counts.
    A point at X0 in the camera's frame when the middle row is read is at ``X0 - (v + w x X0) s`` after ``s`` seconds.
    """
    out = np.empty((len(read), 2))
    for i in range(len(read)):
        x, y = (read[i, 0] - camera[2]) / camera[0], (read[i, 1] - camera[3]) / camera[1]
        iz = 1.0 / depth[i] if depth[i] > 0.0 else 0.0
        a = w[1] - w[2] * y + v[0] * iz
        b = w[2] * x - w[0] + v[1] * iz
        c = w[0] * y - w[1] * x + v[2] * iz
        out[i, 0] = row[i] * camera[0] * (a - x * c)
        out[i, 1] = row[i] * camera[1] * (b - y * c)
    return out


@njit(cache=True, nogil=True)
def turn_slopes(read: F64, row: F64, camera: F64) -> F64:
    """Return (N, 2, 3) the derivative of ``slopes`` by the turn rate."""
    out = np.empty((len(read), 2, 3))
    for i in range(len(read)):
        x, y = (read[i, 0] - camera[2]) / camera[0], (read[i, 1] - camera[3]) / camera[1]
        for k in range(2):
            f = row[i] * camera[k]
            out[i, k, 0] = f * (-x * y if k == 0 else -1.0 - y * y)
            out[i, k, 1] = f * (1.0 + x * x if k == 0 else x * y)
            out[i, k, 2] = f * (-y if k == 0 else x)
    return out


@njit(cache=True, nogil=True)
def unexplained(R: F64, t: F64, points: F64, obs: F64, info: F64, G: F64, camera: F64) -> tuple[F64, F64]:
    """Return the normal equations ``A x = b`` of parameters x beside the pose, the pose eliminated.

    ``points`` (N, 3) map, ``obs`` (N, 3) u, v, d, ``info`` (N, 2) inverse variances, ``G`` (N, 2, E) d(predicted u, v)/dx.
    """
    E = G.shape[2]
    H, C, c = np.zeros((6, 6)), np.zeros((6, E)), np.zeros(6)
    A, b = np.zeros((E, E)), np.zeros(E)
    J, JP, r = np.empty((3, 3)), np.empty((3, 6)), np.empty(3)
    for i in range(len(points)):
        X = points[i]
        x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
        y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
        if z < MIN_Z_M:
            continue
        residual(x, y, z, obs[i, 0], obs[i, 1], obs[i, 2], camera, r)
        e = info[i, 0] * (r[0] * r[0] + r[1] * r[1]) + info[i, 1] * r[2] * r[2]
        h = huber_weight(e, CHI2_MONO)
        jacobian(x, y, z, camera, J)
        pose_jacobian(x, y, z, J, JP)
        for k in range(3):
            weight = h * (info[i, 0] if k < 2 else info[i, 1])
            for m in range(6):
                c[m] += weight * JP[k, m] * r[k]
                for n in range(6):
                    H[m, n] += weight * JP[k, m] * JP[k, n]
                for n in range(E if k < 2 else 0):
                    C[m, n] += weight * JP[k, m] * G[i, k, n]
            for m in range(E if k < 2 else 0):
                b[m] += weight * G[i, k, m] * r[k]
                for n in range(E):
                    A[m, n] += weight * G[i, k, m] * G[i, k, n]
    return eliminate_pose(H, C, c, A, b)


@njit(cache=True, nogil=True)
def eliminate_pose(H: F64, C: F64, c: F64, A: F64, b: F64) -> tuple[F64, F64]:
    """Return ``A - C^T H^-1 C`` and ``b - C^T H^-1 c`` for the pose's block H (6, 6); zeros when H is singular."""
    E = len(b)
    for m in range(6):
        H[m, m] += 1e-9 * H[m, m] + 1e-9
    for n in range(E):
        column = C[:, n].copy()
        if not cholesky_solve(H.copy(), column):
            return np.zeros((E, E)), np.zeros(E)
        for k in range(6):
            b[n] -= column[k] * c[k]
            for m in range(E):
                A[n, m] -= column[k] * C[k, m]
    return A, b
