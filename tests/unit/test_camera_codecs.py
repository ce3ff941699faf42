from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.camera.codecs import (
    FrameError,
    decode_colour,
    decode_colour_image,
    decode_depth,
    decode_depth_image,
    decode_depth_m,
    decode_depth_raw,
    encode_colour,
    encode_depth,
    raw,
    recode,
)
from services.camera.jpeg import jpeg_fault
from services.camera.ranging import limit_range
from tests.camera_data import colour_image, depth_image, frame


@pytest.mark.parametrize("encoding", ["z16", "png", "zstd"])
def test_depth_survives_every_encoding(encoding: str) -> None:
    depth = depth_image(1)
    packed = encode_depth(depth, encoding)  # type: ignore[arg-type]
    assert np.array_equal(decode_depth(packed, encoding, 48, 32), depth)  # type: ignore[arg-type]


def test_depth_in_metres_keeps_holes_as_zero() -> None:
    metres = decode_depth_m(frame(3))
    assert metres.dtype == np.float32
    assert np.array_equal(metres == 0, depth_image(3) == 0)
    assert np.allclose(metres, depth_image(3) / 5000.0, atol=1e-4)


def test_a_packed_frame_unpacks_to_the_same_depth_and_nearly_the_same_colour() -> None:
    packed = recode(frame(2), "jpeg", "png", 95)
    assert (packed.colour_encoding, packed.depth_encoding) == ("jpeg", "png")
    plain = raw(packed)
    assert np.array_equal(decode_depth_raw(plain), depth_image(2))
    assert np.abs(decode_colour(plain).astype(int) - colour_image(2)).mean() < 6


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_a_cut_png_is_refused_wherever_it_is_cut(share: float) -> None:
    data = encode_depth(depth_image(5), "png")
    with pytest.raises(FrameError, match=r"PNG|empty"):
        decode_depth_image(data[: int(share * len(data))], 48, 32)


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_a_cut_jpeg_is_refused_wherever_it_is_cut(share: float) -> None:
    data = encode_colour(colour_image(5), "jpeg")
    with pytest.raises(FrameError, match=r"JPEG|empty"):
        decode_colour_image(data[: int(share * len(data))], 48, 32)


def test_a_flipped_bit_in_a_png_is_refused() -> None:
    data = bytearray(encode_depth(depth_image(5), "png"))
    data[len(data) // 2] ^= 4
    with pytest.raises(FrameError, match="checksum"):
        decode_depth_image(bytes(data), 48, 32)


JPEG_FLAVOURS = {
    "plain": [], "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 3], "own tables": [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "full chroma": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111], "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
}  # fmt: skip


@pytest.mark.parametrize("flavour", JPEG_FLAVOURS)
@pytest.mark.parametrize("shape", [(32, 48, 3), (31, 43, 3), (5, 5, 3), (32, 48)])
def test_a_whole_jpeg_is_accepted(flavour: str, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    for quality in (20, 90, 100):
        image = rng.integers(0, 255, shape, dtype=np.uint8)
        options = [cv2.IMWRITE_JPEG_QUALITY, quality, *JPEG_FLAVOURS[flavour]]
        assert jpeg_fault(bytes(cv2.imencode(".jpg", image, options)[1])) == ""


def test_motion_jpeg_without_its_tables_is_accepted() -> None:
    data = encode_colour(colour_image(5), "jpeg")
    while (at := data.find(b"\xff\xc4")) >= 0:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        data = data[:at] + data[at + 2 + length :]
    assert jpeg_fault(data) == ""
    assert np.array_equal(
        decode_colour_image(data, 48, 32), decode_colour_image(encode_colour(colour_image(5), "jpeg"), 48, 32)
    )


def _large_jpeg(options: list[int]) -> bytes:
    rng = np.random.default_rng(2)
    image = cv2.resize(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(".jpg", image, options)[1])


@pytest.mark.parametrize("kind", ["zeros", "noise", "ones", "cut out"])
@pytest.mark.parametrize("flavour", ["plain", "restarts", "own tables", "full chroma"])
def test_a_jpeg_damaged_in_its_middle_is_refused(flavour: str, kind: str) -> None:
    data, rng = _large_jpeg(JPEG_FLAVOURS[flavour]), np.random.default_rng(3)
    for start in np.linspace(0.1, 0.9, 9):
        at = int(start * len(data))
        damage = {"zeros": bytes(2000), "noise": rng.bytes(2000), "ones": b"\xff" * 2000, "cut out": b""}[kind]
        with pytest.raises(FrameError, match="JPEG"):
            decode_colour_image(data[:at] + damage + data[at + 2000 :], 640, 480)


def test_a_restart_out_of_turn_is_refused() -> None:
    data = _large_jpeg(JPEG_FLAVOURS["restarts"])
    at = data.index(b"\xff\xd3")
    with pytest.raises(FrameError, match="restart"):
        decode_colour_image(data[:at] + b"\xff\xd4" + data[at + 2 :], 640, 480)


def test_swapped_colour_and_depth_are_told() -> None:
    with pytest.raises(FrameError, match="colour and depth swapped"):
        decode_colour_image(encode_depth(depth_image(1), "png"), 48, 32)
    with pytest.raises(FrameError, match="colour and depth swapped"):
        decode_depth_image(encode_colour(colour_image(1), "jpeg"), 48, 32)
    colour_png = bytes(cv2.imencode(".png", colour_image(1))[1])
    assert np.array_equal(decode_colour_image(colour_png, 48, 32), colour_image(1))
    with pytest.raises(FrameError, match=r"3 channel\(s\) of uint8"):
        decode_depth_image(colour_png, 48, 32)


def test_padding_after_a_jpeg_is_no_fault() -> None:
    data = encode_colour(colour_image(5), "jpeg") + b"\0" * 7
    assert decode_colour_image(data, 48, 32).shape == (32, 48, 3)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=200), start=st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]))
def test_random_bytes_give_the_one_error(data: bytes, start: bytes) -> None:
    for decode in (decode_colour_image, decode_depth_image):
        with pytest.raises(FrameError):
            decode(start + data, 48, 32)


def test_wrong_size_and_wrong_kind_are_named() -> None:
    with pytest.raises(FrameError, match="depth image is 24x16, expected 48x32"):
        decode_depth_image(encode_depth(depth_image(1)[:16, :24], "png"), 48, 32)
    eight_bit = bytes(cv2.imencode(".png", np.zeros((32, 48), np.uint8))[1])
    with pytest.raises(FrameError, match="uint8, expected one of uint16"):
        decode_depth_image(eight_bit, 48, 32)
    with pytest.raises(FrameError, match="colour image is 24x16, expected 48x32"):
        decode_colour_image(encode_colour(colour_image(1)[:16, :24], "jpeg"), 48, 32)
    with pytest.raises(FrameError, match="3072 expected"):
        decode_depth(b"\0" * 100, "z16", 48, 32)
    with pytest.raises(FrameError, match="zstd"):
        decode_depth(b"nonsense", "zstd", 48, 32)


def test_a_zstd_bomb_is_refused() -> None:
    bomb = encode_depth(np.zeros((4000, 4000), np.uint16), "zstd")
    with pytest.raises(FrameError):
        decode_depth(bomb, "zstd", 48, 32)


def test_the_range_filter_keeps_its_limits_and_drops_the_rest() -> None:
    depth = np.array([[0, 2499, 2500, 2501, 30000, 30001, 65535]], dtype=np.uint16)
    assert limit_range(depth, 5000.0, 0.5, 6.0).tolist() == [[0, 0, 2500, 2501, 30000, 0, 0]]
