"""Fusion as a process: slam's poses, the autopilot's IMU and GPS, the second camera's motion in; ``fusion/pose`` out."""

from __future__ import annotations

import math

import numpy as np

from schemas.fusion import EarthPlace, FusionState, GpsTrust
from schemas.slam import Pose
from schemas.topics import FUSION_POSE, FUSION_STATE, SECOND_POSE, SLAM_POSE, VEHICLE_GPS, VEHICLE_IMU
from schemas.vehicle import GpsFix, ImuSamples
from services.common.context import Context
from services.common.errors import InputError
from services.common.geometry import from_transform, to_transform
from services.common.mount import Mount
from services.fusion.fuser import Fuser
from services.fusion.values import Fused, GpsReading, ImuReading, Located
from services.inventory.geodesy import TangentPlane

_TICK_S = 1.0 / 15.0
_SILENT_S = 0.2
"""Slam speaks of every frame: after so long without a word the IMU carries the pose on by the clock."""
_STATE_S = 0.5
_IMU_SILENT_S = 1.0
_GOOD_FIXES = frozenset({"3d", "differential", "rtk_float", "rtk_fixed"})


class FusionService:
    """Decodes, calls the core and publishes."""

    def __init__(self, context: Context) -> None:
        self._context = context
        config, autopilot = context.config.fusion, context.config.autopilot
        self._config = config
        mount = Mount.level(autopilot.camera_offset_m, autopilot.camera_pitch_rad, autopilot.camera_yaw_rad)
        second = Mount.level(config.second.offset_m, config.second.pitch_rad, config.second.yaw_rad)
        self.fuser = Fuser(config, mount.T_body_camera, second.T_body_camera if config.second.enabled else None)
        self._plane: TangentPlane | None = None
        self._last: Pose | None = None
        """Slam's last word, and its last with a pose."""
        self._tracked: Pose | None = None
        self._heard_ns = self._imu_ns = -1
        self._begun_ns = context.clock.now_ns()
        self._told: Fused | None = None
        self._seq = self._states = 0

    def register(self) -> None:
        """Connect to the bus."""
        c, config = self._context, self._config
        c.on(SLAM_POSE, self.on_pose)
        if config.imu:
            c.on(VEHICLE_IMU, self.on_imu)
        if config.gps:
            c.on(VEHICLE_GPS, self.on_gps)
        if config.second.enabled:
            c.on(SECOND_POSE, self.on_second)
        c.every(_TICK_S, self.on_tick)
        c.every(_STATE_S, self.on_state)

    def on_imu(self, message: ImuSamples) -> None:
        """Take the autopilot's samples."""
        self._imu_ns = self._context.clock.now_ns()
        for s in message.samples:
            self.fuser.imu(ImuReading(s.stamp_ns, np.array(s.gyro_rad_s), np.array(s.accel_m_s2)))

    def on_gps(self, message: GpsFix) -> None:
        """Take a fix that has three dimensions."""
        if message.fix not in _GOOD_FIXES:
            return
        if self._plane is None:
            self._plane = TangentPlane(message.latitude_deg, message.longitude_deg, message.altitude_m)
        n = self._config.gps_noise
        place = self._plane.from_geodetic(message.latitude_deg, message.longitude_deg, message.altitude_m)
        sigma_m = message.horizontal_sigma_m if message.horizontal_sigma_m is not None else n.slow_m
        self.fuser.fix(GpsReading(message.stamp_ns - round(n.delay_s * 1e9), np.array(place), sigma_m))

    def on_pose(self, message: Pose) -> None:
        """Take slam's word of one frame and tell the pose at once."""
        self._heard_ns, self._last = self._context.clock.now_ns(), message
        located = as_located(message)
        if located is not None:
            self._tracked = message
        with self._context.health.timed("fuse"):
            fused = self.fuser.camera(message.stamp_ns, located)
        self._context.health.count("frames")
        self._tell(fused, message)

    def on_second(self, message: Pose) -> None:
        """Take the second camera's place."""
        with self._context.health.timed("second"):
            fused = self.fuser.second(message.stamp_ns, as_located(message))
        if fused is not None and self._last is not None:
            self._tell(fused, self._last)

    def on_tick(self) -> None:
        """Carry the pose on while slam is silent."""
        silent_s = (self._context.clock.now_ns() - self._heard_ns) * 1e-9
        if self._last is None or silent_s < _SILENT_S:
            return
        fused = self.fuser.silence(self.fuser.inertial.newest_ns)
        if fused is not None:
            self._tell(fused, self._last)

    def on_state(self) -> None:
        """Tell how fusion stands."""
        c, f, now_ns = self._context, self.fuser, self._context.clock.now_ns()
        trust: GpsTrust = "off" if f.gps is None else f.gps.trust(now_ns)
        word = f.gps.jury.why if f.gps is not None and trust == "distrusted" else ""
        accel, gyro = f.bias
        since_ns = now_ns if self._tracked is None else self._tracked.stamp_ns
        self._states += 1
        c.publish(FUSION_STATE, FusionState(
            stamp_ns=now_ns, seq=self._states, map_id=None if self._tracked is None else self._tracked.map_id,
            carrier="none" if self._told is None else self._told.carrier,
            carried_s=min(max((now_ns - since_ns) * 1e-9, 0.0), 1e6), gps=trust, gps_word=word, place=self._place(),
            accel_bias_m_s2=_tuple(accel), gyro_bias_rad_s=_tuple(gyro), restarts=f.restarts,
            jumps_announced=f.jumps_announced,
        ))  # fmt: skip
        c.health.counters["restarts"] = f.restarts
        c.health.counters["contradicted"] = f.guard.contradicted
        late = self._config.imu and now_ns - max(self._imu_ns, self._begun_ns) > _IMU_SILENT_S * 1e9
        c.health.note("imu", "no samples from the autopilot: does it send HIGHRES_IMU on this link?" if late else "")
        if now_ns < f.guard.banned_until_ns:
            c.health.note(
                "imu", "left out: slam kept to what it contradicted; look at the camera's mount, and at vibration"
            )
        c.health.note("gps", f"not believed: {word}" if word else "")

    def _tell(self, fused: Fused | None, slam: Pose) -> None:
        """Publish a pose: slam's own where the first camera stands behind it."""
        self._told = fused
        self._seq += 1
        resets = (slam.reset_counter + self.fuser.resets) % 256
        if fused is not None and fused.carrier == "camera":
            pose = slam.model_copy(update={"seq": self._seq, "reset_counter": resets})
        else:
            pose = self._without_camera(fused, slam, resets)
        self._context.publish(FUSION_POSE, pose)
        self._context.health.count(f"by_{'none' if fused is None else fused.carrier}")

    def _without_camera(self, fused: Fused | None, slam: Pose, resets: int) -> Pose:
        status = "dead_reckoned" if fused is not None else slam.status if slam.status != "tracking" else "lost"
        tracked = self._tracked or slam
        return Pose(
            stamp_ns=slam.stamp_ns if fused is None else fused.stamp_ns, seq=self._seq,
            map_id=slam.map_id if fused is None else tracked.map_id, status=status,
            T_map_camera=None if fused is None else to_transform(fused.T_map_camera),
            covariance=None if fused is None else tuple(float(c) for c in fused.covariance[np.triu_indices(6)]),
            reset_counter=resets, graph_version=slam.graph_version, keyframe_id=None, T_keyframe_camera=None, inliers=0,
            up_sigma_rad=slam.up_sigma_rad, processing_ms=slam.processing_ms,
        )  # fmt: skip

    def _place(self) -> EarthPlace | None:
        found = self.fuser.on_earth()
        if found is None or self._plane is None:
            return None
        (east, north, up), R, sigma_m = found
        latitude, longitude, altitude = self._plane.to_geodetic(float(east), float(north), float(up))
        heading = math.atan2(float(R[0, 0]), float(R[1, 0]))
        return EarthPlace(
            latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude, heading_rad=heading,
            sigma_m=min(sigma_m, 1e6),
        )  # fmt: skip


def as_located(message: Pose) -> Located | None:
    """Return a pose message as a place, None when slam has none."""
    if message.status != "tracking" or message.T_map_camera is None or message.covariance is None:
        return None
    C = np.zeros((6, 6))
    C[np.triu_indices(6)] = message.covariance
    covariance = C + np.triu(C, 1).T
    epoch = message.map_id, message.reset_counter
    return Located(message.stamp_ns, from_transform(message.T_map_camera), covariance, epoch)


def _tuple(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def build(context: Context) -> FusionService:
    """Start fusion on a context.

    Raises:
        InputError: it is switched off, so that nobody would take what it says.
    """
    if not context.config.fusion.enabled:
        raise InputError(
            "fusion.enabled is false: navigator and autopilot take slam's pose; set fusion.enabled=true for all services"
        )
    service = FusionService(context)
    service.register()
    return service
