"""What a run is made of: scene, ports, where state is kept, and which services it needs."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from services.common.errors import InputError
from services.station.launch import station_services

if TYPE_CHECKING:
    from services.common.config import TreedockConfig
    from services.common.config_loader import LoadedConfig

_TREES_ANYWAY = 2
"""A scene drawn at random holds at least one tree to dock at."""
_SIMULATED_S_A_TREE, _WALL_S_A_TREE = 120.0, 400.0


def with_trees(tree: TreedockConfig) -> TreedockConfig:
    """Return ``tree`` with a random scene that holds as many trees as the mission is to visit, and the time for it."""
    wanted, simulator = tree.navigator.trees_wanted, tree.simulator
    if tree.camera.source != "sim" or wanted < _TREES_ANYWAY:
        return tree
    from services.simulator.catalogue import trees_to_ask_for

    asked = simulator.trees
    if asked is None:
        asked = trees_to_ask_for(simulator.scene, simulator.seed, wanted)
    limit_s = max(simulator.flight.limit_s, wanted * _SIMULATED_S_A_TREE)
    within_s = max(tree.supervisor.mission_within_s, wanted * _WALL_S_A_TREE)
    flight = simulator.flight.model_copy(update={"limit_s": limit_s})
    return tree.model_copy(update={
        "simulator": simulator.model_copy(update={"trees": asked, "flight": flight}),
        "supervisor": tree.supervisor.model_copy(update={"mission_within_s": within_s}),
    })  # fmt: skip


def with_own_inventory(found: LoadedConfig) -> TreedockConfig:
    """Return the configuration without the places that this machine's files give the installed station's inventory and book.

    They are that station's: a run has the user's own, or its folder's.
    """
    from services.common.config_loader import SYSTEM_DIRECTORY

    station = found.config.station
    for section, key in (("inventory", "database"), ("fleet", "book")):
        if Path(found.origins.get(f"station.{section}.{key}", "")).parent == SYSTEM_DIRECTORY:
            own = getattr(station, section).model_copy(update={key: ""})
            station = station.model_copy(update={section: own})
    return found.config.model_copy(update={"station": station})


def with_state(tree: TreedockConfig, folder: Path) -> TreedockConfig:
    """Return ``tree`` with map and tree ids kept in an empty ``folder``: they outlive a service that dies, not the run."""
    shutil.rmtree(folder, ignore_errors=True)
    update: dict[str, object] = {}
    if tree.mapper.state_dir == "auto":
        update["mapper"] = tree.mapper.model_copy(update={"state_dir": str(folder)})
    if tree.detector.state_dir == "auto":
        update["detector"] = tree.detector.model_copy(update={"state_dir": str(folder)})
    if tree.slam.map_folder is None:
        update["slam"] = tree.slam.model_copy(update={"map_folder": folder / "slam"})
    return tree.model_copy(update=update)


def with_recorder(tree: TreedockConfig, record: Path | None, logs: Path | None) -> TreedockConfig:
    """Return ``tree`` with a recorder: of everything into ``record``, else of the missions' reports alone.

    The reports then lie beside the kept ``logs``, or in the user's state folder.
    """
    if record is not None:
        update: dict[str, object] = {"folder": record.absolute()}
    else:
        state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
        update = {"mcap": False, "folder": logs.absolute() / "reports" if logs else state / "treedock" / "reports"}
    return tree.model_copy(update={"recorder": tree.recorder.model_copy(update=update)})


def expected_frames(tree: TreedockConfig) -> int | None:
    """Return how many frames the source will give, None when nobody knows.

    A recording is opened for it, which also finds its faults half a minute before the camera service would; so is the
    name of a scene looked up.

    Raises:
        InputError: a source or scene that cannot be used.
    """
    if tree.camera.source == "sim":
        from services.simulator.catalogue import scene_for

        scene_for(tree.simulator.scene, tree.simulator.seed, tree.simulator.trees)
        return None
    if tree.camera.source == "realsense":
        from services.camera.sources.realsense import require_library

        require_library()
        return None
    from services.camera.sources import open_source

    return open_source(tree.camera.source, tree.camera).expected


def with_port(tree: TreedockConfig, *, fixed: bool) -> TreedockConfig:
    """Return ``tree`` with a free router port: the configured one, else, unless it is ``fixed``, any.

    Raises:
        InputError: the fixed port is taken, or the address is not this machine's.
    """
    from services.common.session import free_port, why_not_listen

    host, port = tree.router.host, tree.router.port
    why = why_not_listen(host, port)
    if not why:
        return tree
    if fixed or why_not_listen(host, 0):  # 0: any port
        raise InputError(why)
    return tree.model_copy(update={"router": tree.router.model_copy(update={"port": free_port(host)})})


def services_for(tree: TreedockConfig, *, join: bool = False) -> tuple[str, ...]:
    """Return the services of a run, in the order in which they start; ``join``: router and station run elsewhere."""
    from services.cli.mission import flies, guides

    chain = _chain(tree, flies=flies(tree), guides=guides(tree))
    return tuple(name for name in chain if not (join and name in ("router", "station")))


def _chain(tree: TreedockConfig, *, flies: bool, guides: bool) -> tuple[str, ...]:
    station = station_services()
    shown = (*station, "preview") if station else ()
    kept = ("recorder",) if tree.recorder.mcap or flies or guides else ()
    second = ("second_camera", "second_slam") if tree.fusion.enabled and tree.fusion.second.enabled else ()
    fused = ("fusion", *second) if tree.fusion.enabled else ()
    chain = ("router", *shown, *kept, "camera", "slam", *fused, "mapper", "detector", "refiner")
    if flies:
        return (*chain, "navigator", "autopilot", "simulator")
    if guides:
        chain = (*chain, "navigator")
    return (*chain, "simulator") if tree.camera.source == "sim" else chain
