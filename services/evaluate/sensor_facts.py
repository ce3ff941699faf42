"""What is published of the depth sensors that `treedock bench cameras` compares, each figure with its source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

UNKNOWN = "unknown"
"""No source that could be read here tells it."""

SOURCES: Mapping[str, str] = {
    "KHO": "K. Khoshelham, S. Oude Elberink: Accuracy and resolution of Kinect depth data for indoor mapping applications, Sensors 12 (2012), 1437-1454",
    "MS1": "Microsoft, Kinect for Windows SDK 1.8: DepthRange enumeration; sensor specifications (57 x 43 degrees, 30 frames/s)",
    "MRD": "Microsoft, Robotics Developer Studio: Kinect Sensor (not in direct sunlight)",
    "MS2": "Microsoft, Kinect for Windows SDK 2.0: IDepthFrame (8 m at most, less reliable from 4.5 m)",
    "SME": "R. Smeenk: Kinect V1 and Kinect V2 fields of view compared (2014)",
    "FAN": "P. Fankhauser, M. Bloesch, D. Rodriguez, R. Kaestner, M. Hutter, R. Siegwart: Kinect v2 for mobile robot navigation: evaluation and modeling, ICAR 2015",
    "R2D": "Intel, RealSense Camera R200 product datasheet 334616-001 (2016), as the reference thesis quotes it (section 3.1)",
    "CAM": "Intel, librealsense (legacy), doc/camera_specs.md",
    "KES": "L. Keselman, J. I. Woodfill, A. Grunnet-Jepsen, A. Bhowmik: Intel RealSense stereoscopic depth cameras, CVPR workshops 2017",
    "TB3": "ROBOTIS e-Manual, TurtleBot3, appendix RealSense",
    "D4D": "Intel, RealSense D400 series datasheet 337029",
    "BKM": "A. Grunnet-Jepsen, J. N. Sweetser, J. Woodfill: Best-known-methods for tuning Intel RealSense D400 depth cameras, Intel white paper",
    "BB2": "Point Grey, Bumblebee2 data sheet, as quoted in the robot model bumblebee2 of TheLegace (2012)",
    "VLP": "Velodyne, VLP-16 user manual 63-9243",
    "BLS": "Blensor (Blender sensor simulation), its table of the VLP-16's data sheet",
    "SDF": "Gazebo models of the VLP-16 after its drawing (mass 0.83 kg, radius 51.6 mm, height 71.7 mm)",
    "EOG": "eog-2017/cameras, README: prices in India, 2017",
    "REF": "the reference thesis (2018), section 3.1.1 and its Table 3.1",
    "DES": "this project's own measurements of active stereo outdoors (0.03 to 0.2 px; 0.08 taken)",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Facts:
    """One sensor; each entry names its sources in brackets."""

    technology: str
    image: str
    depth_view: str
    range: str
    rate: str
    noise: str
    sunlight: str
    size: str
    weight: str
    price: str


FACTS: Mapping[str, Facts] = {
    "Kinect 1": Facts(
        "structured light",
        "640x480 [KHO]",
        "57 x 43° [MS1]",
        "0.8 to 4.0 m [MS1]",
        "30 Hz [MS1]",
        "1.425 mm z², steps of 2.85 mm z² (z in m) [KHO]",
        "no depth in direct sun [MRD]",
        "large [REF]",
        UNKNOWN,
        "medium [REF]",
    ),
    "Kinect 2": Facts(
        "time of flight",
        "512x424 [SME]",
        "70.6 x 60° [SME]",
        "0.5 to 4.5 m, at most 8 [MS2]",
        "30 Hz [FAN]",
        "1.5 - 0.5 z + 0.3 z² mm, more where the surface is steep [FAN]",
        "unknown: measured in [FAN], but its figures could not be read here; not modelled",
        "large [REF]",
        UNKNOWN,
        "17,742 rupees [EOG]",
    ),
    "R200": Facts(
        "active stereo",
        "640x480, colour squeezed [R2D]",
        "59 x 46° in colour of 70 x 43° [R2D]",
        "0.5 m to 3.5 m indoors, 10 m outdoors [CAM]",
        "30, 60, 90 Hz [CAM]",
        "z² s / (f B) [KES], B 70 mm [CAM], s 0.08 px [DES]",
        "works: the projector is drowned, the cameras see the sunlit texture [CAM]",
        "102 x 9.6 x 3.8 mm [R2D]",
        "below 35 g [TB3]",
        "23,395 rupees [EOG]",
    ),
    "D435": Facts(
        "active stereo",
        "848x480 (of 1280x720) [D4D]",
        "87 x 58° [D4D]",
        "0.28 m to about 10 m [D4D]",
        "up to 90 Hz [D4D]",
        "z² s / (f B) [BKM], B 50 mm [D4D], s 0.08 px [BKM]",
        "works: as the R200 [KES]",
        "90 x 25 x 25 mm [D4D]",
        UNKNOWN,
        UNKNOWN,
    ),
    "Bumblebee2": Facts(
        "passive stereo",
        "640x480 [BB2]",
        "66° across (3.8 mm lens) [BB2]",
        UNKNOWN,
        "48 Hz [BB2]",
        "z² s / (f B), B 120 mm [BB2]; s unknown, 0.2 px assumed (the worst of [DES])",
        "works: it needs light [REF]",
        UNKNOWN,
        UNKNOWN,
        UNKNOWN,
    ),
    "VLP-16": Facts(
        "LiDAR, 16 beams",
        "16 beams, 2° apart, 0.2° in azimuth at 10 Hz [VLP]",
        "360 x 30° [VLP]",
        "up to 100 m [BLS]",
        "5 to 20 Hz [BLS]",
        "30 mm [BLS]",
        "works [REF]",
        "103 mm across, 72 mm high [SDF]",
        "830 g [SDF]",
        "8,000 dollars [REF]",
    ),
}  # fmt: skip

_ROWS = (
    ("technology", "technology"), ("image", "image"), ("depth's view", "depth_view"), ("range", "range"), ("rate", "rate"),
    ("depth noise (1 sigma)", "noise"), ("sunlight", "sunlight"), ("size", "size"), ("weight", "weight"), ("price", "price"),
)  # fmt: skip


def facts_table() -> list[str]:
    """Return the facts as a Markdown table, one column a sensor, and the list of sources used."""
    names = list(FACTS)
    lines = ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    lines += [f"| {title} | " + " | ".join(getattr(FACTS[n], key) for n in names) + " |" for title, key in _ROWS]
    told = " ".join(lines)
    return [*lines, "", *(f"- [{key}] {source}." for key, source in SOURCES.items() if f"[{key}]" in told)]
