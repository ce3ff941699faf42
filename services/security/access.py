"""The router's access control, generated from the topics table: what is not in the table is denied.

Zenoh judges each message at the router by the certificate's common name, the kind of message, its direction and its
key. ``ingress`` is what the node sends to the router, ``egress`` what the router passes on to the node.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from schemas.topics import ANY, LIVE, PREFIX, TOPICS, Delivery, Reach, Topic
from services.security.identity import READER, RECORDER, STATION, Identity

Rule = dict[str, object]


@dataclass(frozen=True, slots=True)
class Rights:
    """Keys of one identity, by what it may do with them."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    ask: tuple[str, ...]
    answer: tuple[str, ...]
    live: tuple[str, ...]
    """Liveliness tokens that it may show."""
    watch: tuple[str, ...]
    """Liveliness tokens that it may see."""
    wanted: tuple[str, ...]
    """Of what it publishes: keys in which others may say that they want it, as wide as they may write them."""
    questions: tuple[str, ...]
    """Of what it answers: keys in which others may ask, as wide as they may write them."""


def may_publish(role: str, topic: Topic) -> bool:
    """Whether the table names ``role`` as the speaker."""
    return topic.delivery is not Delivery.QUERY and topic.producer in {role, ANY} and role != READER


def may_subscribe(role: str, topic: Topic) -> bool:
    """Whether the table lets ``role`` listen: consumers, and for what they are there for recorder, station and tools."""
    if topic.delivery is Delivery.QUERY:
        return False
    if role == STATION:
        return topic.reach is Reach.RADIO
    if role == RECORDER:
        return topic.recorded
    return role == READER or role in topic.consumers or ANY in topic.consumers


def rights_of(identity: Identity, topics: Sequence[Topic] = TOPICS) -> Rights:
    """Return what the table grants."""
    role, uav = identity.role, identity.uav
    spoken = [t for t in topics if may_publish(role, t)]
    heard = [t for t in topics if may_subscribe(role, t)]
    orders = [t for t in topics if t.delivery is Delivery.QUERY]
    return Rights(
        publish=tuple(_own_key(t, uav, role) for t in spoken),
        subscribe=tuple(t.key(uav) for t in heard),
        ask=tuple(t.key(uav) for t in orders if t.producer in {role, ANY})
        + tuple(t.key(uav) for t in heard if _kept(t)),
        answer=tuple(t.key(uav) for t in orders if role in t.consumers) + tuple(t.key(uav) for t in spoken if _kept(t)),
        live=(f"{PREFIX}/{uav}/{LIVE.removesuffix('*')}{role}",) if role not in {READER} else (),
        watch=(f"{PREFIX}/{uav}/{LIVE}",),
        wanted=tuple(t.key("*") for t in spoken),
        questions=tuple(t.key("*") for t in (*(t for t in orders if role in t.consumers), *filter(_kept, spoken))),
    )


def _own_key(topic: Topic, uav: str, role: str) -> str:
    """Return the key; of a topic with one leaf per service only the own leaf."""
    return topic.key(uav, role if topic.producer == ANY else None)


def _kept(topic: Topic) -> bool:
    """Whether the producer also answers queries for what it has sent (state, cache of the advanced publisher)."""
    return topic.rate_hz == 0


def access_control(names: Mapping[str, Identity], topics: Sequence[Topic] = TOPICS) -> dict[str, object]:
    """Return Zenoh's ``access_control`` section.

    Args:
        names: certificate common name to identity; only those that are not revoked.
        topics: the table.
    """
    rules: list[Rule] = []
    policies: list[Rule] = []
    subjects: list[Rule] = []
    for name, identity in sorted(names.items()):
        own = _rules(name, rights_of(identity, topics))
        rules += own
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        # Zenoh wants at least one of each once access control is on; a rule nobody is bound to grants nothing
        "rules": rules or [_rule("nobody", "nothing", ("put",), ("ingress",), (f"{PREFIX}/-",))],
        "subjects": subjects or [{"id": "nobody", "cert_common_names": ["-"]}],
        "policies": policies or [{"rules": ["nobody:nothing"], "subjects": ["nobody"]}],
    }


def _rules(name: str, rights: Rights) -> list[Rule]:
    adv = _advanced
    table: tuple[tuple[str, tuple[str, ...], tuple[str, ...], tuple[str, ...]], ...] = (
        ("speak", ("put",), ("ingress",), (*rights.publish, *adv(rights.publish))),
        # a station subscribes for all aircraft, the doctor to all health: a publisher that is not told of them sends nothing
        ("heard-by", ("declare_subscriber",), ("egress",), (*rights.wanted, *adv(rights.wanted))),
        ("hear", ("put",), ("egress",), (*rights.subscribe, *adv(rights.subscribe))),
        ("listen", ("declare_subscriber",), ("ingress",), (*rights.subscribe, *adv(rights.subscribe))),
        ("ask", ("query",), ("ingress",), (*rights.ask, *adv(rights.ask))),
        ("answered", ("reply", "declare_queryable"), ("egress",), (*rights.ask, *adv(rights.ask))),
        ("answer", ("reply", "declare_queryable"), ("ingress",), (*rights.answer, *adv(rights.answer))),
        ("asked", ("query",), ("egress",), (*rights.questions, *adv(rights.questions))),
        ("live", ("liveliness_token",), ("ingress",), (*rights.live, *adv(rights.publish))),
        ("see", ("liveliness_token",), ("egress",), (*rights.watch, *adv(rights.subscribe))),
        (
            "watch",
            ("liveliness_query", "declare_liveliness_subscriber"),
            ("ingress",),
            (*rights.watch, *adv(rights.subscribe)),
        ),
    )
    return [_rule(name, what, messages, flows, keys) for what, messages, flows, keys in table if keys]


def _rule(name: str, what: str, messages: Sequence[str], flows: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": f"{name}:{what}",
        "permission": "allow",
        "messages": list(messages),
        "flows": list(flows),
        "key_exprs": sorted(set(keys)),
    }


def _advanced(keys: Iterable[str]) -> tuple[str, ...]:
    """Return the keys on which advanced publishers and subscribers of ``keys`` find each other and recover misses."""
    return tuple(f"{key}/@adv/**" for key in keys)


def radio_rules(interfaces: Sequence[str], topics: Sequence[Topic] = TOPICS) -> dict[str, object]:
    """Return Zenoh's sections that hold back what passes the radio: size limit and thinning.

    Of what stays aboard nothing passes. No station has a right to it, but tools and recorders of the aircraft have, and
    they may listen from the ground.
    """
    if not interfaces:
        return {}
    thinned = [{"key_expr": t.key("*"), "freq": t.radio_hz} for t in topics if t.radio_hz > 0]
    sizes: dict[int, list[str]] = {}
    for topic in topics:
        sizes.setdefault(topic.max_bytes if topic.reach is Reach.RADIO else 0, []).append(topic.key("*"))
    at = {"interfaces": list(interfaces), "flows": ["egress"]}
    return {
        "downsampling": [{"id": "radio", **at, "messages": ["put"], "rules": thinned}],
        "low_pass_filter": [
            {"id": f"radio-{size}", **at, "messages": ["put", "reply"], "key_exprs": keys, "size_limit": size}
            for size, keys in sorted(sizes.items())
        ],
    }
