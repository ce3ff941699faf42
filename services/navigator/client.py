"""How anybody commands the aircraft: ask it for a nonce, then send the command with it."""

from __future__ import annotations

from typing import Protocol, TypeVar

from schemas.codec import Wire
from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.orders import STOPS, CommandName
from schemas.topics import COMMAND, COMMAND_NONCE, Topic

A = TypeVar("A", bound=Wire)


class Asker(Protocol):
    """A bus or a service's context: what can query a key."""

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None
    ) -> list[A]:
        """Query a key and return the decoded replies; empty when nobody answered in time."""
        ...


def send_command(
    asker: Asker, name: CommandName, tree_id: int | None = None, sender: str = "operator", timeout_s: float = 2.0
) -> CommandReply | None:
    """Command the aircraft and return its reply, or None when no navigator answered within ``timeout_s``, twice.

    Each navigator takes a command with its own nonce alone. Where several answer, nothing but holding and landing is asked
    of them, and of each: else one would carry out what another one's answer calls refused.
    """
    nonces = asker.ask(COMMAND_NONCE, NonceRequest(sender=sender), NonceReply, timeout_s)
    if len(nonces) > 1 and name not in STOPS:
        reason = f"{len(nonces)} navigators of this aircraft answer: stop all but one; treedock doctor shows more"
        return CommandReply(accepted=False, reason=reason, state="unknown")
    replies: list[CommandReply] = []
    for fresh in nonces:
        command = Command(name=name, sender=sender, nonce=fresh.nonce, sequence=fresh.next_sequence, tree_id=tree_id)
        replies += asker.ask(COMMAND, command, CommandReply, timeout_s, leaf=name)
    return next((reply for reply in replies if reply.accepted), replies[0] if replies else None)
