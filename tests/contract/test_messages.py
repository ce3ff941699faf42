"""Messages keep their bytes, and whatever else arrives gives one typed error."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.camera import RgbdFrame, depth_after
from schemas.codec import Wire, decode, encode
from schemas.envelope import DecodeError, Message
from schemas.mapping import Submap
from schemas.slam import Pose
from schemas.topics import TOPICS
from tests.examples import all_messages, frame, submap

GOLDEN = Path(__file__).parents[1] / "golden" / "messages"
EXAMPLES = all_messages()
names = st.sampled_from(sorted(EXAMPLES))


def golden_path(example: Wire) -> Path:
    return GOLDEN / f"{example.SCHEMA}@{example.VERSION}.bin"  # type: ignore[attr-defined]


def same(a: Any, b: Any) -> bool:
    """Compare binary messages field by field: arrays have no truth value, buffers no equality."""
    if isinstance(a, Message):
        return bool(a == b)
    return bytes(a.to_bytes()) == bytes(b.to_bytes())


def test_every_topic_has_an_example_and_golden_bytes() -> None:
    for topic in TOPICS:
        assert topic.message.SCHEMA in EXAMPLES  # type: ignore[attr-defined]
    for example in EXAMPLES.values():
        assert golden_path(example).is_file(), f"{golden_path(example).name} is missing: python -m tests.golden.write"


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_golden_bytes_are_kept(name: str) -> None:
    example = EXAMPLES[name]
    golden = golden_path(example).read_bytes()
    assert bytes(encode(example)) == golden, "the bytes changed: raise VERSION, keep the old golden file"
    assert same(decode(type(example), golden), example)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_truncation_is_refused(name: str) -> None:
    data = bytes(encode(EXAMPLES[name]))
    for length in range(len(data)):
        with pytest.raises(DecodeError):
            decode(type(EXAMPLES[name]), data[:length])


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_trailing_bytes_and_oversize_are_refused(name: str) -> None:
    kind = type(EXAMPLES[name])
    data = bytes(encode(EXAMPLES[name]))
    with pytest.raises(DecodeError):
        decode(kind, data + b"\x00")
    with pytest.raises(DecodeError, match="bytes"):
        decode(kind, bytes(kind.MAX_BYTES + 1))  # type: ignore[attr-defined]


@given(names, st.binary(max_size=400))
def test_random_bytes_give_one_typed_error(name: str, data: bytes) -> None:
    with pytest.raises(DecodeError):
        decode(type(EXAMPLES[name]), data)


@given(names, st.data())
def test_flipped_bytes_give_a_message_or_the_typed_error(name: str, data: st.DataObject) -> None:
    raw = bytearray(encode(EXAMPLES[name]))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    kind = type(EXAMPLES[name])
    try:
        message = decode(kind, bytes(raw))
    except DecodeError:
        return
    assert isinstance(message, kind)
    encode(message)


def poisoned(body: Any, value: float) -> list[Any]:
    """Return copies of a msgpack body, each with one float replaced."""
    out: list[Any] = []
    items = body.items() if isinstance(body, dict) else enumerate(body)
    for key, item in items:
        variants = (
            [value] if isinstance(item, float) else poisoned(item, value) if isinstance(item, dict | tuple) else []
        )
        for variant in variants:
            copy = dict(body) if isinstance(body, dict) else list(body)
            copy[key] = variant
            out.append(copy)
    return out


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", sorted(n for n, e in EXAMPLES.items() if isinstance(e, Message)))
def test_no_float_may_be_nan_or_infinite(name: str, value: float) -> None:
    example = EXAMPLES[name]
    body = msgpack.unpackb(bytes(encode(example)), use_list=False)
    for variant in poisoned(body, value):
        with pytest.raises(DecodeError):
            decode(type(example), msgpack.packb(variant))


def renumbered(body: Any, number: int, field: str = "") -> list[Any]:
    """Return copies of a msgpack body, each with one tree's number replaced."""
    if isinstance(body, int) and re.fullmatch(r"id|(\w+_)?tree_ids?", field):
        return [number]
    if not isinstance(body, dict | tuple):
        return []
    out: list[Any] = []
    for key, item in body.items() if isinstance(body, dict) else enumerate(body):
        for variant in renumbered(item, number, key if isinstance(key, str) else field):
            copy = dict(body) if isinstance(body, dict) else list(body)
            copy[key] = variant
            out.append(copy)
    return out


NUMBERED = {
    "treedock.claim",
    "treedock.command",
    "treedock.held",
    "treedock.mission",
    "treedock.target",
    "treedock.trees",
}


@pytest.mark.parametrize("number", [-1, 2**63, 2**64 - 1])
def test_the_numbers_of_trees_fit_64_bits_everywhere(number: int) -> None:
    """One such message ended the recorder: OverflowError, where its row was written."""
    found = set()
    for name, example in EXAMPLES.items():
        if not isinstance(example, Message):
            continue
        body = msgpack.unpackb(bytes(encode(example)), use_list=False)
        for variant in renumbered(body, number):
            found.add(name)
            with pytest.raises(DecodeError, match=r"tree|\bid\b"):
                decode(type(example), msgpack.packb(variant))
        for variant in renumbered(body, 2**63 - 1):
            decode(type(example), msgpack.packb(variant))
    assert found >= NUMBERED


def test_another_version_is_refused_by_name() -> None:
    body = msgpack.unpackb(bytes(encode(EXAMPLES["treedock.pose"])))
    body["schema"] = "treedock.pose@2"
    with pytest.raises(DecodeError, match=r"expected treedock.pose@1, found 'treedock.pose@2'"):
        decode(Pose, msgpack.packb(body))


def test_unknown_missing_and_mistyped_fields_are_named() -> None:
    body = msgpack.unpackb(bytes(encode(EXAMPLES["treedock.pose"])))
    with pytest.raises(DecodeError, match="surprise"):
        decode(Pose, msgpack.packb({**body, "surprise": 1}))
    with pytest.raises(DecodeError, match="inliers"):
        decode(Pose, msgpack.packb({k: v for k, v in body.items() if k != "inliers"}))
    with pytest.raises(DecodeError, match="seq"):
        decode(Pose, msgpack.packb({**body, "seq": "1"}))


def test_rgbd_frame_from_before_depth_had_its_own_stamp_reads_as_before() -> None:
    old = GOLDEN / "treedock.rgbd@1.bin"
    assert RgbdFrame.from_bytes(old.read_bytes()).depth_after_ns == 0


def test_rgbd_frame_with_the_depths_own_stamp_keeps_its_bytes() -> None:
    golden = (GOLDEN / "treedock.rgbd@1.depth-after.bin").read_bytes()
    late = replace(frame(), depth_after_ns=-19_500_000)
    assert bytes(late.to_bytes()) == golden
    assert RgbdFrame.from_bytes(golden).depth_after_ns == -19_500_000
    before = (GOLDEN / "treedock.rgbd@1.bin").read_bytes()
    assert [at for at, (a, b) in enumerate(zip(golden, before, strict=True)) if a != b] == [7], "the unused byte alone"


def test_depth_after_is_rounded_and_ends_at_what_a_byte_holds() -> None:
    assert depth_after(10**18, 10**18 + 6_800_000) == 7_000_000
    assert depth_after(10**18, 10**18 - 19_100_000) == -19_000_000
    assert depth_after(0, 10**9) == -depth_after(10**9, 0) == 63_500_000


def test_rgbd_frame_with_wrong_sizes_is_refused() -> None:
    good = frame()
    short = RgbdFrame(1, 1, good.intrinsics, good.colour[:-1], good.depth)
    with pytest.raises(DecodeError, match="23 colour bytes, 24 expected"):
        RgbdFrame.from_bytes(short.to_bytes())
    shallow = RgbdFrame(1, 1, good.intrinsics, good.colour, good.depth[:-2])
    with pytest.raises(DecodeError, match="14 depth bytes, 16 expected"):
        RgbdFrame.from_bytes(shallow.to_bytes())


@given(st.integers(0, 5), st.sampled_from([math.nan, math.inf]))
def test_submap_with_nan_is_refused(place: int, value: float) -> None:
    bad = submap()
    points = bad.points_m.copy()
    points.flat[place] = value
    data = replace(bad, points_m=points).to_bytes()
    with pytest.raises(DecodeError, match="NaN or infinity"):
        Submap.from_bytes(data)


def test_submap_that_names_a_missing_view_or_no_rotation_is_refused() -> None:
    good = submap()
    with pytest.raises(DecodeError, match="names view 7 of 1"):
        Submap.from_bytes(replace(good, view=np.array([0, 7], dtype=np.uint16)).to_bytes())
    with pytest.raises(DecodeError, match="no rotation"):
        Submap.from_bytes(replace(good, T_map_submap=np.diag([2.0, 1.0, 1.0, 1.0])).to_bytes())
