from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.camera import RgbdFrame
from services.camera.codecs import decode_colour, decode_depth_m
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.sources import BadFrame, open_recording, open_source
from services.camera.sources.ros_bag import BagSource
from services.common.errors import InputError
from tests.camera_data import CAMERA, colour_image, stamp_ns
from tests.ros_bags import COLOUR, DEPTH, DEPTH_LATE_NS, INFO, BagMaker, camera_messages, depth_mm

CONFIG = CameraConfig(min_range_m=0.0, max_range_m=13.0, depth=DepthConfig(drop_mixed=False))


def written(tmp_path: Path, ros: int = 2, count: int = 4, form: str = "raw", **options: Any) -> Path:
    maker = BagMaker(ros)
    return maker.write(tmp_path / ("a.bag" if ros == 1 else "a"), camera_messages(maker, count, form), **options)


def frames_of(path: Path, config: CameraConfig = CONFIG) -> list[RgbdFrame]:
    items = list(open_recording(path, config))
    assert all(isinstance(item, RgbdFrame) for item in items), items
    return [item for item in items if isinstance(item, RgbdFrame)]


@pytest.mark.parametrize("form", ["raw", "compressed", "float"])
@pytest.mark.parametrize(("ros", "mcap"), [(1, False), (2, False), (2, True)])
def test_a_bag_gives_its_frames(tmp_path: Path, ros: int, mcap: bool, form: str) -> None:
    path = written(tmp_path, ros, form=form, **({"mcap": True} if mcap else {}))
    source = open_recording(path, CONFIG)
    frames = [item for item in source if isinstance(item, RgbdFrame)]
    assert source.expected == len(frames) == 4
    assert [f.stamp_ns for f in frames] == [stamp_ns(k) for k in range(4)]
    assert [f.seq for f in frames] == [0, 1, 2, 3]
    assert {f.depth_after_ns for f in frames} == {DEPTH_LATE_NS}
    camera = frames[0].intrinsics
    assert (camera.fx, camera.cx, camera.k1, camera.k3) == (40.0, 23.5, 0.1, 0.05)
    for k, each in enumerate(frames):
        assert np.abs(decode_depth_m(each) - depth_mm(k) / 1000.0).max() < 2e-4
        assert np.abs(decode_colour(each).astype(int) - colour_image(k)).mean() < (6 if form == "compressed" else 0.01)


@pytest.mark.parametrize("mcap", [False, True])
def test_a_single_file_of_a_ros2_bag_opens_too(tmp_path: Path, mcap: bool) -> None:
    folder = written(tmp_path, mcap=mcap)
    (file,) = folder.glob("*.mcap" if mcap else "*.db3")
    assert len(frames_of(file)) == 4


def test_metres_of_a_depth_camera_of_its_own_stay_metres(tmp_path: Path) -> None:
    """An image of metres tells its own unit: the depth camera's file has millimetres, as calibrate writes."""
    here = {**CAMERA, "depth_scale": 1000.0}
    (tmp_path / "depth.json").write_text(json.dumps({**here, "T_colour_depth": np.eye(4).tolist()}))
    (tmp_path / "colour.json").write_text(json.dumps(here))
    config = CONFIG.model_copy(
        update={"depth_camera_file": str(tmp_path / "depth.json"), "camera_file": str(tmp_path / "colour.json")}
    )
    for k, each in enumerate(frames_of(written(tmp_path, form="float"), config)):
        assert np.abs(decode_depth_m(each) - depth_mm(k) / 1000.0).max() < 2e-3


def test_images_without_header_stamps_are_refused_with_the_topic(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = camera_messages(maker, 6)
    for topic, _, message in messages:
        if topic == DEPTH:
            message.header.stamp = maker.header(0).stamp
    with pytest.raises(InputError, match=f"{DEPTH}: 6 of 6 images have the header stamp 0.000 s: the driver"):
        open_recording(maker.write(tmp_path / "a", messages), CONFIG)


def test_the_source_can_be_named(tmp_path: Path) -> None:
    assert open_source(f"bag:{written(tmp_path, 1)}", CONFIG).expected == 4
    with pytest.raises(InputError, match="no such file"):
        open_source(f"bag:{tmp_path}/none.bag", CONFIG)


def test_colour_and_depth_are_paired_by_stamp_in_whatever_order_they_come(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = camera_messages(maker, 6)
    info, colours, depths = messages[0], messages[1::2], messages[2::2]
    del colours[2], depths[4]
    frames = frames_of(maker.write(tmp_path / "a", [info, *depths[:3], *colours, *depths[3:]]))
    assert [f.stamp_ns for f in frames] == [stamp_ns(k) for k in (0, 1, 3, 5)]
    for k, each in zip((0, 1, 3, 5), frames, strict=True):
        assert np.abs(decode_depth_m(each) - depth_mm(k) / 1000.0).max() < 1e-5


def test_stamps_shifted_by_a_tenth_of_a_second_are_told(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = [m for m in camera_messages(maker, 3) if m[0] != DEPTH]
    for k in range(3):
        late = stamp_ns(k) + 100_000_000
        messages.append((DEPTH, late, maker.image(late, depth_mm(k), "16UC1")))
    with pytest.raises(InputError, match=r"no colour image has a depth image within 20 ms.*33 ms away.*shifted"):
        BagSource(maker.write(tmp_path / "a", messages), CONFIG)


def test_topics_are_chosen_by_content_and_can_be_named(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = camera_messages(maker, 2)
    for k in range(2):
        at = stamp_ns(k)
        messages.append(("/camera/depth/image_rect_raw", at, maker.image(at, depth_mm(k + 5), "16UC1")))
        messages.append(("/camera/infra1/image_rect_raw", at, maker.image(at, colour_image(k)[:, :, 0], "mono8")))
    path = maker.write(tmp_path / "a", messages)
    source = BagSource(path, CONFIG)
    assert (source.topics.colour, source.topics.depth, source.topics.info) == (COLOUR, DEPTH, INFO)
    named = CONFIG.model_copy(update={"bag_depth_topic": "/camera/depth/image_rect_raw"})
    assert np.array_equal(decode_depth_m(frames_of(path, named)[0]), depth_mm(5).astype(np.float32) / np.float32(1000))
    with pytest.raises(InputError, match=r"no /x; the image topics are: .*/camera/color/image_raw"):
        BagSource(path, CONFIG.model_copy(update={"bag_colour_topic": "/x"}))


def test_without_camera_info_a_file_is_asked_for(tmp_path: Path) -> None:
    maker = BagMaker(1)
    path = maker.write(tmp_path / "a.bag", camera_messages(maker, 2)[1:])
    with pytest.raises(InputError, match=r"no CameraInfo beside /camera/color/image_raw; .*--camera"):
        BagSource(path, CONFIG)
    file = tmp_path / "camera.json"
    file.write_text(json.dumps({**CAMERA, "fx": 41.0}))
    frames = frames_of(path, CONFIG.model_copy(update={"camera_file": str(file)}))
    assert frames[0].intrinsics.fx == 41.0
    assert np.abs(decode_depth_m(frames[0]) - depth_mm(0) / 1000.0).max() < 1e-5, (
        "16UC1 is millimetres whatever the file says"
    )


def test_a_fisheye_lens_is_refused(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = camera_messages(maker, 2)
    messages[0] = (INFO, stamp_ns(0), maker.info(stamp_ns(0), (0.1, 0.0, 0.0, 0.0), "equidistant"))
    with pytest.raises(InputError, match="lens model 'equidistant'"):
        BagSource(maker.write(tmp_path / "a", messages), CONFIG)


def test_a_bag_without_images_is_refused(tmp_path: Path) -> None:
    maker = BagMaker(2)
    with pytest.raises(InputError, match="no colour images; the image topics are: none"):
        BagSource(maker.write(tmp_path / "a", camera_messages(maker, 2)[:1]), CONFIG)


def test_a_damaged_image_is_a_bad_frame_among_good_ones(tmp_path: Path) -> None:
    maker = BagMaker(2)
    messages = camera_messages(maker, 3, "compressed")
    data = bytes(messages[3][2].data)
    messages[3] = (messages[3][0], messages[3][1], maker.compressed(messages[3][1], data[: len(data) // 2], "jpeg"))
    items = list(open_recording(maker.write(tmp_path / "a", messages), CONFIG))
    assert [isinstance(item, BadFrame) for item in items] == [False, True, False]
    assert isinstance(items[1], BadFrame)
    assert "truncated JPEG" in items[1].reason


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_a_cut_bag_never_crashes(tmp_path: Path, ros: int, share: float) -> None:
    path = written(tmp_path, ros, 30)
    file = path if ros == 1 else next(path.glob("*.db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    faults = _faults(path)
    assert len(faults) == 1
    assert str(path) in faults[0]
    assert "\n" not in faults[0]


def _faults(path: Path) -> list[str]:
    try:
        return [item.reason for item in open_recording(path, CONFIG) if isinstance(item, BadFrame)]
    except InputError as error:
        return [str(error)]
