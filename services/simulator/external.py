"""placeholder"""

from __future__ import annotations

from services.common.context import Context
from services.simulator.config import SimulatorConfig


class ExternalFlight:
    """Not yet."""

    def __init__(self, context: Context, config: SimulatorConfig) -> None:
        raise NotImplementedError
