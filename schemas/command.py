"""Commands to the aircraft: query and reply, fresh by a nonce that the aircraft issued."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Text, TreeId
from schemas.orders import CommandName

Nonce = Annotated[bytes, Field(min_length=16, max_length=16)]


class NonceRequest(Message):
    """Ask for a nonce; the reply is a NonceReply."""

    SCHEMA: ClassVar[str] = "treedock.nonce_request"

    sender: Name


class NonceReply(Message):
    """A nonce that is good for commands of this sender until ``valid_s`` have passed on the aircraft."""

    SCHEMA: ClassVar[str] = "treedock.nonce_reply"

    nonce: Nonce
    valid_s: Annotated[float, Field(gt=0.0)]
    next_sequence: Counter


class Command(Message):
    """One order. Carried out at most once: the sequence must exceed every earlier one of this nonce."""

    SCHEMA: ClassVar[str] = "treedock.command"

    name: CommandName
    sender: Name
    nonce: Nonce
    sequence: Counter
    tree_id: TreeId | None = None
    """For ``choose`` only."""


class CommandReply(Message):
    """Accepted, or why not."""

    SCHEMA: ClassVar[str] = "treedock.command_reply"

    accepted: bool
    reason: Text
    state: Name
    """The mission's state after the command."""
