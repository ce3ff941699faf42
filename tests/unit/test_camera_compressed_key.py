"""``slam.frames`` and ``refiner.frames`` choose between the camera's two keys."""

from __future__ import annotations

import pytest

from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, Topic
from services.common.config import TreedockConfig
from services.common.memory import Hub
from services.detector.refine import service as refiner
from services.detector.refine.config import RefinerConfig
from services.slam import service as slam
from services.slam.config import SlamConfig


@pytest.mark.parametrize(("choice", "topic"), [("raw", CAMERA_RGBD), ("compressed", CAMERA_COMPRESSED)])
def test_the_chosen_key_is_listened_to_and_the_other_is_not(choice: str, topic: Topic) -> None:
    for build, config in (
        (slam.build, TreedockConfig(slam=SlamConfig.model_validate({"frames": choice}))),
        (refiner.build, TreedockConfig(refiner=RefinerConfig.model_validate({"frames": choice}))),
    ):
        hub = Hub(config)
        build(hub.context("any"))
        camera = hub.context("camera")
        assert [t for t in (CAMERA_RGBD, CAMERA_COMPRESSED) if camera.listened(t)] == [topic]
