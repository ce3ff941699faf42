"""``treedock topic list | echo | hz``: what travels on the bus, in words."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
    import zenoh

    from schemas.topics import Topic
    from services.common.bus import Bus
    from services.common.config import TreedockConfig
    from services.common.stop import StopSignal

topic_app = typer.Typer(help="See the traffic: list, echo, hz.", no_args_is_help=True)

_RATE_WINDOW_S = 1.0
TopicName = Annotated[str, typer.Argument(help="For example slam/pose; see `treedock topic list`.", show_default=False)]


def _topic(name: str) -> Topic:
    from schemas.topics import find
    from services.common.errors import InputError

    try:
        return find(name)
    except KeyError as error:
        raise InputError(str(error.args[0])) from None


def _tree(config: Path | None, settings: list[str] | None, port: int | None) -> TreedockConfig:
    from services.common.logging import set_up

    set_up("topic", "warning")
    return loaded(config, settings, port).config


@contextmanager
def _joined(tree: TreedockConfig) -> Iterator[tuple[Bus, StopSignal]]:
    """Join the bus; the stop comes with Ctrl-C."""
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_node
    from services.common.stop import StopSignal

    stop = StopSignal()
    stop.install()
    with opened_node(tree, None, lambda: stop.is_set, wait_s=0.0) as session:
        bus = Bus(session, tree.uav, HealthBook())
        stop.when_set(bus.inbox.wake)
        yield bus, stop


@topic_app.command("list")
def list_topics(
    *, as_json: AsJson = False, config: ConfigFile = None, settings: Settings = None, port: Port = None
) -> None:
    """Print the topics table; with a router running also who is live."""
    import json

    from schemas.topics import TOPICS
    from services.common.errors import InputError

    tree = _tree(config, settings, port)
    try:
        with _joined(tree) as (bus, _):
            live = bus.live_services()
        about = f"live on {tree.router.endpoint}: {', '.join(live) or 'no service'}"
    except InputError as error:
        live, about = [], str(error)
    if as_json:
        rows = [{"name": t.name, "producer": t.producer, "consumers": t.consumers, "rate_hz": t.rate_hz,
                 "timeout_s": t.timeout_s, "reach": t.reach.value, "delivery": t.delivery.value, "encoding": t.encoding,
                 "live": t.producer in live, "description": t.description} for t in TOPICS]  # fmt: skip
        typer.echo(json.dumps({"topics": rows, "live": live}))
        return
    _print_table(TOPICS, live)
    typer.echo(about, err=True)


def _print_table(topics: tuple[Topic, ...], live: list[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(header_style="bold", box=None, pad_edge=False)
    for column in ("topic", "from", "Hz", "reach"):
        table.add_column(column, justify="right" if column == "Hz" else "left", no_wrap=True)
    table.add_column("to")  # the one that may take several lines
    for topic in topics:
        producer = f"[green]{topic.producer}[/]" if topic.producer in live else topic.producer
        rate = f"{topic.rate_hz:g}" if topic.rate_hz else "-"
        table.add_row(topic.name, producer, rate, topic.reach.value, ", ".join(topic.consumers))
    Console().print(table)


@topic_app.command()
def echo(
    name: TopicName,
    *,
    count: Annotated[int, typer.Option("--count", "-n", help="Stop after so many; 0: never.", min=0)] = 0,
    whole: Annotated[bool, typer.Option("--whole", help="Long lists in full.")] = False,
    with_key: Annotated[bool, typer.Option("--key", help="The key before each line.")] = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> None:
    """Print each sample of a topic as a line of JSON; big byte strings are summarised."""
    from services.cli.readable import text

    topic = _topic(name)
    with _joined(_tree(config, settings, port)) as (bus, stop):
        shown = 0
        for sample in _samples(bus, topic, name, stop):
            if sample is None:
                continue
            key = str(sample.key_expr)
            typer.echo(f"{key} " * with_key + text(key, sample.payload.to_bytes(), whole=whole))
            shown += 1
            if shown == count:
                return


@topic_app.command()
def hz(
    name: TopicName,
    *,
    duration_s: Annotated[float, typer.Option("--for", help="Seconds; 0: until Ctrl-C.", min=0.0)] = 0.0,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> None:
    """Measure a topic: rate, spread of the intervals, bytes per second, once a second."""
    topic = _topic(name)
    with _joined(_tree(config, settings, port)) as (bus, stop):
        begin_s = window_s = time.monotonic()
        arrivals: list[tuple[float, int]] = []
        for sample in _samples(bus, topic, name, stop):
            now_s = time.monotonic()
            if sample is not None:
                arrivals.append((now_s, len(sample.payload)))
            if now_s - window_s >= _RATE_WINDOW_S:
                typer.echo(rate_line(name, arrivals, now_s - window_s))
                window_s, arrivals = now_s, []
            if duration_s and now_s - begin_s >= duration_s:
                return


def rate_line(name: str, arrivals: list[tuple[float, int]], elapsed_s: float) -> str:
    """Return the line about one window; ``arrivals`` are (monotonic seconds, bytes)."""
    if not arrivals:
        return f"{name}: nothing"
    rate_hz = len(arrivals) / elapsed_s
    kilobytes_s = sum(size for _, size in arrivals) / elapsed_s / 1e3
    gaps_ms = [(b[0] - a[0]) * 1e3 for a, b in itertools.pairwise(arrivals)]
    spread = f", gaps {min(gaps_ms):.1f} to {max(gaps_ms):.1f} ms" if gaps_ms else ""
    return f"{name}: {rate_hz:.2f} Hz{spread}, {kilobytes_s:.1f} kB/s"


def _samples(bus: Bus, topic: Topic, name: str, stop: StopSignal) -> Iterator[zenoh.Sample | None]:
    """Yield raw samples as they come, and None each quarter of a second without one, until the stop."""
    import zenoh

    box = bus.inbox.mailbox(lambda _: None, 256)
    leaf = None if name == topic.name else name.rsplit("/", 1)[-1]
    callback: zenoh.handlers.Callback[zenoh.Sample]
    callback = zenoh.handlers.Callback(lambda sample: bus.inbox.put(box, sample), indirect=False)
    subscriber = bus.session.declare_subscriber(topic.key(bus.uav, leaf), callback)
    while not stop.is_set:
        bus.inbox.wait(0.25)
        taken = bus.inbox.take()
        yield taken[1] if taken else None
    subscriber.undeclare()
