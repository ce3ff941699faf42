"""Versions of configuration files: old ones are read through every step to today's, newer ones refused by name."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from services.common.errors import InputError
from services.common.files import write_whole

LOG = logging.getLogger(__name__)

Body = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Migration:
    """One version's step to the next: a renamed, moved or retired key makes a new version."""

    retired: tuple[str, ...]
    """Dotted keys that the next version does not know any more."""
    change: Callable[[Body], Body]
    """Takes the body by value."""


def _from_0(body: Body) -> Body:
    """Drop two keys of slam: keyframes follow from what is seen, and gravity is estimated over the whole map."""
    return without(body, _RETIRED_0)


_RETIRED_0 = ("slam.accel_window_s", "slam.keyframe_interval_max")

_MOVED_1 = {"depth": "compressed_depth", "jpeg_quality": "jpeg_quality"}
_RETIRED_1 = tuple(f"recorder.{name}" for name in _MOVED_1)


def _from_1(body: Body) -> Body:
    """Give the camera how frames are compressed: it compresses them, the recorder only writes them down."""
    recorder, camera = body.get("recorder"), body.get("camera", {})
    if not isinstance(recorder, Mapping) or not isinstance(camera, Mapping):
        return body
    moved = {new: recorder[old] for old, new in _MOVED_1.items() if old in recorder}
    moved = {
        name: value for name, value in moved.items() if value != "z16"
    }  # uncompressed: the camera's frames = "raw"
    rest = {name: value for name, value in recorder.items() if name not in _MOVED_1}
    return {**body, "recorder": rest, **({"camera": {**moved, **camera}} if moved or camera else {})}


MIGRATIONS: Mapping[int, Migration] = {0: Migration(_RETIRED_0, _from_0), 1: Migration(_RETIRED_1, _from_1)}
"""By version of the file. Files of version 0 carry no number; ``treedock config --migrate`` writes old files anew."""

NEWEST = max(MIGRATIONS) + 1


def without(body: Body, keys: tuple[str, ...]) -> Body:
    """Return the body without dotted keys; what was in it is told."""
    for key in keys:
        section, _, leaf = key.rpartition(".")
        found = body.get(section)
        if isinstance(found, Mapping) and leaf in found:
            LOG.warning("%s no longer exists and is left out", key)
            body = {**body, section: {name: value for name, value in found.items() if name != leaf}}
    return body


def current(body: Body, origin: str, migrations: Mapping[int, Migration] = MIGRATIONS) -> Body:
    """Return a file's content as this version writes it, without its ``config_version``.

    Args:
        body: as read.
        origin: the file's name, for the error.
        migrations: version to the step that leads to the next one.

    Raises:
        InputError: the file is of a newer treedock, or its version is no number.
    """
    body = dict(body)
    oldest, newest = min(migrations), max(migrations) + 1
    version = body.pop("config_version", None)
    if version is None:
        version = _guessed(body, migrations)
    if not isinstance(version, int) or isinstance(version, bool) or version < oldest:
        raise InputError(f"{origin}: config_version = {version!r}: expected a number from {oldest} to {newest}")
    if version > newest:
        raise InputError(
            f"{origin}: config_version = {version} was written for a newer treedock; this one reads up to {newest}: "
            "update treedock on this machine, or take the file of its version"
        )
    for number in range(version, newest):
        body = migrations[number].change(body)
    return body


def _guessed(body: Body, migrations: Mapping[int, Migration]) -> int:
    """Return the version of a file without a number: the first whose retired keys are in it, else today's."""
    for number in sorted(migrations):
        for key in migrations[number].retired:
            section, _, leaf = key.rpartition(".")
            inside = body.get(section) if section else body
            if isinstance(inside, Mapping) and leaf in inside:
                return number
    return max(migrations) + 1


def migrate_file(path: Path) -> str:
    """Write an older TOML file anew in today's version; the old one, with its comments, is kept beside it.

    Returns a line on what was done. The new file takes the old one's place whole or not at all.

    Raises:
        InputError: it cannot be read or written, or is of a newer treedock.
    """
    from services.common.config_loader import to_toml

    if path.suffix == ".json":
        raise InputError(f"{path}: --migrate writes TOML; an old JSON file is read as it is: leave --migrate out")
    try:
        text = path.read_text(encoding="utf-8")
        body = tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    if body.get("config_version") == NEWEST:
        return f"{path}: is of version {NEWEST} already"
    fresh = to_toml({"config_version": NEWEST, **current(body, str(path))}, {})
    kept = path.with_name(f"{path.name}.old")
    like = path.stat()  # an administrator's umask and group would keep the services from reading it
    write_whole(kept, text.encode(), 0o600, like=like)
    write_whole(path, fresh.encode(), 0o600, like=like)
    return f"{path}: written anew in version {NEWEST}; {kept.name} is the old one, with its comments"
