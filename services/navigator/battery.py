"""What is left in the battery, and whether anybody knows: an unknown battery is no full one. Pure."""

from __future__ import annotations

from services.navigator.board import Board


def unknown_word(b: Board) -> str:
    """Say for how long nobody has told the battery's share, where it was known in this flight; else nothing.

    A vehicle that never tells it (it has no gauge) flies by its pilot's watch.
    """
    v = b.vehicle
    if v is None or v.battery_share is not None or b.battery_known_ns is None:
        return ""
    silent_s = (b.now_ns - b.battery_known_ns) / 1e9
    return f"battery: no word for {silent_s:.0f} s" if silent_s > b.config.failsafe.battery_silent_s else ""


def too_low_for_another(b: Board) -> str:
    """Say why no further tree is begun; nothing while the battery allows one."""
    share = None if b.vehicle is None else b.vehicle.battery_share
    if share is None:
        word = unknown_word(b)
        return f"{word}: no further tree" if word else ""
    low = share < b.config.failsafe.battery_next_share
    return f"battery at {100.0 * share:.0f} %: no further tree" if low else ""


def fell_silent(b: Board) -> str:
    """Return the word once, when the battery falls silent."""
    word = unknown_word(b)
    begins = bool(word) and not b.battery_silence_told
    b.battery_silence_told = bool(word)
    return word if begins else ""
