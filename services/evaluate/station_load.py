"""Aircraft that exist on the bus only: what the radio carries of many of them, at a steady rate, counted."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from typing import Self

import msgpack
import numpy as np

from schemas.health import Health
from schemas.navigation import MissionState
from schemas.slam import Pose
from schemas.topics import HEALTH, MISSION_STATE, SLAM_POSE, TREES_LIST, TREES_TARGET, VEHICLE_STATE
from schemas.trees import Target, Tree, TreeList
from schemas.vehicle import VehicleState
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.geometry import level_camera, to_transform
from services.common.session import opened_client

_VARIANTS = 8
_SPACING_M = 2.5
_TICKS_A_SECOND = 5


def grown_trees(count: int, rng: np.random.Generator) -> list[Tree]:
    """Return trees on a jittered grid: none nearer than 1.5 m to another."""
    side = int(np.ceil(np.sqrt(count)))
    trees = []
    for k in range(count):
        x, y = (np.array(divmod(k, side)) - side / 2.0) * _SPACING_M + rng.uniform(-0.5, 0.5, 2)
        trees.append(Tree(
            id=k + 1, x_m=float(x), y_m=float(y), z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=float(rng.uniform(0.04, 0.25)),
            radius_height_m=1.3, height_seen_m=2.2, sigma_xy_m=0.03, sigma_radius_m=0.005, arc_rad=1.5, confidence=0.9,
            observations=5, suitable=bool(rng.random() < 0.8),
        ))  # fmt: skip
    return trees


class FakeAircraft:
    """One aircraft's radio traffic. The lists are packed beforehand: the load must not be the measurement."""

    def __init__(self, bus: Bus, number: int, trees: int, seed: int, list_every: int = 1, services: int = 0) -> None:
        """Make one; it tells its list every so many ticks, and of so many ``services`` their health once a second."""
        self.bus = bus
        self._list_every, self._services = list_every, services
        self._health_phase = number
        self.sent = 0
        self.version = 0
        self.told: list[tuple[float, int]] = []
        """Monotonic time and version of each list sent."""
        self._map_id = f"map-{seed}-{number}"
        rng = np.random.default_rng([seed, number])
        base = grown_trees(trees, rng)
        self._lists = [self._variant(base, rng) for _ in range(_VARIANTS)]
        self._phase = number
        bus.declare_live("navigator")
        self._publisher = bus._publisher(TREES_LIST, TREES_LIST.key(bus.uav))  # noqa: SLF001 - packed bytes

    @staticmethod
    def _variant(base: list[Tree], rng: np.random.Generator) -> list[dict[str, object]]:
        noise = rng.normal(0.0, 0.004, (len(base), 2))
        return [
            {**tree.model_dump(mode="python"), "x_m": tree.x_m + float(dx), "y_m": tree.y_m + float(dy)}
            for tree, (dx, dy) in zip(base, noise, strict=True)
        ]

    def tick(self, step: int) -> None:
        """Send one of everything."""
        stamp_ns, t = time.time_ns(), step * 0.2 + self._phase
        yaw, x, y = (0.2 * t + np.pi) % (2.0 * np.pi) - np.pi, 4.0 * np.cos(0.1 * t), 4.0 * np.sin(0.1 * t)
        self.bus.publish(SLAM_POSE, Pose(
            stamp_ns=stamp_ns, seq=step, map_id=self._map_id, status="tracking", covariance=None, reset_counter=0,
            T_map_camera=to_transform(level_camera([x, y, 1.5], float(yaw))), graph_version=0, keyframe_id=None,
            T_keyframe_camera=None, inliers=200, up_sigma_rad=0.01, processing_ms=10.0,
        ))  # fmt: skip
        self.bus.publish(MISSION_STATE, MissionState(
            stamp_ns=stamp_ns, seq=step, map_id=self._map_id, state="scan", previous="take_off", since_ns=0, reason="bench",
            target_tree_id=None, visited_tree_ids=(), docked_count=0, distance_m=None, heading_error_rad=None,
        ))  # fmt: skip
        self.bus.publish(VEHICLE_STATE, VehicleState(
            stamp_ns=stamp_ns, seq=step, connected=True, armed=True, mode="offboard", landed="in_air",
            quaternion_map_body=None, position_map_m=None, velocity_map_m_s=None, battery_share=0.8, vision_fused=True,
            operator_override=False, engaged_mission_id=1, link_age_s=0.0,
        ))  # fmt: skip
        self.bus.publish(TREES_TARGET, Target(
            stamp_ns=stamp_ns, seq=step, map_id=self._map_id, status="none", tree_id=None, measured=False,
            bearing_rad=None, range_m=None, radius_m=None, image_x_px=None, sigma_bearing_rad=None, sigma_range_m=None,
            sigma_radius_m=None, raw_image_x_px=None, raw_range_m=None, raw_radius_m=None, position_map_m=None,
            covariance_map_m2=None,
        ))  # fmt: skip
        self.sent += 4
        if step % self._list_every == 0:
            self._send_trees(stamp_ns)
            self.sent += 1
        if self._services and (step + self._health_phase) % _TICKS_A_SECOND == 0:
            self._send_health(stamp_ns, step)

    def _send_health(self, stamp_ns: int, step: int) -> None:
        for k in range(self._services):
            name = f"service{k}"
            self.bus.publish(HEALTH, Health(
                service=name, stamp_ns=stamp_ns, seq=step // _TICKS_A_SECOND, state="ready", pid=1, uptime_s=1.0,
                counters={"frames": step, "decode_errors": 0}, rates_hz={"slam/pose": 15.0, "trees/target": 15.0},
                work_ms={"step": 1.2}, version="bench",
            ), name)  # fmt: skip
        self.sent += self._services

    def _send_trees(self, stamp_ns: int) -> None:
        self.version += 1
        body = {
            "schema": TreeList.schema_id(), "stamp_ns": stamp_ns, "map_id": self._map_id, "version": self.version,
            "graph_version": 0, "trees": self._lists[self.version % _VARIANTS],
        }  # fmt: skip
        self._publisher.put(msgpack.packb(body, use_bin_type=True))
        self.told.append((time.monotonic(), self.version))


class Load:
    """Many aircraft on sessions of their own, sent by one thread; a context manager."""

    def __init__(
        self, endpoint: str, aircraft: int, rate_hz: float, trees: int, seed: int, list_every: int = 1, services: int = 0
    ) -> None:  # fmt: skip
        self._stack = ExitStack()
        self.aircraft: list[FakeAircraft] = []
        for number in range(1, aircraft + 1):
            session = self._stack.enter_context(opened_client(endpoint, lambda: False, wait_s=20.0))
            self.aircraft.append(FakeAircraft(
                Bus(session, f"uav{number}", HealthBook()), number, trees, seed, list_every, services
            ))  # fmt: skip
        self._period_s = 1.0 / rate_hz
        self._step = 0
        self._running = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="load", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._running.set()
        self._thread.join(5.0)
        self._stack.close()

    def go(self, *, on: bool) -> None:
        """Send, or pause (a pause of more than a second: everything sent has arrived)."""
        if on:
            self._running.set()
        else:
            self._running.clear()

    @property
    def sent(self) -> int:
        """Messages sent so far by all aircraft."""
        return sum(a.sent for a in self.aircraft)

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._over.is_set():
            self._running.wait()
            for aircraft in self.aircraft:  # one after the other: aircraft do not speak in step
                next_s = max(next_s + self._period_s / len(self.aircraft), time.monotonic() - self._period_s)
                time.sleep(max(0.0, next_s - time.monotonic()))
                if self._over.is_set():
                    return
                aircraft.tick(self._step)
            self._step += 1
