"""Questions on threads of their own: whatever becomes of them, the work loop hears of it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

import pytest
import zenoh

from schemas.mapping import Submap, SubmapsWanted
from schemas.topics import MAP_CLOUD
from services.common.asking import Asking
from services.common.inbox import Inbox

if TYPE_CHECKING:
    from services.common.bus import Bus

WANTED = SubmapsWanted(map_id="m1", submap_ids=(1,))


class FailingBus:
    """A bus on which asking fails."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def ask(self, *_: Any) -> list[Submap]:
        raise self.error


def asked(error: Exception) -> tuple[Inbox, list[list[Submap]]]:
    inbox, answers = Inbox(), list[list[Submap]]()
    asking = Asking(cast("Bus", FailingBus(error)), inbox)
    asking.ask(MAP_CLOUD, WANTED, Submap, 1.0, answers.append)
    return inbox, answers


def handle(inbox: Inbox) -> None:
    end_s = time.monotonic() + 5.0
    while (taken := inbox.take()) is None:
        assert time.monotonic() < end_s, "nothing came of the question"
        inbox.wait(0.1)
    box, call = taken
    box.handler(call)


def test_a_bus_that_is_away_is_no_answer() -> None:
    inbox, answers = asked(zenoh.ZError("the session is closed"))
    handle(inbox)
    assert answers == [[]]


def test_a_bug_in_asking_ends_the_work_loop_and_is_not_lost() -> None:
    inbox, answers = asked(ValueError("a bug"))
    with pytest.raises(ValueError, match="a bug"):
        handle(inbox)
    assert answers == []
