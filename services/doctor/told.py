"""A service as its health tells it: the same for the doctor and for preflight. Pure."""

from __future__ import annotations

from schemas.health import Health
from services.common.timekeeping import told_ahead_s
from services.doctor.model import ServiceFact
from services.recorder.space import told_space_bytes
from services.security.expiry import told_days_left


def told(
    health: Health, *, age_s: float = 0.0, clock_offset_s: float | None = None, twice: bool = False
) -> ServiceFact:
    """Return what a service says of itself, its machine's clock, its certificate and its disk.

    Args:
        health: its latest.
        age_s: since when it came.
        clock_offset_s: its stamp against the listener's clock; None where that says nothing.
        twice: whether another process speaks as it, too.
    """
    free, reserve = told_space_bytes(health.counters)
    return ServiceFact(
        health.service, health.state, health.pid, health.note, age_s, health.rates_hz, clock_offset_s=clock_offset_s,
        version=health.version, clock_ahead_s=told_ahead_s(health.counters), certificate_days=told_days_left(health.counters),
        disk_free_bytes=free, disk_reserve_bytes=reserve, twice=twice,
    )  # fmt: skip
