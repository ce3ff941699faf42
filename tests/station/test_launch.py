"""The station as ``treedock run`` has it: its configuration, its port, its inventory, its address."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from rich.console import Console

from services.cli.run_plan import services_for
from services.common.config import TreedockConfig
from services.inventory.store import default_path, open_store
from services.station.launch import address_in, announce, station_services, with_station
from tests.station.conftest import ROOT, Ground, until

SIM = TreedockConfig.model_validate({"camera": {"source": "sim"}})


def test_a_run_has_a_station_where_its_libraries_are() -> None:
    assert station_services() == ("station",)
    assert "station" in services_for(SIM)


def test_simulated_trees_stay_out_of_the_users_inventory(tmp_path: Path) -> None:
    tree = with_station(SIM, tmp_path)
    assert tree.station.inventory.database == str(tmp_path / "inventory.gpkg")
    named = SIM.model_copy(update={"station": SIM.station.model_copy(
        update={"inventory": SIM.station.inventory.model_copy(update={"database": "mine.gpkg"})})})  # fmt: skip
    assert with_station(named, tmp_path).station.inventory.database == "mine.gpkg"


def test_a_real_run_uses_the_users_inventory_unless_another_station_does(tmp_path: Path) -> None:
    before = os.environ.get("XDG_DATA_HOME")
    os.environ["XDG_DATA_HOME"] = str(tmp_path)
    try:
        assert with_station(TreedockConfig(), tmp_path).station.inventory.database in {
            "",
            str(tmp_path / "inventory.gpkg"),
        }
        store = open_store(str(default_path()))
        real = TreedockConfig.model_validate({"camera": {"source": "realsense"}})
        assert with_station(real, tmp_path).station.inventory.database == str(tmp_path / "inventory.gpkg")
        store.close()
        assert with_station(real, tmp_path).station.inventory.database == ""
    finally:
        if before is None:
            del os.environ["XDG_DATA_HOME"]
        else:
            os.environ["XDG_DATA_HOME"] = before


def test_the_supervised_station_takes_another_port_when_its_own_is_taken_and_says_where_it_is(ground: Ground) -> None:
    ground.kill("station")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        tree = with_station(
            SIM.model_copy(update={"clock": "wall", "router": SIM.router.model_copy(update={"port": ground.port}),
                                   "station": SIM.station.model_copy(update={"port": taken})}), ground.folder)  # fmt: skip
        config = ground.folder / "config.json"
        config.write_text(tree.model_dump_json())
        told = io.StringIO()
        announce(Console(file=told), ground.folder, browser=True)  # no terminal: nothing is opened
        command = [
            sys.executable,
            "-m",
            "services.cli.app",
            "station",
            "--config",
            str(config),
            "--parent",
            str(os.getpid()),
        ]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
            try:
                assert until(lambda: address_in(ground.folder) != "", 20.0)
                address = address_in(ground.folder)
                assert f":{taken}/" not in address
                with urllib.request.urlopen(address, timeout=3.0) as answer:
                    assert answer.status == 200
                assert until(lambda: f"page on {address}" in told.getvalue(), 3.0)
                assert address_in(ground.folder, time.time_ns()) == ""  # of an earlier run
            finally:
                process.terminate()
                assert process.wait(5.0) == 0
