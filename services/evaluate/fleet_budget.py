"""What a fleet sends over radio and trunk lines, by the topics table: the arithmetic of docs/fleet.md.

``python -m services.evaluate.fleet_budget`` writes the tables into the page; a test fails when they differ.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

from schemas.topics import TOPICS, Delivery, Reach, Topic

PAGE = Path(__file__).parents[2] / "docs" / "fleet.md"
BEGIN, END = "<!-- budget: generated -->", "<!-- /budget -->"

OVERHEAD_B = 90
"""Of one message on the wire: Zenoh's header and key (about 30), TLS record (30), TCP/IP (40), two messages to a packet."""
SERVICES = 11
"""That tell their health aboard."""
WHILE_LOOKED_AT = frozenset({"preview/image", "map/sketch"})
"""Sent only while a page shows that aircraft."""


@dataclass(frozen=True, slots=True)
class Usual:
    """A usual message's bytes, and its rate where the table has none."""

    size_b: int
    rate_hz: float | None = None
    why: str = ""


USUAL: dict[str, Usual] = {
    "slam/pose": Usual(591),
    "fusion/state": Usual(300),
    "trees/list": Usual(24_900, 0.2, "100 trees, when one changed: every 5 s over a mission"),
    "trees/target": Usual(398),
    "mission/state": Usual(230),
    "vehicle/state": Usual(255),
    "fleet/held": Usual(241),
    "fleet/claim": Usual(296, 1.0 / 3.0, "a renewal and its answer every 3 s"),
    "cmd/*": Usual(300, 0.01, "orders are rare"),
    "nonce": Usual(150, 0.01, "before each order"),
    "clock": Usual(0, 0.0, "answered by the aircraft's own router, not over the radio"),
    "health/*": Usual(228),
    "preview/image": Usual(15_000),
    "map/sketch": Usual(30_000, 0.2, "while one looks at the 3D view"),
}
"""Bytes of messages as ``treedock bench fleet-capacity`` sends them and of the golden ones."""


def rate_hz(topic: Topic) -> float:
    """Return how often a topic crosses the radio: as the router thins it, as the table has it, or as is usual."""
    usual = USUAL[topic.name].rate_hz
    rate = usual if usual is not None else topic.radio_hz or topic.rate_hz
    return rate * (SERVICES if topic.name == "health/*" else 1)


def bytes_per_s(topic: Topic) -> float:
    """Return what one aircraft sends of a topic."""
    return rate_hz(topic) * (USUAL[topic.name].size_b + OVERHEAD_B)


def steady() -> list[Topic]:
    """Return the topics that cross the radio all the time."""
    return [t for t in TOPICS if t.reach is Reach.RADIO and t.name not in WHILE_LOOKED_AT]


def messages_per_s() -> float:
    """Return the messages of one aircraft."""
    return sum(rate_hz(t) for t in steady())


_THINNED_HZ = {"slam/pose": 1.0, "trees/target": 0.0, "mission/state": 1.0, "vehicle/state": 0.5, "fusion/state": 0.0, "health/*": 0.1 * SERVICES,
               "fleet/claim": 0.0, "fleet/held": 0.1, "trees/list": 1.0 / 60.0}  # fmt: skip
"""Behind a regional router: what a headquarters needs of an aircraft that its own station looks after."""


def thinned_bytes_per_s() -> float:
    """Return what of one aircraft a regional router passes on."""
    return sum(_THINNED_HZ.get(t.name, rate_hz(t)) * (USUAL[t.name].size_b + OVERHEAD_B) for t in steady())


def thinned_messages_per_s() -> float:
    """Return how many messages that is."""
    return sum(_THINNED_HZ.get(t.name, rate_hz(t)) for t in steady())


CELL, REGION = 25, 500
"""Aircraft of one radio cell, with a router and a station with the arbiter; of one region, with a router of its own."""
_RECORDED_MB_H = 9_000.0
_INVENTORY_B = 600
_TREES_H = 12
"""Trees that an aircraft visits in an hour: five minutes each with the way and the battery's change."""


def rendered() -> str:
    """Return the tables."""
    lines = ["| topic | rate over the radio | bytes each, with overhead | bytes/s | |", "|---|---|---|---|---|"]
    for topic in [t for t in TOPICS if t.reach is Reach.RADIO]:
        usual = USUAL[topic.name]
        looked = "only while a page looks" if topic.name in WHILE_LOOKED_AT else ""
        note = "; ".join(word for word in (looked, usual.why) if word and word != "while one looks at the 3D view")
        kind = " (question and answer)" if topic.delivery is Delivery.QUERY else ""
        lines.append(
            f"| `{topic.name}`{kind} | {rate_hz(topic):.3g} Hz | {usual.size_b + OVERHEAD_B:,} | {bytes_per_s(topic):,.0f} | {note} |"
        )
    one = sum(bytes_per_s(t) for t in steady())
    lines += ["", f"One aircraft: **{messages_per_s():.1f} messages/s, {one / 1e3:.1f} kB/s ({8 * one / 1e3:.0f} kbit/s)** without a picture; "
              f"each picture that is looked at adds {bytes_per_s(_named('preview/image')) / 1e3:.0f} kB/s."]  # fmt: skip
    lines += ["", *_scales(one)]
    return "\n".join(lines)


def _scales(one_b: float) -> list[str]:
    lines = [
        "| aircraft | radio cells of 25 | into each cell's router | regions of 500 | into each region, thinned | to headquarters, thinned | inventory, an hour | recorded aboard, an hour |",
        "|---|---|---|---|---|---|---|---|",
    ]
    thin_b, thin_n = thinned_bytes_per_s(), thinned_messages_per_s()
    for n in (1, 25, 100, 10_000):
        cells, regions = math.ceil(n / CELL), math.ceil(n / REGION)
        here, there = min(n, CELL), min(n, REGION)
        lines.append(
            f"| {n:,} | {cells:,} | {here * messages_per_s():,.0f}/s, {8 * here * one_b / 1e6:.1f} Mbit/s | {regions} "
            f"| {there * thin_n:,.0f}/s, {8 * there * thin_b / 1e6:.2f} Mbit/s | {n * thin_n:,.0f}/s, {8 * n * thin_b / 1e6:.1f} Mbit/s "
            f"| {n * _TREES_H:,} trees, {n * _TREES_H * _INVENTORY_B / 1e6:.2f} MB | {n * _RECORDED_MB_H / 1e6:,.2f} TB |"
        )
    return lines


def _named(name: str) -> Topic:
    return next(t for t in TOPICS if t.name == name)


def spliced(page: str, text: str) -> str:
    """Return the page with the generated part replaced."""
    head, _, rest = page.partition(BEGIN)
    return f"{head}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    PAGE.write_text(spliced(PAGE.read_text(encoding="utf-8"), rendered()), encoding="utf-8")
    sys.stderr.write(f"wrote {PAGE}\n")
