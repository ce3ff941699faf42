"""The systemd units, one per service, from one table: ``python deploy/units.py`` writes deploy/systemd/.

A test keeps the files and this table equal.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "systemd"
PREFIX = "/opt/treedock"
"""Where the files say that treedock lies; ``deploy/install --prefix`` writes another place."""


@dataclass(frozen=True, slots=True)
class Unit:
    """What differs from service to service."""

    name: str
    about: str
    cpu_weight: int
    """Share of the processor when it is short: the autopilot's bridge and slam come first."""
    memory_mb: int
    """Hard limit; the service is ended and started again beyond it."""
    compiles: bool = False
    """Runs numba's machine code, which needs memory that is both written and executed."""
    devices: tuple[str, ...] = ()
    """Device classes of DeviceAllow; none: no devices at all."""
    groups: tuple[str, ...] = ()
    state: str = "treedock"
    ground: bool = False
    """Of the ground station, not aboard."""
    calls: tuple[str, ...] = ()
    """System calls beyond those that all services may make."""
    optional: bool = False
    """Not started with the others: enabled by who switched it on in the configuration."""


_CAMERAS = ("char-video4linux rw", "char-usb_device rw", "char-media rw")

UNITS: tuple[Unit, ...] = (
    Unit("router", "the Zenoh router that all nodes meet at", 500, 300),
    Unit("camera", "frames from the depth camera", 400, 800, compiles=True, devices=_CAMERAS,
         groups=("video", "plugdev")),
    # mapping gives way to tracking: a thread may lower its own priority, not raise it
    Unit("slam", "the camera's pose for each frame", 900, 1200, compiles=True, calls=("setpriority",)),
    Unit("mapper", "the dense map", 200, 1500, compiles=True),
    Unit("detector", "trees in the map", 200, 1200, compiles=True),
    Unit("refiner", "the target tree at frame rate", 600, 600, compiles=True),
    Unit("navigator", "the mission", 800, 600),
    Unit("autopilot", "the bridge to PX4", 1000, 300,
         devices=("char-ttyACM rw", "char-ttyUSB rw", "char-ttyAMA rw", "char-ttyS rw"), groups=("dialout",)),
    Unit("fusion", "slam's pose with IMU, GPS and a second camera", 850, 400, optional=True),
    Unit("second_camera", "frames from a second depth camera", 400, 800, compiles=True, devices=_CAMERAS, groups=("video", "plugdev"),
         optional=True),
    Unit("second_slam", "the second camera's motion", 600, 1200, compiles=True, calls=("setpriority",), optional=True),
    Unit("preview", "a small picture for the ground", 50, 400, compiles=True),
    Unit("recorder", "everything worth keeping, into MCAP files", 80, 600, state="treedock treedock/recordings"),
    Unit("station", "the ground station's page and inventory", 100, 800, ground=True, state="treedock treedock/inventory"),
)  # fmt: skip

_HARDENING = """\
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
ProtectProc=invisible
ProcSubset=pid
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RemoveIPC=no
LockPersonality=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources @mount @swap @reboot @obsolete
SystemCallErrorNumber=EPERM
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
UMask=0077
KeyringMode=private
"""


def service_text(unit: Unit, prefix: str = PREFIX) -> str:
    """Return the unit file of a service."""
    target = _target_of(unit)
    router = "" if unit.name == "router" else "Wants=treedock-router.service\nAfter=treedock-router.service\n"
    if unit.ground:
        router = ""
    groups = f"SupplementaryGroups={' '.join(unit.groups)}\n" if unit.groups else ""
    devices = (
        "DevicePolicy=closed\n" + "".join(f"DeviceAllow={device}\n" for device in unit.devices)
        if unit.devices
        else "PrivateDevices=yes\nDevicePolicy=closed\n"
    )
    calls = f"SystemCallFilter={' '.join(unit.calls)}\n" if unit.calls else ""
    memory = "" if unit.compiles else "MemoryDenyWriteExecute=yes\n"
    return f"""\
# made by deploy/units.py: change the table there, not this file
[Unit]
Description=treedock {unit.name}: {unit.about}
Documentation=file://{prefix}/share/doc/treedock/operations.md
PartOf={target}
After=network.target
{router}StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={prefix}/bin/treedock {unit.name}
User=treedock
Group=treedock
{groups}Environment=NUMBA_CACHE_DIR=/var/cache/treedock/numba OMP_NUM_THREADS=1 HOME=/var/lib/treedock
WorkingDirectory=/var/lib/treedock
StateDirectory={unit.state}
StateDirectoryMode=0750
CacheDirectory=treedock
CacheDirectoryMode=0750
# READY comes after the bus is joined and the kernels are loaded; on a machine whose cache is cold that takes minutes
TimeoutStartSec=300
# kicked from the work loop once a second: a hung handler is a hung service
WatchdogSec=5
Restart=always
RestartSec=500ms
TimeoutStopSec=3
# shared memory for camera frames is locked memory
LimitMEMLOCK=infinity
CPUWeight={unit.cpu_weight}
MemoryMax={unit.memory_mb}M
OOMPolicy=stop

{_HARDENING}{calls}{memory}{devices}
[Install]
WantedBy={target}
"""


def target_text(*, ground: bool) -> str:
    """Return the target that starts and stops the services of an aircraft, or of the ground station."""
    where = "ground station" if ground else "aircraft"
    wanted = [f"treedock-{unit.name}.service" for unit in UNITS if unit.ground == ground and not unit.optional]
    return f"""\
# made by deploy/units.py: change the table there, not this file
[Unit]
Description=treedock: all services of the {where}
Wants={" ".join(wanted)}
After=network.target

[Install]
WantedBy=multi-user.target
"""


def _target_of(unit: Unit) -> str:
    return "treedock-station.target" if unit.ground else "treedock.target"


def files(prefix: str = PREFIX) -> dict[str, str]:
    """Return every unit file by name."""
    found = {f"treedock-{unit.name}.service": service_text(unit, prefix) for unit in UNITS}
    found["treedock.target"] = target_text(ground=False)
    found["treedock-station.target"] = target_text(ground=True)
    return found


MEMORY_LOCK = """\
# made by deploy/install: this machine (a container) does not let LimitMEMLOCK be raised, and without locked memory camera
# frames are copied; the one capability cures it
[Service]
CapabilityBoundingSet=CAP_IPC_LOCK
AmbientCapabilities=CAP_IPC_LOCK
"""
"""A drop-in for all services of a machine that needs it."""


def main() -> int:
    """Write deploy/systemd/."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in files().items():
        (FOLDER / name).write_text(text)
    for stale in {path.name for path in FOLDER.iterdir()} - set(files()):
        (FOLDER / stale).unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
