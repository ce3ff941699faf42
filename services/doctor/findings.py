"""What the doctor found, judged from facts alone: arrays of facts in, findings out. Each finding says what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from schemas.topics import CAMERA_RGBD
from services.common.memlock import too_little
from services.doctor.aboard import aboard, certificate, disk
from services.doctor.model import Facts, Finding, service_of
from services.router.radio import in_words

CALIBRATION_WARN_DAYS = 180
AUTHORITY = "ca"
"""Among the certificates: the one that all others are judged by."""
SHM_WARN_BYTES = 256_000_000
USB3_MBIT = 5000.0
LEAST_LOCKED_BYTES = 1_000_000
"""A frame of 640x480 takes 1.5 MB; a session at rest locks some 20 KB."""


def judge(facts: Facts) -> list[Finding]:
    """Return the findings, in the order in which a person would go about them."""
    found = [*_rights(facts), *_units(facts), *_bus(facts), *_security(facts), *_radio(facts), *_clock(facts)]
    return found if facts.station else [*found, *_memory(facts), *_disk(facts), *_camera(facts)]


def _rights(f: Facts) -> list[Finding]:
    words = "this user may not look into "
    return [Finding("rights", "warn", f"{words}{', '.join(f.closed)}", "sudo treedock doctor")] if f.closed else []


def _units(f: Facts) -> list[Finding]:
    if not f.units:
        return [Finding("units", "unknown", "no treedock unit is installed on this machine", "sudo deploy/install")]
    bad = {name: state for name, state in f.units.items() if state in {"failed", "activating", "deactivating"}}
    if bad:
        words = ", ".join(f"{name} is {state}" for name, state in sorted(bad.items()))
        first = sorted(bad)[0]
        return [Finding("units", "fail", words, f"journalctl -u {first} -n 50; then systemctl restart {first}")]
    stopped = sorted(name for name, state in f.units.items() if state == "inactive")
    if len(stopped) == len(f.units):
        return [Finding("units", "warn", "all units are stopped", _start(f))]
    if stopped:
        words = ", ".join(f"{name} is stopped" for name in stopped)
        do = f"{_start(f)}; one that is not wanted: sudo systemctl mask {stopped[0]}"
        return [Finding("units", "warn", words, do)]
    return [Finding("units", "ok", f"all {len(f.units)} active")]


def _bus(f: Facts) -> list[Finding]:
    if f.router is None:
        do = "systemctl status treedock-router, or start `treedock run`; is router.host right?"
        if f.station:
            do = "is the aircraft on, and the link? is router.host in /etc/treedock the aircraft's address?"
        return [Finding("router", "fail", f.router_fault or f"nobody answers at {f.wanted_router}", do)]
    found = [Finding("router", "ok", f.router), *aboard(f.services, f.vehicle, f.version)]
    heard = {service.name for service in f.services}
    silent = sorted({service_of(unit) for unit, state in f.units.items() if state == "active"} - heard)
    if silent:
        words = f"{', '.join(silent)}: running, and nothing of it is heard"
        do = f"are its certificate and this session's valid, and of the same aircraft (uav)? journalctl -u treedock-{silent[0]} -n 50"
        found.append(Finding("services", "fail", words, do))
    elif not f.services:
        words = "no service is up" + (", or this certificate is revoked or of another aircraft" if f.encrypted else "")
        found.append(Finding("services", "warn", words, _start(f)))
    return found


def _start(f: Facts) -> str:
    return f"sudo systemctl start treedock{'-station' if f.station else ''}.target"


def _security(f: Facts) -> list[Finding]:
    if not f.encrypted:
        if f.reachable_from_outside:
            do = "treedock certs init / issue / export, then security.folder and router.protocol = tls"
            return [
                Finding("encryption", "fail", "the bus is plain and listens to other machines: anybody can fly", do)
            ]
        return [Finding("encryption", "ok", "the bus is plain and stays on this machine")]
    do = "treedock certs export on the fleet's machine, then here: sudo treedock certs import FOLDER"
    found = [Finding("certificate", "fail", fault, do) for fault in f.certificate_faults]
    for identity, days in sorted(f.certificates.items()):
        found += _authority(days) if identity == AUTHORITY else certificate(identity, days)
    found += [Finding("keys", "fail", f"{path} can be read by others", f"chmod 600 {path}") for path in f.loose_keys]
    found += [
        Finding(
            "keys",
            "fail",
            f"{path} does not belong to the services' user",
            f"chown --reference={Path(path).parent} {path}",
        )
        for path in f.foreign_keys
    ]
    if not found and not f.certificates:
        return [Finding("certificates", "unknown", "they could not be looked at", "sudo treedock doctor")]
    return found or [Finding("certificates", "ok", f"{len(f.certificates)} valid")]


def _radio(f: Facts) -> list[Finding]:
    do = "ip link shows this machine's interfaces; correct security.radio_interfaces in /etc/treedock"
    return [Finding("radio", "warn", in_words(f.radio_absent), do)] if f.radio_absent else []


def _authority(days: float) -> list[Finding]:
    do = "treedock certs init --folder ANOTHER, and issue, export and import all certificates anew"
    return [replace(finding, do=do) for finding in certificate("the authority's own", days)]


def _clock(f: Facts) -> list[Finding]:
    if f.clock_synchronised is False:
        do = "install chrony; on the aircraft take the ground station's clock as server"
        return [Finding("clock", "warn", "this machine's clock is not synchronised", do)]
    if f.clock_synchronised is None:
        do = "nothing here says whether the clock is right (no timedatectl): look at it yourself"
        return [Finding("clock", "unknown", "no word from timedatectl", do)]
    return [Finding("clock", "ok", "synchronised")]


def _memory(f: Facts) -> list[Finding]:
    if f.shm_free_bytes is not None and f.shm_free_bytes < SHM_WARN_BYTES:
        text = f"/dev/shm has {f.shm_free_bytes // 1_000_000} MB left: camera frames will not fit"
        return [Finding("shared memory", "fail", text, "free it, or mount it larger (size= in /etc/fstab)")]
    here = [service for service in f.services if service.lockable_bytes is not None]
    poor = [service for service in here if too_little(service.lockable_bytes)]
    cure = (
        "LimitMEMLOCK=infinity in the unit; where that is not in force (containers), CAP_IPC_LOCK: sudo deploy/install"
    )
    if poor:
        least = min(service.lockable_bytes or 0 for service in poor) // 1000
        names = ", ".join(service.name for service in poor)
        words = f"{names} may lock only {least} KB: shared memory is off there, frames cost four times as much"
        return [Finding("shared memory", "warn", words, cure)]
    if not here and too_little(f.lockable_bytes):
        words = f"this session may lock {(f.lockable_bytes or 0) // 1000} KB: started from here, frames would be copied"
        return [Finding("shared memory", "warn", words, cure)]
    return _frames_shared(f, cure)


def _frames_shared(f: Facts, cure: str) -> list[Finding]:
    """Look at VmLck of a camera that sends: the frames lie there, or shared memory is not in force."""
    camera = next((service for service in f.services if service.name == "camera"), None)
    if camera is None or camera.locked_bytes is None or camera.rates_hz.get(CAMERA_RGBD.name, 0.0) < 1.0:
        return [Finding("shared memory", "ok", "may be used; whether it is shows when frames flow")]
    megabytes = camera.locked_bytes / 1e6
    if camera.locked_bytes < LEAST_LOCKED_BYTES:
        words = f"frames flow and the camera's process locks {megabytes:.1f} MB (VmLck): they are copied"
        return [Finding("shared memory", "warn", words, cure)]
    return [Finding("shared memory", "ok", f"in force: the camera's process locks {megabytes:.0f} MB (VmLck)")]


def _disk(f: Facts) -> list[Finding]:
    found = [] if f.disk_free_bytes is None else [disk("disk", f.disk_free_bytes, f.disk_reserve_bytes)]
    if f.recordings_cut:
        words = f"{len(f.recordings_cut)} recording(s) were cut short"
        found.append(Finding("recordings", "warn", words, "treedock recordings --recover"))
    return found


def _camera(f: Facts) -> list[Finding]:
    if f.source == "sim" and f.real:
        do = 'camera.source = "realsense" in /etc/treedock; or autopilot.vehicle = "simulation"'
        return [Finding("camera", "fail", "simulated, for a real aircraft (autopilot.vehicle = real)", do)]
    if f.source == "sim":
        return [Finding("camera", "ok", "simulated (camera.source = sim)")]
    return [_sensor(f), *_calibration(f)]


def _sensor(f: Facts) -> Finding:
    if f.camera is None:
        do = "lsusb; another cable and port; udevadm control --reload; is the user in groups video and plugdev?"
        return Finding("camera", "fail", f"{f.source}: not found", do)
    if f.camera_mbit is not None and f.camera_mbit < USB3_MBIT:
        words = f"{f.camera} on a slow USB link ({f.camera_mbit:.0f} Mbit/s): frames will be missing"
        return Finding("camera", "warn", words, "a USB 3 port and cable")
    return Finding("camera", "ok", f.camera)


def _calibration(f: Facts) -> list[Finding]:
    do = "treedock calibrate IMAGES... makes a new one (docs/calibration.md)"
    if not f.camera_file:
        return [Finding("calibration", "ok", "the source's own (camera.camera_file is not set)")]
    if f.camera_fault:
        return [Finding("calibration", "fail", f.camera_fault, do)]
    if f.calibration_days is None:
        return [Finding("calibration", "warn", f"{f.camera_file} does not say when it was made", do)]
    if f.calibration_days < -1:  # a day is the maker's, who may live east of here
        words = f"{f.camera_file} was made {-f.calibration_days:.0f} days in the future"
        return [
            Finding("calibration", "warn", words, "is this machine's date right (date)? if so, its maker's was not")
        ]
    words = f"{f.camera_file}, {f.calibration_days:.0f} days old"
    return [Finding("calibration", "warn" if f.calibration_days > CALIBRATION_WARN_DAYS else "ok", words, do)]
