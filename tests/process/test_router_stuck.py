"""A machine that is out of reach does not stop the bus for the others, neither at once nor when its sessions end."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise

import zenoh

from services.common.session import client_config, opened
from tests.process.conftest import System

_AWAY = """
import sys, time, zenoh
from services.common.session import client_config, opened
with opened(client_config(sys.argv[1])) as session:
    session.declare_subscriber("stuck/**", lambda _: None)
    print("up", flush=True)
    time.sleep(600.0)
"""
_MACHINES_SERVICES = 6
_WATCHED_S = 16.0
"""The router ends a session 10 s after its last sign of life."""


def test_a_machine_that_is_lost_does_not_stop_the_others(routed: System) -> None:
    endpoint = routed.endpoint
    command = [sys.executable, "-c", _AWAY, endpoint]
    away = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(_MACHINES_SERVICES)]
    heard_s: list[float] = []
    stop = threading.Event()
    try:
        for process in away:
            assert process.stdout is not None
            assert process.stdout.readline() == "up\n"
        with opened(client_config(endpoint)) as sender, opened(client_config(endpoint)) as listener:
            listener.declare_subscriber("stuck/**", lambda _: heard_s.append(time.monotonic()))
            frames = sender.declare_publisher("stuck/frames", congestion_control=zenoh.CongestionControl.DROP)

            def send() -> None:
                while not stop.wait(1.0 / 30.0):
                    frames.put(bytes(200_000))

            thread = threading.Thread(target=send)
            thread.start()
            time.sleep(1.0)
            for process in away:
                process.send_signal(signal.SIGSTOP)  # its connections fill, and nobody reads
            time.sleep(_WATCHED_S)
            heard_s.append(time.monotonic())
            stop.set()
            thread.join()
    finally:
        stop.set()
        for process in away:
            process.kill()
            process.communicate()
    assert len(heard_s) > 100
    assert max(b - a for a, b in pairwise(heard_s)) < 2.0
