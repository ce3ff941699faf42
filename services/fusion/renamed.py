"""A context in which a service that knows one camera works for the second: other keys, another part of the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeVar

from schemas.codec import Wire
from schemas.topics import Topic
from services.common.clock import Clock
from services.common.context import Context, HealthBook
from services.common.errors import InputError

if TYPE_CHECKING:
    from services.common.config import TreedockConfig

M = TypeVar("M", bound=Wire)
Q = TypeVar("Q", bound=Wire)
A = TypeVar("A", bound=Wire)


def require_second(config: TreedockConfig) -> None:
    """Check that there is a second camera.

    Raises:
        InputError: the configuration knows of none.
    """
    if not (config.fusion.enabled and config.fusion.second.enabled):
        raise InputError("there is no second camera: set fusion.enabled=true and fusion.second.enabled=true")


class RenamedContext:
    """Passes everything on; a topic in ``names`` is another one, and none at all where it maps to None."""

    def __init__(self, context: Context, config: TreedockConfig, names: Mapping[Topic, Topic | None]) -> None:
        self._context, self._names = context, names
        self.uav, self.service, self.config = context.uav, context.service, config
        self.health: HealthBook = context.health

    @property
    def lockstep(self) -> bool:
        """As of the context behind."""
        return self._context.lockstep

    @property
    def clock(self) -> Clock:
        """As of the context behind."""
        return self._context.clock

    def on(
        self, topic: Topic, handler: Callable[[M], None], leaf: str | None = None, *, ring: int | None = None
    ) -> None:
        """Listen under the other name."""
        if (other := self._names.get(topic, topic)) is not None:
            self._context.on(other, handler, leaf, ring=ring)

    def every(self, period_s: float, handler: Callable[[], None]) -> None:
        """As of the context behind."""
        self._context.every(period_s, handler)

    def every_wall(self, period_s: float, handler: Callable[[], None]) -> None:
        """As of the context behind."""
        self._context.every_wall(period_s, handler)

    def on_stop(self, handler: Callable[[], None]) -> None:
        """As of the context behind."""
        self._context.on_stop(handler)

    def publish(self, topic: Topic, message: Wire, leaf: str | None = None) -> None:
        """Speak under the other name."""
        if (other := self._names.get(topic, topic)) is not None:
            self._context.publish(other, message, leaf)

    def listened(self, topic: Topic, leaf: str | None = None) -> bool:
        """Whether anybody listens under the other name."""
        other = self._names.get(topic, topic)
        return other is not None and self._context.listened(other, leaf)

    def alive(self, service: str) -> bool:
        """As of the context behind."""
        return self._context.alive(service)

    def answer(self, topic: Topic, kind: type[Q], handler: Callable[[Q], Wire | None], leaf: str | None = None) -> None:
        """Answer under the other name."""
        if (other := self._names.get(topic, topic)) is not None:
            self._context.answer(other, kind, handler, leaf)

    def answer_state(
        self, topic: Topic, handler: Callable[[], list[Wire]], kind: type[Q] | None = None,
        chosen: Callable[[Q], list[Wire]] | None = None,
    ) -> None:  # fmt: skip
        """Answer under the other name."""
        if (other := self._names.get(topic, topic)) is not None:
            self._context.answer_state(other, handler, kind, chosen)

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None
    ) -> list[A]:
        """Ask under the other name."""
        other = self._names.get(topic, topic)
        return [] if other is None else self._context.ask(other, request, kind, timeout_s, leaf)

    def ask_later(
        self, topic: Topic, request: Wire, kind: type[A], timeout_s: float, then: Callable[[list[A]], None]
    ) -> None:
        """Ask under the other name; nobody answers where there is none."""
        other = self._names.get(topic, topic)
        if other is None:
            then([])
        else:
            self._context.ask_later(other, request, kind, timeout_s, then)

    def steady_ns(self) -> int:
        """As of the context behind."""
        return self._context.steady_ns()
