"""Error-state Kalman filter of position, velocity, attitude and inertial biases, compiled.

State x (16): position, velocity (NED), quaternion wxyz (FRD to NED), gyro bias, accelerometer bias. Error state (15)
in the same order with a local rotation vector. Sola, "Quaternion kinematics for the error-state Kalman filter"
(2017), equations 235 to 239 (nominal), 268 to 270 (error), 282 to 285 (injection; the reset Jacobian is taken as I).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from services.common.geometry import Matrix
from services.simulator.px4.kernels import quaternion_times_exp, rotation_matrix

STATES = 15
_GRAVITY_M_S2 = 9.80665


@njit(cache=True, nogil=True)
def propagate(x: Matrix, gyro: Matrix, accel: Matrix, dt_s: float) -> None:
    """Move the nominal state on by one inertial sample, in place."""
    R = rotation_matrix(x[6:10])
    for i in range(3):
        a = (
            R[i, 0] * (accel[0] - x[13])
            + R[i, 1] * (accel[1] - x[14])
            + R[i, 2] * (accel[2] - x[15])
            + (_GRAVITY_M_S2 if i == 2 else 0.0)
        )
        x[i] += x[3 + i] * dt_s + 0.5 * a * dt_s * dt_s
        x[3 + i] += a * dt_s
    quaternion_times_exp(x[6:10], gyro - x[10:13], dt_s)


@njit(cache=True, nogil=True)
def _transition(x: Matrix, gyro: Matrix, accel: Matrix, dt_s: float) -> Matrix:
    R = rotation_matrix(x[6:10])
    a0, a1, a2 = accel[0] - x[13], accel[1] - x[14], accel[2] - x[15]
    w0, w1, w2 = (gyro[0] - x[10]) * dt_s, (gyro[1] - x[11]) * dt_s, (gyro[2] - x[12]) * dt_s
    F = np.eye(15)
    for i in range(3):
        F[i, 3 + i] = dt_s
        # -R [a]x dt
        F[3 + i, 6] = -(R[i, 1] * a2 - R[i, 2] * a1) * dt_s
        F[3 + i, 7] = -(R[i, 2] * a0 - R[i, 0] * a2) * dt_s
        F[3 + i, 8] = -(R[i, 0] * a1 - R[i, 1] * a0) * dt_s
        F[6 + i, 10 - 1 + i] = -dt_s
        for j in range(3):
            F[3 + i, 12 + j] = -R[i, j] * dt_s
    # Exp(-w dt) to first order
    F[6, 7], F[6, 8] = w2, -w1
    F[7, 6], F[7, 8] = -w2, w0
    F[8, 6], F[8, 7] = w1, -w0
    return F


@njit(cache=True, nogil=True)
def predict(x: Matrix, P: Matrix, gyro: Matrix, accel: Matrix, dt_s: float, noise: Matrix) -> None:
    """Move state and covariance on by one sample, in place.

    ``noise``: standard deviations of gyro (rad/s), accelerometer (m/s^2) per sample, and of the walks of the two
    biases per square root of a second.
    """
    F = _transition(x, gyro, accel, dt_s)
    n = STATES
    FP = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    FP[i, j] += f * P[k, j]
    P[:, :] = 0.0
    for j in range(n):
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(n):
                    P[i, j] += FP[i, k] * f
    for i in range(3):
        P[3 + i, 3 + i] += (noise[1] * dt_s) ** 2
        P[6 + i, 6 + i] += (noise[0] * dt_s) ** 2
        P[9 + i, 9 + i] += noise[2] ** 2 * dt_s
        P[12 + i, 12 + i] += noise[3] ** 2 * dt_s
    propagate(x, gyro, accel, dt_s)


@njit(cache=True, nogil=True)
def innovation_variance(P: Matrix, H: Matrix, variance: float) -> float:
    """Return ``H P H^T + variance`` of a scalar measurement with row ``H`` (15,)."""
    s = variance
    for i in range(STATES):
        if H[i] != 0.0:
            for j in range(STATES):
                s += H[i] * P[i, j] * H[j]
    return s


@njit(cache=True, nogil=True)
def fuse(x: Matrix, P: Matrix, H: Matrix, innovation: float, variance: float) -> None:
    """Fuse one scalar measurement, in place; ``innovation`` is measured minus predicted."""
    n = STATES
    s = innovation_variance(P, H, variance)
    PH = np.zeros(n)
    for i in range(n):
        for j in range(n):
            PH[i] += P[i, j] * H[j]
    K = PH / s
    for i in range(n):
        for j in range(n):
            P[i, j] -= K[i] * PH[j]
    for i in range(n):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean
        P[i, i] = max(P[i, i], 1e-12)
    dx = K * innovation
    for i in range(6):
        x[i] += dx[i]
    quaternion_times_exp(x[6:10], dx[6:9], 1.0)
    for i in range(6):
        x[10 + i] += dx[9 + i]


@njit(cache=True, nogil=True)
def replay(x: Matrix, samples: Matrix, count: int, out: Matrix) -> None:
    """Write to ``out`` the state ``x`` carried on through the first ``count`` rows of (dt, gyro 3, accel 3)."""
    out[:] = x
    for i in range(count):
        propagate(out, samples[i, 1:4], samples[i, 4:7], samples[i, 0])


@njit(cache=True, nogil=True)
def yaw_row(q: Matrix, H: Matrix) -> None:
    """Write the derivative of yaw with respect to the local rotation error into ``H`` (15,); zero elsewhere.

    With the attitude R Exp(e): dyaw = (sin(roll) e_y + cos(roll) e_z) / cos(pitch).
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    sine = min(1.0, max(-1.0, 2.0 * (w * y - z * x)))
    cosine = max(0.1, math.sqrt(1.0 - sine * sine))
    H[:] = 0.0
    H[7] = math.sin(roll) / cosine
    H[8] = math.cos(roll) / cosine
