"""The command line's promises: quick help, exit codes, one line for a mistake, readable traffic."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from schemas.codec import encode
from schemas.command import CommandReply
from schemas.topics import COMMAND, TOPICS, Topic
from services.cli import app
from services.cli.commands import names
from services.cli.readable import plain, read, text, topic_of
from services.cli.service_command import SERVICES
from services.cli.topic import rate_line
from services.cli.zenoh_decoder import decode
from services.common.errors import GoalNotReachedError
from tests.examples import all_messages

ROOT = Path(__file__).parents[2]


def treedock(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.cli.app", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_help_is_quick_and_names_every_command() -> None:
    treedock("--help")
    begin_s = _children_cpu_s()
    result = treedock("--help")
    assert _children_cpu_s() - begin_s < 1.0, "half a second; processor time, since the machine may be busy"
    assert result.returncode == 0
    for name in ("run", "process", "detect", "config", "topic", *SERVICES):
        assert f" {name} " in result.stdout


@pytest.mark.parametrize("name", names())
def test_every_command_that_the_help_lists_can_be_called(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert app.invoke([name, "--help"]) == 0
    assert f"Usage: treedock {name} " in capsys.readouterr().out


def test_a_call_loads_no_other_command() -> None:
    code = "import sys; from services.cli.app import make_app; make_app('slam'); print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    assert "services.cli.service_command" in loaded
    assert not {"services.cli.run", "services.cli.bench", "services.cli.certs"} & set(loaded)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("no-such-command",), "no-such-command"),
        (("run", "--no-such-option"), "--no-such-option"),
        (("run", "--seed", "many"), "--seed"),
        (("config", "--config", "nowhere.toml"), "nowhere.toml"),
        (("config", "--set", "slam.feature=1"), "slam.features"),
        (("run", "--autopilot", "pigeon"), "pigeon"),
        (("run", "--scene", "no-such-scene"), "no-such-scene"),
        (("run", "--source", "realsense"), "pyrealsense2 is missing"),
        (("run", "--logs", "README.md"), "--logs README.md: cannot be written"),
        (("run", "--set", "router.port=0"), "router.port"),
        (("topic", "hz", "no/such"), "no topic 'no/such'"),
        (("topic", "echo", "slam/pose", "--port", "1"), "no router answers at tcp/127.0.0.1:1"),
        (("router", "--set", "router.host=pigeon house"), "router.host"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments: tuple[str, ...], words: str) -> None:
    result = treedock(*arguments)
    assert result.returncode == 2, result.stderr
    assert words in result.stderr
    assert result.stderr.startswith("treedock: ")
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


def test_exit_codes_of_other_ends(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import typer

    def end_with(error: BaseException) -> int:
        broken = typer.Typer()

        @broken.command()
        def fail() -> None:
            raise error

        monkeypatch.setattr(app, "make_app", lambda _: broken)
        return app.invoke([])

    assert end_with(GoalNotReachedError("the mission ended without docking")) == 3
    assert capsys.readouterr().err == "treedock: the mission ended without docking\n"
    assert end_with(KeyboardInterrupt()) == 130
    assert end_with(ZeroDivisionError("oh")) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "this is a bug" in said.splitlines()[-1]


@pytest.mark.parametrize("arguments", [(), ("topic",)])
def test_a_command_without_its_word_shows_the_help_alone(arguments: tuple[str, ...]) -> None:
    result = treedock(*arguments)
    assert result.returncode == 2
    assert "Usage: treedock" in result.stdout
    assert result.stderr == ""


@pytest.mark.parametrize("arguments", [("--help",), ("topic", "list", "--port", "1"), ("config",)])
def test_a_reader_that_goes_away_is_no_fault(arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-u", "-m", "services.cli.app", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) == 0, said
    assert "Traceback" not in said


def test_config_prints_what_is_in_force() -> None:
    result = treedock("config", "--set", "slam.features=801")
    assert tomllib.loads(result.stdout)["slam"]["features"] == 801
    assert "features = 801  # from --set slam.features" in result.stdout
    found = json.loads(treedock("config", "--json", "--port", "7999").stdout)
    assert found["config"]["router"]["port"] == 7999
    assert "router.port" in found["origins"]


def test_topic_list_works_without_a_router() -> None:
    found = json.loads(treedock("topic", "list", "--json", "--port", "1").stdout)
    assert [row["name"] for row in found["topics"]] == [topic.name for topic in TOPICS]
    assert found["live"] == []


def test_topic_list_fits_80_columns_and_cuts_no_name() -> None:
    lines = treedock("topic", "list", "--port", "1").stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)
    assert {line.split()[0] for line in lines if line.strip()} >= {topic.name for topic in TOPICS}


@pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.name)
def test_every_message_is_readable(topic: Topic) -> None:
    message = next(m for m in all_messages().values() if isinstance(m, topic.message))
    key = topic.key("uav1", "slam" if topic.name.endswith("*") else None)
    assert topic_of(key) == topic
    line = text(key, bytes(encode(message)))
    assert "undecodable" not in line
    assert "\n" not in line
    assert len(line) < 4000
    assert isinstance(json.loads(line), dict)


def test_a_reply_is_read_as_what_it_says_it_is() -> None:
    reply = CommandReply(accepted=False, reason="no nonce", state="idle")
    assert read(COMMAND.key("uav1", "start"), bytes(encode(reply))) == reply


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        ("treedock/v1/uav1/slam/pose", b"\x81"),
        ("treedock/v1/uav1/camera/rgbd", b"TDRF"),
        ("other/key", b"x"),
        ("", b""),
    ],
)
def test_what_cannot_be_read_is_told_not_raised(key: str, payload: bytes) -> None:
    assert "undecodable" in json.loads(decode(key, payload))


def test_long_lists_are_cut_unless_asked() -> None:
    assert plain(list(range(20)))[-1] == "... 12 more"
    assert plain(list(range(20)), whole=True) == list(range(20))
    assert plain(bytes(1000)) == "<1000 bytes>"


def test_the_decoder_for_zenoh_cli_is_installed() -> None:
    (found,) = entry_points(group="zenoh_cli.codecs.decoders", name="treedock")
    assert found.load() is decode


def test_rates_are_of_what_came() -> None:
    assert rate_line("slam/pose", [], 1.0) == "slam/pose: nothing"
    line = rate_line("slam/pose", [(0.0, 100), (0.1, 100), (0.3, 100)], 0.5)
    assert line == "slam/pose: 6.00 Hz, gaps 100.0 to 200.0 ms, 0.6 kB/s"
