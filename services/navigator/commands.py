"""Who may command, and when: nonces that the aircraft issues, valid for a few seconds of its own time. Pure.

A command names its sender's nonce and a sequence number above every earlier one of that nonce, so that a recorded
command is worth nothing later and a repeated one is carried out at most once. Nobody's wall clock is asked. Whoever says
hold has the last word over all that was on its way by then: over a weak link an earlier resume may arrive after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from schemas.command import Command, NonceReply
from schemas.orders import STOPS

_MAX_NONCES = 64
_PER_SENDER = 4
_MOST_SKIPPED = 1000
"""Numbers that a command may leave out: who could name the last one of all would end every later command, and the navigator."""


@dataclass
class _Issued:
    sender: str
    until_ns: int
    next_sequence: int


class CommandDesk:
    """Issues nonces and judges the freshness of commands; it does not judge whether they make sense now."""

    def __init__(self, valid_s: float, make_nonce: Callable[[], bytes]) -> None:
        self.valid_s = valid_s
        self._make_nonce = make_nonce
        self._issued: dict[bytes, _Issued] = {}
        self._sequence = self._stopped_at = 0

    def issue(self, sender: str, now_ns: int) -> NonceReply:
        """Return a new nonce for ``sender``. The oldest one gives way when there are too many."""
        self._forget(now_ns)
        own = [nonce for nonce, entry in self._issued.items() if entry.sender == sender]
        for nonce in own[: max(len(own) - _PER_SENDER + 1, 0)]:
            del self._issued[nonce]
        while len(self._issued) >= _MAX_NONCES:
            del self._issued[next(iter(self._issued))]
        nonce = self._make_nonce()
        self._issued[nonce] = _Issued(sender, now_ns + round(self.valid_s * 1e9), self._sequence + 1)
        return NonceReply(nonce=nonce, valid_s=self.valid_s, next_sequence=self._sequence + 1)

    def refusal(self, command: Command, now_ns: int) -> str:
        """Return why a command must not be carried out; empty when it is fresh, and then it is spent."""
        entry = self._issued.get(command.nonce)
        if entry is None:
            return "unknown nonce: ask for one and command with it"
        if now_ns > entry.until_ns:
            return f"stale: the nonce was valid for {self.valid_s:g} s"
        if command.sender != entry.sender:
            return f"the nonce was given to another sender, not to {command.sender}"
        if command.sequence < entry.next_sequence:
            return f"replayed: sequence {command.sequence}, expected {entry.next_sequence} or more"
        if command.sequence > entry.next_sequence + _MOST_SKIPPED:
            return f"sequence {command.sequence} is more than {_MOST_SKIPPED} above {entry.next_sequence}, the expected one"
        if command.name not in STOPS and command.sequence <= self._stopped_at:
            return f"overtaken: {command.name} was on its way when a hold, land or abort was carried out; say it again"
        entry.next_sequence = command.sequence + 1
        self._sequence = max(self._sequence, command.sequence)
        if command.name in STOPS:
            self._stopped_at = max(self._stopped_at, command.sequence)
        return ""

    def _forget(self, now_ns: int) -> None:
        gone = [n for n, entry in self._issued.items() if now_ns > entry.until_ns + 60_000_000_000]
        for nonce in gone:
            del self._issued[nonce]
