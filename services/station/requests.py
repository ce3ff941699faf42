"""What a browser may say, checked before anything is done with it. Pure."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from schemas.envelope import DecodeError
from schemas.orders import CommandName

MAX_BYTES = 4096
Uav = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+$")]
Serial = Annotated[int, Field(ge=0, lt=2**53)]


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Hello(_Request):
    """The first thing a browser says."""

    t: Literal["hello"]
    secret: Annotated[str, Field(min_length=16, max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]
    """Drawn by the browser once and kept there: it proves on a reconnect who was in command."""
    name: Annotated[str, Field(min_length=1, max_length=32, pattern=r"^[^\x00-\x1f\x7f\u2028-\u202f]+$")]


class Order(_Request):
    """A command to an aircraft."""

    t: Literal["order"]
    id: Serial
    """Rising within a connection: an old one repeated is refused."""
    uav: Uav
    name: CommandName
    tree_id: Annotated[int, Field(ge=0, lt=2**53)] | None = None
    seen: Serial
    """Number of the state that the page showed when the operator pressed."""


class Take(_Request):
    """Take command of an aircraft."""

    t: Literal["take"]
    id: Serial
    uav: Uav


class Release(_Request):
    """Give command back."""

    t: Literal["release"]
    id: Serial
    uav: Uav


class HandOver(_Request):
    """Give command to another operator."""

    t: Literal["hand_over"]
    id: Serial
    uav: Uav
    to: Serial


class Cloud(_Request):
    """Begin or end to send the point cloud of one aircraft to this browser."""

    t: Literal["cloud"]
    id: Serial
    uav: Uav
    on: bool


Request = Hello | Order | Take | Release | HandOver | Cloud
_ADAPTER: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="t")])


def parse(text: str) -> Request:
    """Return the request in a text frame.

    Raises:
        DecodeError: anything else.
    """
    if len(text) > MAX_BYTES:
        raise DecodeError(f"request of {len(text)} characters, at most {MAX_BYTES} are accepted")
    try:
        body: Any = json.loads(text)
        return _ADAPTER.validate_python(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DecodeError(f"{where}: {first['msg']}"[:200]) from None
    except (ValueError, RecursionError) as error:
        raise DecodeError(f"not JSON: {str(error)[:100]}") from None
