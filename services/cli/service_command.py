"""One subcommand per service: ``treedock slam`` runs that process until it is stopped."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import ConfigFile, Port, Settings, loaded

SERVICES = {
    "router": "The Zenoh router that all nodes meet at.",
    "camera": "Frames from the sensor, the simulator or a recording.",
    "slam": "The camera's pose for each frame, keyframes and their graph.",
    "mapper": "The dense map, submap by submap.",
    "detector": "Trees in the map, by slicing.",
    "refiner": "The target tree in the depth image, at frame rate.",
    "navigator": "The mission: scan, choose, approach, dock.",
    "autopilot": "The bridge to PX4.",
    "preview": "A small picture with the overlay, for the ground.",
    "recorder": "Everything worth keeping, into MCAP files.",
    "simulator": "A forest, a camera that sees it, and simulated time.",
}

OPTIONAL = {
    "fusion": "Slam's pose with IMU, GPS and a second camera (fusion.enabled).",
    "second_camera": "Frames of a second camera, for fusion (fusion.second.enabled).",
    "second_slam": "The second camera's motion, for fusion (fusion.second.enabled).",
}
"""Services that run only where the configuration asks for them."""

_MODULES = {
    "refiner": "services.detector.refine.service",
    "autopilot": "services.navigator.autopilot.service",
    "second_camera": "services.fusion.second_camera",
    "second_slam": "services.fusion.second_slam",
}


def service_command(name: str) -> Callable[..., int]:
    """Return the command that runs the service ``name``."""

    def command(
        *,
        config: ConfigFile = None,
        settings: Settings = None,
        port: Port = None,
        parent: Annotated[int | None, typer.Option("--parent", hidden=True)] = None,
        sim_clock: Annotated[bool, typer.Option("--sim-clock", help="Live by the simulator's time.")] = False,
    ) -> int:
        if parent is not None:
            end_with(parent)
        more = {"clock": "sim"} if sim_clock else {}
        return run_by_name(name, config, settings, port, more)

    return command


def run_by_name(
    name: str, config: Path | None, settings: list[str] | None, port: int | None, more: Mapping[str, object]
) -> int:
    """Load the configuration, then the service's module, and run it; service processes end without further ado.

    Raises:
        InputError: a configuration or an input that the service cannot use.
    """
    from services.common.errors import InputError
    from services.common.process import BACKGROUND, give_way
    from services.common.runtime import run_service
    from services.common.stop import end_process

    tree = loaded(config, settings, port, more).config
    gives_way = tree.camera.source != "sim" if tree.background_gives_way is None else tree.background_gives_way
    if gives_way and name in BACKGROUND:
        give_way(BACKGROUND[name])  # before any other thread is made: they inherit it
    if name == "router":
        from services.router.service import run

        code = run(tree)
    else:
        module = _MODULES.get(name, f"services.{name}.service")
        if find_spec(module) is None:
            raise InputError(f"the service {name} is not part of this version")
        code = run_service(name, importlib.import_module(module).build, tree)
    end_process(code)
    return code


def end_with(parent: int) -> None:
    """Stop when the supervisor that started us ends, also when it already has."""
    import os

    from services.common.process import die_with_parent

    die_with_parent()
    if os.getppid() != parent:
        raise SystemExit(0)
