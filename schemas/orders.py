"""The names of the orders an aircraft takes, alone in a file: the command line shows them without loading the messages."""

from __future__ import annotations

from typing import Literal

CommandName = Literal["start", "hold", "resume", "abort", "land", "choose", "next"]
