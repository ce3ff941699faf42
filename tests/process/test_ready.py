"""What systemd is told, and when."""

from __future__ import annotations

import pytest

from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.runtime import run_service
from services.common.session import free_port, opened, router_config
from services.common.stop import StopSignal


def test_the_watchdog_is_first_kicked_when_the_service_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first kick arms it (systemd 252, also while starting): a start longer than WatchdogSec was killed for ever."""
    told: list[str] = []
    monkeypatch.setattr("services.common.sd_notify.notify", told.append)
    stop = StopSignal()

    def build(context: Context) -> None:
        told.append("built")
        context.every_wall(0.01, stop.set)

    session = opened(router_config(f"tcp/127.0.0.1:{free_port()}"))
    assert run_service("preview", build, TreedockConfig(), stop, session=lambda _: session) == 0
    assert told[:3] == ["built", "READY=1", "WATCHDOG=1"]
    assert told.count("READY=1") == 1
    assert "STOPPING=1" in told
