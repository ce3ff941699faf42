"""The recordings of a folder: when, how long, how big, what is in them, whether they are whole."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from services.common.errors import InputError
from services.recorder.recover import is_whole


@dataclass(frozen=True, slots=True)
class Run:
    """One file."""

    path: Path
    bytes: int
    whole: bool
    """With its end and index; otherwise only its size is known until it is mended."""
    begun_ns: int = 0
    seconds: float = 0.0
    counts: tuple[tuple[str, int], ...] = ()
    """Messages per key, sorted by key."""
    about: tuple[tuple[str, str], ...] = ()

    def count(self, name: str) -> int:
        """Return the messages of a topic, by its name below the aircraft's prefix."""
        return sum(number for key, number in self.counts if key.endswith(f"/{name}"))


def index(folder: Path) -> list[Run]:
    """Return the folder's recordings, oldest first.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of recordings")
    return sorted((summary(path) for path in folder.glob("*.mcap")), key=lambda run: (run.begun_ns, run.path.name))


def summary(path: Path) -> Run:
    """Return what a file's own summary tells.

    Raises:
        InputError: it cannot be read.
    """
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    size = path.stat().st_size
    if not is_whole(path):
        return Run(path, size, whole=False)
    with path.open("rb") as stream:
        try:
            reader = make_reader(stream)
            found = reader.get_summary()
            about = next((m.metadata for m in reader.iter_metadata() if m.name == "treedock"), {})
        except (McapError, struct.error, ValueError) as error:
            raise InputError(f"{path}: damaged: {str(error)[:120]}") from error
    if found is None or found.statistics is None:
        return Run(path, size, whole=True, about=tuple(sorted(about.items())))
    statistics = found.statistics
    counts = {c.topic: statistics.channel_message_counts.get(c.id, 0) for c in found.channels.values()}
    seconds = 1e-9 * (statistics.message_end_time - statistics.message_start_time)
    return Run(
        path, size, whole=True, begun_ns=statistics.message_start_time, seconds=seconds,
        counts=tuple(sorted(counts.items())), about=tuple(sorted(about.items())),
    )  # fmt: skip
