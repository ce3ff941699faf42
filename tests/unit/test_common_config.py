"""The configuration: which source wins, and what a mistake is told."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.cli.app import invoke
from services.common.config import TreedockConfig
from services.common.config_loader import known_keys, load, to_toml
from services.common.config_versions import NEWEST, Migration, current, migrate_file
from services.common.errors import InputError


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_defaults_alone(tmp_path: Path) -> None:
    found = load(environ={}, system_directory=tmp_path)
    assert found.config == TreedockConfig()
    assert found.origins == {}


def test_each_source_wins_over_the_one_before(tmp_path: Path) -> None:
    system = tmp_path / "etc"
    system.mkdir()
    write(system, "10-a.toml", 'uav = "a"\n[router]\nport = 1001\n[slam]\nfeatures = 501\nlevels = 3\n')
    write(system, "20-b.toml", "[router]\nport = 1002\n")
    own = write(tmp_path, "own.toml", "[router]\nport = 1003\n[slam]\nfeatures = 503\n")

    def port(**more: object) -> int:
        return load(system_directory=system, **{"environ": {}, **more}).config.router.port  # type: ignore[arg-type]

    assert port() == 1002
    assert port(file=own) == 1003
    assert port(file=own, environ={"TREEDOCK_ROUTER__PORT": "1004"}) == 1004
    assert port(file=own, environ={"TREEDOCK_ROUTER__PORT": "1004"}, flags=["router.port=1005"]) == 1005
    assert port(file=own, flags=["router.port=1005"], overrides={"router.port": 1006}) == 1006
    found = load(own, environ={"TREEDOCK_CLOCK": "sim"}, system_directory=system)
    assert (found.config.uav, found.config.slam.features, found.config.slam.levels) == ("a", 503, 3)
    assert found.origins["slam.levels"] == str(system / "10-a.toml")
    assert found.origins["slam.features"] == str(own)
    assert found.origins["clock"] == "TREEDOCK_CLOCK"


def test_a_section_of_which_every_line_is_a_comment_says_nothing(tmp_path: Path) -> None:
    own = write(tmp_path, "own.toml", "[router]\n# port = 1003\n[station.fleet]\n")
    found = load(own, environ={}, system_directory=tmp_path)
    assert found.config == TreedockConfig()
    assert found.origins == {}
    with pytest.raises(InputError, match="rooter"):
        load(write(tmp_path, "other.toml", "[rooter]\n"), environ={}, system_directory=tmp_path)


def test_a_file_can_be_named_by_a_variable(tmp_path: Path) -> None:
    own = write(tmp_path, "own.json", '{"router": {"port": 1010}}')
    assert load(environ={"TREEDOCK_CONFIG": str(own)}, system_directory=tmp_path / "no").config.router.port == 1010


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[slam]\nfeaturs = 5\n", ("slam.featurs", "slam.features")),
        ("[slma]\nfeatures = 500\n", ("slma", "slam.features")),
        ("[slam]\nfeatures = 'many'\n", ("slam.features", "'many'")),
        ("[slam]\nfeatures = 1\n", ("slam.features = 1", "100")),
        ("[slam\n", ("not valid TOML",)),
        ("slam = 5\n", ("slam", "section")),
        ('uav = "a/b"\n', ("uav = 'a/b'",)),
        ("[camera]\nmin_range_m = 9.0\n", ("camera", "min_range_m 9.0")),
        ("[camera]\nsource = 'relasense'\n", ("camera.source = 'relasense'", "bag:FILE or realsense")),
        ("[camera]\nsource = 'tum:'\n", ("camera.source = 'tum:'", "tum:DIR")),
    ],
)
def test_a_mistake_names_the_file_and_the_key(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    own = write(tmp_path, "own.toml", text)
    with pytest.raises(InputError) as error:
        load(own, environ={}, system_directory=tmp_path / "no")
    said = str(error.value)
    assert str(own) in said
    for word in words:
        assert word in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"file": Path("/nowhere/x.toml")}, "/nowhere/x.toml"),
        ({"environ": {"TREEDOCK_ROUTER__PROT": "1"}}, "TREEDOCK_ROUTER__PROT: unknown key 'router.prot'"),
        ({"environ": {"TREEDOCK_ROUTER__PORT": "http"}}, "TREEDOCK_ROUTER__PORT: router.port = 'http'"),
        ({"flags": ["slam.features"]}, "expected section.key=value"),
        ({"flags": ["slam.feature=700"]}, "the nearest is 'slam.features'"),
    ],
)
def test_mistakes_outside_of_files(tmp_path: Path, arguments: dict[str, object], words: str) -> None:
    with pytest.raises(InputError) as error:
        load(**{"environ": {}, "system_directory": tmp_path, **arguments})  # type: ignore[arg-type]
    assert words in str(error.value)


@pytest.mark.parametrize(("text", "words"), [
    ('[security]\nfolder = "/x"\n', "security.folder is set, but router.protocol is tcp"),
    ('[router]\nlisten_host = "0.0.0.0"\n[autopilot]\nvehicle = "real"\n', "anybody who reaches router.host or router.listen_host"),
    ('uav = "station"\n', "uav = 'station': certificates of that name are the ground stations'"),
    ('[autopilot]\nconnection = "serial:/dev/ttyACM0:57600"\n', "say autopilot.vehicle = 'real'"),
])  # fmt: skip
def test_a_rule_of_ours_names_the_file_and_speaks_plainly(tmp_path: Path, text: str, words: str) -> None:
    own = write(tmp_path, "own.toml", text)
    with pytest.raises(InputError, match=re.escape(words)) as told:
        load(own, environ={}, system_directory=tmp_path / "none")
    assert str(told.value).startswith(f"{own}: ")
    assert "Value error" not in str(told.value)


@pytest.mark.parametrize(("key", "value"), [
    ("navigator.failsafe.pose_silent_s", "400"),  # milliseconds
    ("navigator.failsafe.pose_silent_s", "inf"),
    ("navigator.motion.max_yaw_rate_rad_s", "30"),  # degrees
    ("navigator.motion.fence_radius_m", "1200"),  # centimetres
    ("navigator.scan_rate_rad_s", "25"),
    ("navigator.approach_speed_m_s", "35"),
    ("autopilot.guidance_stale_s", "400"),
    ("autopilot.setpoint_reach_m", "inf"),
    ("autopilot.camera_pitch_rad", "-20"),
    ("autopilot.camera_offset_m", "[100, 0, 30]"),
    ("refiner.filter.lost_after_s", "500"),
    ("refiner.filter.lost_after_s", '"500"'),
    ("slam.max_depth_m", "6000"),
    ("slam.max_depth_m", "nan"),
    ("fusion.jump_rad", "3"),  # degrees
    ("fusion.second.offset_m", "[0, 0, -50]"),
    ("refiner.filter.lost_after_s", "200"),
    ("navigator.start_height_m", "8"),
    ("navigator.min_ground_m", "80"),
    ("navigator.dock.bearing_rad", "2"),
    ("navigator.scan_overlap_rad", "15"),
    ("detector.slicing.max_suitable_radius_m", "15"),
    ("detector.slicing.max_suitable_lean_rad", "17"),
    ("detector.slicing.max_suitable_radius_m", "-1"),
    ("autopilot.poll_s", "2"),
    ("fusion.second.camera.stall_s", "1000"),
    ("supervisor.hung_after_s", "10000"),
    ("simulator.start_m", "[0.0, inf]"),
])  # fmt: skip
def test_a_limit_in_the_wrong_unit_is_refused_not_a_failsafe_less(tmp_path: Path, key: str, value: str) -> None:
    with pytest.raises(InputError, match=rf"--set {key}: {key}"):
        load(flags=[f"{key}={value}"], environ={}, system_directory=tmp_path)


@pytest.mark.parametrize(("flags", "words"), [
    (["navigator.aircraft_radius_m=0.9"], "safety_radius_m"),
    (["navigator.aircraft_radius_m=0.9", "navigator.safety_radius_m=1.3"], "1.1 at least"),
    (["navigator.dock.min_m=0.2", "navigator.dock.aim_m=0.3", "navigator.dock.max_m=0.4"], "0.55 at least"),
    (["camera.min_range_m=1.0", "autopilot.vehicle=real"], "sees no trunk"),
    (["navigator.flight_height_m=4"], "motion.fence_height_m"),
    (["navigator.motion.fence_height_m=0.5"], "flight_height_m"),
    (["navigator.start_height_m=1.7"], "before take-off"),
])  # fmt: skip
def test_what_would_be_flown_into_something_or_not_at_all_is_refused(
    tmp_path: Path, flags: list[str], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        load(flags=flags, environ={}, system_directory=tmp_path)


def test_in_the_hand_the_camera_starts_where_it_is_carried(tmp_path: Path) -> None:
    flags = ["navigator.handheld=true", "navigator.start_height_m=1.7"]
    assert load(flags=flags, environ={}, system_directory=tmp_path).config.navigator.start_height_m == 1.7


@pytest.mark.parametrize(("key", "value"), [
    ("slam.map_max_age_s", "86400"), ("supervisor.mission_within_s", "7200"), ("simulator.flight.limit_s", "1e9"),
    ("autopilot.origin_alt_m", "1500"), ("navigator.dock.hold_s", "120"), ("slam.new_map_after_s", "0.5"),
    ("slam.map_max_age_s", "604800"), ("mapper.save_s", "86400"), ("detector.publish_move_m", "0.2"), ("mapper.move_rad", "0.03"),
    ("fusion.imu_noise.gyro_rad_s", "0.06"), ("mapper.range_noise_per_m", "0.2"), ("fusion.second.pitch_rad", "1.5708"),
])  # fmt: skip
def test_a_bold_choice_is_no_slip(tmp_path: Path, key: str, value: str) -> None:
    assert load(flags=[f"{key}={value}"], environ={}, system_directory=tmp_path).origins[key]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become a user without rights")
@pytest.mark.parametrize("closed", ["", "10.toml"])
def test_settings_that_a_user_may_not_read_are_told_not_left_out(tmp_path: Path, closed: str) -> None:
    """With the defaults in their place an aircraft would fly another camera, on a plain bus."""
    folder = tmp_path / "etc"
    folder.mkdir()
    write(folder, "10.toml", 'uav = "kea"\n')
    for place in (tmp_path, *tmp_path.parents[:-2]):
        place.chmod(place.stat().st_mode | 0o055)
    (folder / closed).chmod(0o600)
    os.seteuid(65534)
    try:
        with pytest.raises(InputError, match=f"{folder / closed}: this user may not .*: sudo chmod a"):
            load(environ={}, system_directory=folder)
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("vehicle", ["real", "simulation"])
def test_a_serial_line_is_taken_once_it_is_said_what_it_leads_to(tmp_path: Path, vehicle: str) -> None:
    text = f'[autopilot]\nconnection = "serial:/dev/ttyACM0:57600"\nvehicle = "{vehicle}"\n'
    found = load(write(tmp_path, "own.toml", text), environ={}, system_directory=tmp_path / "none").config
    assert found.autopilot.vehicle == vehicle
    assert TreedockConfig.model_validate(found.model_dump(mode="json")) == found


@pytest.mark.parametrize(
    ("host", "listen_host", "local"),
    [("127.0.0.1", "", True), ("localhost", "[::1]", True), ("127.0.0.1", "0.0.0.0", False), ("10.0.0.7", "", False)],
)
def test_a_plain_bus_for_a_real_aircraft_stays_on_its_machine(host: str, listen_host: str, *, local: bool) -> None:
    values = {"router": {"host": host, "listen_host": listen_host}, "autopilot": {"vehicle": "real"}}
    if local:
        assert TreedockConfig.model_validate(values).router.local
    else:
        with pytest.raises(ValueError, match="could fly it"):
            TreedockConfig.model_validate(values)


def test_a_file_that_is_not_text_is_told(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"own\.toml"):
        load(own, environ={}, system_directory=tmp_path / "no")


@given(st.text(max_size=40))
def test_any_value_gives_a_configuration_or_one_line(value: str) -> None:
    said = ""
    try:
        load(environ={"TREEDOCK_UAV": value, "TREEDOCK_SLAM__LEVELS": value}, system_directory=Path("/no"))
    except InputError as error:
        said = str(error)
    assert "\n" not in said


def test_the_dump_reads_back_as_the_same_tree(tmp_path: Path) -> None:
    found = load(environ={"TREEDOCK_SLAM__FEATURES": "800"}, system_directory=tmp_path)
    text = to_toml(found.config.model_dump(mode="json"), found.origins)
    assert "features = 800  # from TREEDOCK_SLAM__FEATURES" in text
    again = load(write(tmp_path, "dump.toml", text), environ={}, system_directory=tmp_path / "no")
    assert again.config == found.config
    assert set(tomllib.loads(text)) >= {"slam", "router", "camera"}


def test_every_setting_is_reachable_by_a_variable() -> None:
    keys = known_keys()
    assert {"uav", "router.port", "refiner.noise.disparity_px", "detector.slicing.voxel_m"} <= set(keys)
    assert len({key.lower() for key in keys}) == len(keys)


def test_a_file_from_the_future_is_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", "config_version = 99\n")
    with pytest.raises(InputError, match=r"a\.toml: config_version = 99.*newer treedock"):
        load(path, environ={}, system_directory=tmp_path / "none")


@pytest.mark.parametrize("version", ['"1"', "-1", "-3", "true", "1.5"])
def test_a_version_is_a_number(tmp_path: Path, version: str) -> None:
    path = write(tmp_path, "a.toml", f"config_version = {version}\n")
    with pytest.raises(InputError, match="config_version"):
        load(path, environ={}, system_directory=tmp_path / "none")


def test_old_files_are_read_through_every_step() -> None:
    def renamed(body: dict[str, object]) -> dict[str, object]:
        return {("new" if key == "old" else key): value for key, value in body.items()}

    def doubled(body: dict[str, object]) -> dict[str, object]:
        return {key: value * 2 if isinstance(value, int) else value for key, value in body.items()}

    steps = {1: Migration(("old",), renamed), 2: Migration((), doubled)}
    assert current({"config_version": 1, "old": 4}, "f", steps) == {"new": 8}
    assert current({"config_version": 2, "new": 4}, "f", steps) == {"new": 8}
    assert current({"config_version": 3, "new": 4}, "f", steps) == {"new": 4}
    assert current({"new": 4}, "f", steps) == {"new": 4}, "no version: today's"
    assert current({"old": 4}, "f", steps) == {"new": 8}, "no version, but a key that only an old one knew"
    with pytest.raises(InputError, match="up to 3"):
        current({"config_version": 4}, "f", steps)


def test_this_version_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", f'config_version = {NEWEST}\nuav = "kea"\n')
    assert load(path, environ={}, system_directory=tmp_path / "none").config.uav == "kea"


OLD = '# ours\nuav = "kea"\n[slam]\nfeatures = 800\naccel_window_s = 0.5\nkeyframe_interval_max = 20\n'


@pytest.mark.parametrize("head", ["", "config_version = 0\n"])
def test_a_file_of_the_first_days_is_read(tmp_path: Path, head: str) -> None:
    found = load(write(tmp_path, "a.toml", head + OLD), environ={}, system_directory=tmp_path / "none").config
    assert (found.uav, found.slam.features) == ("kea", 800)


def test_a_file_that_says_it_is_new_may_not_hold_old_keys(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="accel_window_s"):
        load(write(tmp_path, "a.toml", "config_version = 1\n" + OLD), environ={}, system_directory=tmp_path / "none")


@pytest.mark.parametrize("head", ["", "config_version = 1\n"])
@pytest.mark.parametrize(("depth", "wanted"), [("png", "png"), ("z16", "zstd")])
def test_how_frames_are_compressed_moved_to_the_camera(tmp_path: Path, head: str, depth: str, wanted: str) -> None:
    text = head + f'[recorder]\ndepth = "{depth}"\njpeg_quality = 70\nfile_mb = 9\n[camera]\nrate = 2.0\n'
    found = load(write(tmp_path, "a.toml", text), environ={}, system_directory=tmp_path / "none").config
    assert (found.camera.compressed_depth, found.camera.jpeg_quality, found.camera.rate) == (wanted, 70, 2.0)
    assert found.recorder.file_mb == 9


def test_migration_writes_the_file_anew_and_keeps_the_old_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, "a.toml", OLD)
    path.chmod(0o640)
    before = load(path, environ={}, system_directory=tmp_path / "none").config
    assert invoke(["config", "--migrate", "--config", str(path)]) == 0
    assert f"version {NEWEST}" in capsys.readouterr().out
    assert tomllib.loads(path.read_text())["config_version"] == NEWEST
    assert path.stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "a.toml.old").read_text() == OLD
    assert load(path, environ={}, system_directory=tmp_path / "none").config == before
    assert invoke(["config", "--migrate", "--config", str(path)]) == 0
    assert "already" in capsys.readouterr().out


@pytest.mark.parametrize("mode", [0o644, 0o640])
def test_a_migrated_file_is_readable_for_whom_it_was(tmp_path: Path, mode: int) -> None:
    """As root with a strict umask: the services, in the file's group, read it afterwards too."""
    path = write(tmp_path, "a.toml", OLD)
    path.chmod(mode)
    owner = (0, 4711) if os.geteuid() == 0 else (os.geteuid(), os.getegid())
    os.chown(path, *owner)
    before = os.umask(0o077)
    try:
        migrate_file(path)
    finally:
        os.umask(before)
    for file in (path, tmp_path / "a.toml.old"):
        status = file.stat()
        assert status.st_mode & 0o777 == mode
        assert (status.st_uid, status.st_gid) == owner


def test_a_failed_migration_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, "a.toml", OLD)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        migrate_file(path)
    assert path.read_text() == OLD


def test_a_file_from_the_future_is_not_migrated(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", "config_version = 7\n")
    with pytest.raises(InputError, match="newer treedock"):
        migrate_file(path)


def test_a_json_file_is_not_overwritten_with_toml(tmp_path: Path) -> None:
    path = write(tmp_path, "a.json", "[1]\n")  # is TOML, too
    with pytest.raises(InputError, match=r"a\.json: --migrate writes TOML"):
        migrate_file(path)
    assert path.read_text() == "[1]\n"


def test_the_dump_carries_the_version_and_is_read_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["config"]) == 0
    assert current(tomllib.loads(capsys.readouterr().out), "dump")["uav"] == "uav1"
