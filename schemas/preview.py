"""The picture for the ground: a small JPEG with the overlay drawn in, as it is: any viewer shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from schemas.envelope import DecodeError

_BEGIN, _END = b"\xff\xd8\xff", b"\xff\xd9"


@dataclass(frozen=True)
class PreviewImage:
    """One JPEG file of at most 60 KB; the bytes on the wire are the file's."""

    SCHEMA: ClassVar[str] = "treedock.preview"
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 60_000

    jpeg: bytes = field(repr=False)

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        return "image/jpeg"

    def to_bytes(self) -> bytearray:
        """Return the JPEG."""
        return bytearray(self.jpeg)

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> PreviewImage:
        """Take a JPEG file.

        Raises:
            DecodeError: too big, or no whole JPEG.
        """
        jpeg = bytes(data)
        if len(jpeg) > cls.MAX_BYTES:
            raise DecodeError(f"preview of {len(jpeg)} bytes, at most {cls.MAX_BYTES} are accepted")
        if not (jpeg.startswith(_BEGIN) and jpeg.endswith(_END)):
            raise DecodeError(f"preview of {len(jpeg)} bytes is no whole JPEG")
        return cls(jpeg)
