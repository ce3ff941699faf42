"""The real mapper as a process, with a state folder: ``python -m tests.process.map_nodes PORT FOLDER``."""

from __future__ import annotations

import sys

from services.common.config import TreedockConfig
from services.common.runtime import run_service
from services.common.stop import end_process
from services.mapper.config import MapperConfig
from services.mapper.service import build
from services.router.config import RouterConfig

if __name__ == "__main__":
    mapper = MapperConfig(state_dir=sys.argv[2], save_s=0.5)
    end_process(run_service("mapper", build, TreedockConfig(router=RouterConfig(port=int(sys.argv[1])), mapper=mapper)))
