"""The simulator process: a forest, a camera in it, and time; what carries the camera is the mode's choice."""

from __future__ import annotations

from services.common.context import Context
from services.simulator.config import SimulatorConfig
from services.simulator.external import ExternalFlight
from services.simulator.flight import Flight
from services.simulator.scan import Scan


def build(context: Context) -> Scan | Flight | ExternalFlight:
    """Build the world and register the work of the configured mode.

    Raises:
        InputError: for an unknown scene, or an address that cannot be used.
    """
    config: SimulatorConfig = context.config.simulator
    if config.mode == "scan":
        return Scan(context, config)
    if config.mode == "external":
        return ExternalFlight(context, config)
    return Flight(context, config)
