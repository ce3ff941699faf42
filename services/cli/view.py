"""``treedock view``: a recording, or the running system, in the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
    from services.view.rerun_scene import Scene


def view(
    file: Annotated[Path | None, typer.Argument(help="MCAP recording; without one: the running system.")] = None,
    *,
    save: Annotated[Path | None, typer.Option("--save", help="Write a .rrd file instead of opening a window.")] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> int:
    """Show camera, path, cloud, trees and events in rerun (needs the extra named view)."""
    from services.view.rerun_scene import Scene, load_rerun

    rerun = load_rerun()
    recording = rerun.RecordingStream("treedock")
    if save is not None:
        rerun.save(save, recording=recording)
    else:
        rerun.spawn(recording=recording)
    scene = Scene(rerun, recording)
    if file is not None:
        faults = _play(file, scene)
    else:
        faults = 0
        _follow(loaded(config, settings, port).config, scene)
    recording.flush()
    where = f" in {save}" if save is not None else ""
    typer.echo(f"{scene.shown} messages shown{where}" + (f", {faults} could not be read" if faults else ""), err=True)
    return 0 if scene.shown else 3


def _play(file: Path, scene: Scene) -> int:
    """Show a recording as fast as it is read; return how many messages could not be."""
    from services.recorder.reader import Recorded, messages

    faults = 0
    for entry in messages(file):
        if not isinstance(entry, Recorded):
            faults += 1
        elif not entry.topic.beside:
            scene.show(entry.message)
    return faults


def _follow(tree: Any, scene: Scene) -> None:  # noqa: ANN401 - TreedockConfig is heavy to import for --help
    """Show what the bus says until Ctrl-C."""
    from schemas.topics import CAMERA_COMPRESSED, MAP_CLOUD, MISSION_STATE, SLAM_POSE, TREES_LIST, TREES_TARGET
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_node
    from services.common.stop import StopSignal

    stop = StopSignal()
    stop.install()
    with opened_node(tree, None, lambda: stop.is_set, wait_s=0.0) as session:
        bus = Bus(session, tree.uav, HealthBook())
        for submap in bus.ask(MAP_CLOUD, None, MAP_CLOUD.message, 2.0):
            scene.show(submap)
        for topic in (CAMERA_COMPRESSED, SLAM_POSE, MAP_CLOUD, TREES_LIST, TREES_TARGET, MISSION_STATE):
            bus.subscribe(topic, scene.show)
        stop.when_set(bus.inbox.wake)
        while not stop.is_set:
            taken = bus.inbox.take()
            if taken is None:
                bus.inbox.wait(0.5)
            else:
                taken[0].handler(taken[1])
