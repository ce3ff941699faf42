"""Looks at this machine and at the bus; judging is in ``findings``."""

from __future__ import annotations

import datetime as dt
import os
import resource
import shutil
import stat
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.health import Health
from schemas.topics import HEALTH
from services.common.errors import InputError
from services.doctor.findings import Facts, ServiceFact

if TYPE_CHECKING:
    from services.common.config import TreedockConfig

_LISTEN_S = 1.6
"""Health comes once a second."""


def gather(config: TreedockConfig) -> Facts:
    """Return what can be found out in about two seconds."""
    router, services = _bus(config)
    folder = config.security.folder
    return Facts(
        router=router,
        wanted_router=config.router.endpoint,
        services=services,
        units=_units(),
        certificates=_certificates(folder) if folder else {},
        loose_keys=_loose_keys(folder) if folder else (),
        encrypted=folder is not None,
        reachable_from_outside=_from_outside(config.router.listen_host or config.router.host),
        clock_synchronised=_synchronised(),
        locked_limit_bytes=resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] if os.geteuid() else -1,
        shm_free_bytes=_free(Path("/dev/shm")),
        disk_free_bytes=_free(_nearest(config.recorder.folder)),
        recordings_cut=_cut(config.recorder.folder),
        camera=_camera(config.camera.source),
        source=config.camera.source,
        calibration_days=_age_days(config.camera.camera_file),
    )


def _from_outside(host: str) -> bool:
    return host not in {"127.0.0.1", "::1", "[::1]", "localhost"}


def _bus(config: TreedockConfig) -> tuple[str | None, list[ServiceFact]]:
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_node

    latest: dict[str, tuple[Health, float]] = {}

    def take(health: Health) -> None:
        latest[health.service] = (health, time.monotonic())

    try:
        with opened_node(config, None, lambda: False, wait_s=0.0) as session:
            bus = Bus(session, config.uav, HealthBook())
            bus.subscribe(HEALTH, take, "*")
            deadline = time.monotonic() + _LISTEN_S
            while (left_s := deadline - time.monotonic()) > 0:
                bus.inbox.wait(left_s)
                while (taken := bus.inbox.take()) is not None:
                    taken[0].handler(taken[1])
            silent = sorted(set(bus.live_services()) - set(latest))
    except InputError:
        return None, []
    found = [_service(health, heard_s) for _, (health, heard_s) in sorted(latest.items())]
    found += [ServiceFact(name, "silent", 0, "", 99.0, {}) for name in silent]
    return config.router.endpoint, found


def _service(health: Health, heard_s: float) -> ServiceFact:
    return ServiceFact(
        health.service, health.state, health.pid, health.note, time.monotonic() - heard_s, health.rates_hz,
        _locked_bytes(health.pid), 1e-9 * health.stamp_ns - (time.time() - (time.monotonic() - heard_s)),
    )  # fmt: skip


def _locked_bytes(pid: int) -> int | None:
    """Return VmLck: what the limit says is not always what is in force."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    words = next((line.split() for line in lines if line.startswith("VmLck:")), None)
    return int(words[1]) * 1024 if words else None


def _units() -> dict[str, str]:
    if shutil.which("systemctl") is None:
        return {}
    command = ["systemctl", "list-units", "--all", "--plain", "--no-legend", "treedock*.service"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False)
    rows = [line.split() for line in done.stdout.splitlines()]
    return {row[0]: row[2] for row in rows if len(row) > 2 and row[1] == "loaded"}


def _certificates(folder: Path) -> dict[str, float]:
    from cryptography import x509

    now, found = dt.datetime.now(dt.UTC), {}
    for path in sorted(folder.glob("*.pem")):
        try:
            end = x509.load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc
        except (OSError, ValueError):
            found[path.stem] = -1.0  # unreadable or damaged is as good as expired
            continue
        found[path.stem] = (end - now).total_seconds() / 86400.0
    return found


def _loose_keys(folder: Path) -> list[str]:
    others = stat.S_IRWXG | stat.S_IRWXO
    return [str(path) for path in sorted(folder.glob("*.key")) if path.stat().st_mode & others]


def _synchronised() -> bool | None:
    if shutil.which("timedatectl") is None:
        return None
    command = ["timedatectl", "show", "-p", "NTPSynchronized", "--value"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False)
    return {"yes": True, "no": False}.get(done.stdout.strip())


def _free(path: Path) -> int | None:
    try:
        return shutil.disk_usage(path).free
    except OSError:
        return None


def _nearest(folder: Path) -> Path:
    nearest = folder.absolute()
    while not nearest.exists():
        nearest = nearest.parent
    return nearest


def _cut(folder: Path) -> list[str]:
    from services.recorder.recover import cut_recordings

    return [str(path) for path in cut_recordings(folder)] if folder.is_dir() else []


def _camera(source: str) -> str | None:
    place = source.partition(":")[2]
    if place:
        return source if Path(place).exists() else None
    devices = sorted(Path("/dev").glob("video*"))
    return f"{source}: {len(devices)} video devices" if devices else None


def _age_days(camera_file: str) -> float | None:
    try:
        return (time.time() - Path(camera_file).stat().st_mtime) / 86400.0 if camera_file else None
    except OSError:
        return None
