"""Several operators, one in command of each aircraft: who may order what, and how command changes hands. Pure.

Rules: an aircraft that nobody commands is taken by the first order. HOLD is open to everybody at any time, because
whoever sees the danger must be able to stop the aircraft; every other order needs command. Command is taken over
with a held button and told to everybody; it is never lost in silence.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas.orders import CommandName

OPEN_TO_ALL: frozenset[CommandName] = frozenset({"hold"})


@dataclass(slots=True)
class Operator:
    """A person at a browser. ``number`` is public; what proves the person is the browser's secret, known to the desk."""

    number: int
    name: str
    browsers: int = 1
    """Open pages; 0: gone since ``gone_s``."""
    gone_s: float = 0.0

    @property
    def sender(self) -> str:
        """Return the name under which the aircraft hears of this operator."""
        return f"station.{self.number}"


@dataclass
class OperatorDesk:
    """Who is there and who is in command. Times are the station's monotonic seconds."""

    keep_command_s: float
    max_known: int = 256
    in_command: dict[str, int] = field(default_factory=dict)
    """Aircraft -> number of the operator."""
    _by_secret: dict[str, Operator] = field(default_factory=dict)
    _next: int = 1

    def join(self, secret: str, name: str) -> Operator:
        """Return the operator of a browser's secret, known from before or new."""
        known = self._by_secret.get(secret)
        if known is None:
            self._forget_one()
            known = self._by_secret[secret] = Operator(self._next, name, browsers=0)
            self._next += 1
        known.name = name
        known.browsers += 1
        return known

    def _forget_one(self) -> None:
        if len(self._by_secret) < self.max_known:
            return
        idle = [
            key for key, o in self._by_secret.items() if not o.browsers and o.number not in self.in_command.values()
        ]
        if idle:
            del self._by_secret[idle[0]]

    def leave(self, operator: Operator, now_s: float) -> None:
        """Take note of a closed page."""
        operator.browsers = max(0, operator.browsers - 1)
        operator.gone_s = now_s

    def present(self) -> list[Operator]:
        """Return those with an open page, by number."""
        return sorted((o for o in self._by_secret.values() if o.browsers), key=lambda o: o.number)

    def commander(self, uav: str) -> Operator | None:
        """Return who is in command of an aircraft."""
        number = self.in_command.get(uav)
        return next((o for o in self._by_secret.values() if o.number == number), None)

    def refusal(self, operator: Operator, uav: str, name: CommandName) -> str:
        """Return why an operator may not give an order, empty when he may."""
        commander = self.commander(uav)
        if commander is None or commander is operator or name in OPEN_TO_ALL:
            return ""
        return f"{commander.name} is in command of {uav}: take command first"

    def take(self, operator: Operator, uav: str) -> Operator | None:
        """Put an operator in command; return who was before."""
        before = self.commander(uav)
        self.in_command[uav] = operator.number
        return before if before is not operator else None

    def release(self, operator: Operator, uav: str) -> bool:
        """Give command back; False when the operator did not have it."""
        if self.commander(uav) is not operator:
            return False
        del self.in_command[uav]
        return True

    def hand_over(self, operator: Operator, uav: str, to_number: int) -> Operator | None:
        """Give command to another operator who is there; None when that cannot be."""
        to = next((o for o in self.present() if o.number == to_number), None)
        if to is None or to is operator or self.commander(uav) is not operator:
            return None
        self.in_command[uav] = to.number
        return to

    def expire(self, now_s: float) -> list[tuple[str, Operator]]:
        """Free the aircraft whose commander's pages have been gone for long; return them."""
        freed = []
        for uav in list(self.in_command):
            commander = self.commander(uav)
            if commander is None:
                del self.in_command[uav]
            elif not commander.browsers and now_s - commander.gone_s > self.keep_command_s:
                del self.in_command[uav]
                freed.append((uav, commander))
        return freed
