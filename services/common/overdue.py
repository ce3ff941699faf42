"""Which of a service's topics are silent."""

from __future__ import annotations

from schemas.topics import TOPICS, Topic
from services.common.live_context import LiveContext


class Overdue:
    """Topics that came and then fell silent (a fault), and those not heard yet (told)."""

    def __init__(self, context: LiveContext) -> None:
        self._context = context
        self._topics = [t for t in dict.fromkeys(context.topics_in) if t.timeout_s is not None and t in TOPICS]
        self._heard_ns: dict[str, tuple[float, int]] = {}

    def update(self) -> str:
        """Note the silent topics in the health book; return the words for those never heard."""
        context, waiting = self._context, []
        now_ns = context.clock.now_ns()
        for topic in self._topics:
            last_s = context.bus.last_received_s.get(topic.name)
            if last_s is None:
                waiting.append(topic.name)
                continue
            seen_s, since_ns = self._heard_ns.get(topic.name, (None, now_ns))
            if seen_s != last_s:
                self._heard_ns[topic.name] = (last_s, since_ns := now_ns)
            silent_s = (now_ns - since_ns) * 1e-9
            late = topic.timeout_s is not None and silent_s > topic.timeout_s
            context.health.note(f"silence.{topic.name}", self._words(topic, silent_s) if late else "")
        return f"waiting for {', '.join(waiting)}" if waiting else ""

    @staticmethod
    def _words(topic: Topic, silent_s: float) -> str:
        return f"nothing for {silent_s:.0f} s: is the {topic.producer} service alive?"
