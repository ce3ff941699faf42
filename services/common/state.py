"""What a service keeps for its next start: in which folder, and how a file that cannot be used is told and set aside."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from services.common.errors import InputError
from services.common.files import write_parts

LOG = logging.getLogger(__name__)

T = TypeVar("T")


def user_state(uav: str, environment: Mapping[str, str]) -> Path:
    """Return where an aircraft's state is kept: systemd's directory for the unit, else ``~/.local/state/treedock/<uav>``."""
    given = environment.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    return Path(environment.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "treedock" / uav


def state_folder(state_dir: str, uav: str, environment: Mapping[str, str], *, simulated: bool) -> Path | None:
    """Return the folder in which a service keeps its state, None when it keeps none.

    Args:
        state_dir: ``off``, a folder, or ``auto``: that of the unit or the user.
        uav: the aircraft's name.
        environment: of the process.
        simulated: time is simulated: maps of two runs may then bear one name, and ``auto`` means ``off``.
    """
    if state_dir == "off" or (state_dir == "auto" and simulated):
        return None
    return user_state(uav, environment) if state_dir == "auto" else Path(state_dir)


def boot_id() -> str:
    """Return what names this boot of the machine; empty where the kernel does not tell."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


class StateFile:
    """A file of a service's state: whole always, and never a reason for the service to stop. What is wrong is in its health."""

    def __init__(
        self, file: Path, name: str, what: str, count: Callable[[str], None], note: Callable[[str, str], None]
    ) -> None:
        """Keep ``what`` ("the map") in ``file``; ``name`` ("map") makes the names of its counters.

        ``count`` and ``note`` are the health book's.
        """
        self.file = file
        self._name, self._what = name, what
        self._count, self._note = count, note

    def read(self, unpack: Callable[[bytes], T]) -> T | None:
        """Return what the file holds; one that ``unpack`` refuses (ValueError) is set aside, counted and told."""
        try:
            data = self.file.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._tell(f"{self.file}: cannot be read: {error.strerror}; {self._what} begins anew")
            return None
        try:
            return unpack(data)
        except ValueError as error:
            self._count(f"bad_{self._name}_files")
            self._tell(f"{self.file}: {error}; {self._set_aside()}; {self._what} begins anew")
            return None

    def write(self, parts: Iterable[bytes], *, lasting: bool) -> str:
        """Replace the file's content; return why that failed, else an empty text. Any thread may write.

        ``lasting=False``: it survives the process, but not a power cut, and the disk is not waited for.
        """
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            write_parts(self.file, parts, lasting=lasting)
        except OSError as error:
            return f"{self.file}: cannot be written: {error.strerror}"
        except InputError as error:
            return str(error)
        return ""

    def tell_written(self, fault: str) -> None:
        """Tell what became of a writing; for the work loop."""
        if not fault:
            self._count(f"{self._name}s_saved")
            self._note(f"{self._name} file", "")
            return
        self._count(f"{self._name}_save_errors")
        self._tell(f"{fault}; {self._what} would not survive a restart")

    def _set_aside(self) -> str:
        """Rename the file, so that somebody may look at it; the last one is kept."""
        try:
            return f"it was set aside as {self.file.replace(self.file.with_name(f'{self.file.name}.bad')).name}"
        except OSError as error:
            return f"it cannot be set aside: {error.strerror}"

    def _tell(self, text: str) -> None:
        LOG.warning(text)
        self._note(f"{self._name} file", text)
