"""The names of the orders an aircraft takes, alone in a file: the command line shows them without loading the messages."""

from __future__ import annotations

from typing import Literal

CommandName = Literal["start", "hold", "resume", "abort", "land", "choose", "next"]
STOPS: frozenset[CommandName] = frozenset({"hold", "land", "abort"})
"""Orders that make safe: never too late, overtaken by none, sent to every navigator that answers."""
