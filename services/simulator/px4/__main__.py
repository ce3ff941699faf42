"""Stands in for PX4 SITL: the simulated autopilot in real time, in a process of its own.

``python -m services.simulator.px4 REMOTE_PORT [SCENE SEED]`` speaks to 127.0.0.1:REMOTE_PORT until its parent ends.
"""

from __future__ import annotations

import os
import sys
import time

from services.simulator.catalogue import scene_for
from services.simulator.config import SimulatorConfig
from services.simulator.flight import simulated_px4
from services.simulator.px4.config import LinkConfig, Px4Config
from services.simulator.px4.runner import RealTimeRunner
from services.simulator.px4.warm import warm

_TICK_S = 0.004


def main() -> None:
    """Run until the process that started this one ends."""
    port = int(sys.argv[1])
    name, seed = (sys.argv[2], int(sys.argv[3])) if len(sys.argv) > 3 else ("random-mission", 1)
    px4_config = Px4Config(links=(LinkConfig(local_port=0, remote_port=port),))
    config = SimulatorConfig(px4=px4_config, seed=seed)
    warm()
    px4 = simulated_px4(scene_for(name, seed), config)
    px4.open_links()
    parent = os.getppid()
    with RealTimeRunner(px4.step, _TICK_S):
        while os.getppid() == parent:
            time.sleep(0.2)


if __name__ == "__main__":
    main()
