"""Types of settings that several sections share."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Near = Annotated[float, Field(ge=-5.0, le=5.0)]
"""Metres on a small aircraft, from its centre; millimetres are refused."""
