"""``treedock calibrate``: a camera's intrinsics from pictures of a board, judged; and how it sits on the aircraft."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile, Settings, loaded

if TYPE_CHECKING:
    from services.camera.calibration.board import Board
    from services.camera.calibration.extrinsics import Mounting
    from services.camera.calibration.gather import Gathered
    from services.camera.calibration.judge import Limits, Result

_LIVE_VIEWS = 15

Images = Annotated[
    list[Path] | None, typer.Argument(help="Pictures of the board, or folders of them", show_default=False)
]
BoardSize = Annotated[str, typer.Option("--board", help="Inner corners, columns x rows: 9x7 has 10 x 8 squares")]
MountBoard = Annotated[
    str, typer.Option("--mount-board", help="Where that board's centre is in body: x,y,z[,roll,pitch,yaw] (m, degrees)")
]


def calibrate(
    images: Images = None,
    *,
    live: Annotated[bool, typer.Option("--live", help="Take the pictures from the camera (--source)")] = False,
    source: Annotated[str | None, typer.Option("--source", help="realsense, tum:DIR, bag:FILE or mcap:FILE")] = None,
    board: BoardSize = "9x7",
    square: Annotated[float, typer.Option("--square", help="Side of a square, metres", min=0.001, max=1.0)] = 0.025,
    charuco: Annotated[bool, typer.Option("--charuco", help="A ChArUco board, else a checkerboard")] = False,
    marker: Annotated[float, typer.Option("--marker", help="Side of a marker in squares", min=0.3, max=0.95)] = 0.75,
    dictionary: Annotated[str, typer.Option("--dictionary", help="Of the markers")] = "DICT_5X5_100",
    out: Annotated[Path, typer.Option("--out", help="Where to write the camera")] = Path("camera.json"),
    residuals: Annotated[
        Path | None, typer.Option("--residuals", help="Residual picture (default: beside --out)")
    ] = None,
    depth_scale: Annotated[float, typer.Option("--depth-scale", help="Units of depth per metre", min=0.1)] = 1000.0,
    mount_image: Annotated[
        Path | None, typer.Option("--mount-image", help="A picture of the board standing in a known place")
    ] = None,
    mount_board: MountBoard = "",
    print_board: Annotated[Path | None, typer.Option("--print-board", help="Write the board as a PNG and stop")] = None,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """Calibrate the camera: exit 0 and camera.json when it passes, 3 with reasons when it does not."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import cv2

    from services.camera.calibration.judge import calibrate as solve_and_judge
    from services.common.errors import GoalNotReachedError

    cv2.setNumThreads(1)
    made = _board(board, square, marker, dictionary, charuco=charuco)
    if print_board is not None:
        _write(print_board, bytes(cv2.imencode(".png", made.picture())[1]))
        typer.echo(f"{print_board}: {made.columns + 1} x {made.rows + 1} squares; print it so that one is {square:g} m")
        return
    known = _known_place(mount_image, mount_board)
    limits = _limits(live=live)
    tree = loaded(config, settings, None, {"camera.source": source} if source else {}).config
    gathered = _gather(images or [], made, limits, tree.camera if live else None)
    result = solve_and_judge(gathered.pictures, made, gathered.size_px, limits)
    mount = _mounting(mount_image, known, made, result) if mount_image is not None and result.passed else None
    values = _written(result, made, limits, out, residuals, depth_scale, mount)
    _tell(result, limits, values, mount, as_json=as_json)
    if not result.passed:
        raise GoalNotReachedError(f"no calibration: {'; '.join(result.faults)}")


def _board(size: str, square_m: float, marker: float, dictionary: str, *, charuco: bool) -> Board:
    import cv2

    from services.camera.calibration.board import Board
    from services.common.errors import InputError

    parts = size.lower().split("x")
    if len(parts) != 2 or not all(p.isdecimal() for p in parts) or not all(3 <= int(p) <= 60 for p in parts):
        raise InputError(f"--board {size}: expected inner corners as COLUMNSxROWS, 3 or more each, for example 9x7")
    if charuco and not (dictionary.startswith("DICT_") and hasattr(cv2.aruco, dictionary)):
        raise InputError(f"--dictionary {dictionary}: unknown; for example DICT_5X5_100 or DICT_4X4_50")
    return Board(int(parts[0]), int(parts[1]), square_m, "charuco" if charuco else "checkerboard", marker, dictionary)


def _limits(*, live: bool) -> Limits:
    from services.camera.calibration.coverage import Needs
    from services.camera.calibration.judge import Limits

    return Limits(needs=Needs(views=_LIVE_VIEWS)) if live else Limits()


def _gather(images: list[Path], board: Board, limits: Limits, camera: Any) -> Gathered:  # noqa: ANN401 - CameraConfig, loaded late
    from services.camera.calibration.gather import from_files, from_live, image_files
    from services.common.errors import InputError

    def tell(line: str) -> None:
        typer.echo(line, err=True)

    if camera is None:
        if not images:
            raise InputError("calibrate: name pictures of the board or a folder of them, or --live")
        return from_files(image_files(images), board, limits, tell)
    if images:
        raise InputError("calibrate: --live takes its pictures from the camera; leave the others out")
    if camera.source == "sim":
        raise InputError("calibrate --live: name the camera with --source realsense (or a recording: tum: bag: mcap:)")
    from services.camera.sources import open_source

    return from_live(open_source(camera.source, camera), board, limits, most=40, tell=tell)


def _known_place(image: Path | None, text: str) -> list[float]:
    """Return the six numbers of --mount-board, degrees as radians; empty without a mounting picture."""
    import math

    from services.common.errors import InputError

    if image is None and not text:
        return []
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if image is None or len(numbers) not in (3, 6) or not all(map(math.isfinite, numbers)):
        raise InputError(
            f"--mount-board {text!r}: expected x,y,z or x,y,z,roll,pitch,yaw (m, degrees) beside --mount-image"
        )
    return numbers[:3] + [math.radians(angle) for angle in (numbers[3:] or [0.0, 0.0, 0.0])]


def _mounting(image: Path, known: list[float], board: Board, result: Result) -> Mounting:
    from services.camera.calibration.board import find_board
    from services.camera.calibration.extrinsics import board_in_body, mounting
    from services.camera.calibration.gather import read_grey
    from services.camera.codecs import FrameError
    from services.common.errors import InputError

    assert result.solution is not None
    try:
        grey = read_grey(image)
    except FrameError as error:
        raise InputError(f"{image}: {error}") from None
    if (grey.shape[1], grey.shape[0]) != result.solution.size_px:
        raise InputError(
            f"{image}: {grey.shape[1]}x{grey.shape[0]}, the calibration's pictures are {result.solution.size_px}"
        )
    sighting = find_board(grey, board)
    place = board_in_body((known[0], known[1], known[2]), (known[3], known[4], known[5]))
    solution = result.solution
    mount = None if sighting is None else mounting(sighting, board, solution.K, solution.distortion, place)
    if mount is None:
        raise InputError(f"{image}: board not found; the whole board must be seen")
    return mount


def _written(
    result: Result, board: Board, limits: Limits, out: Path, residuals: Path | None, depth_scale: float,
    mount: Mounting | None,
) -> dict[str, Any]:  # fmt: skip
    """Write the camera (only one that passes) and the residual picture; return what --json shows."""
    import datetime as dt

    import cv2

    from services.camera.calibration.picture import residual_picture
    from services.camera.calibration.report import camera_bytes, camera_values

    values: dict[str, Any] = {
        "passed": result.passed, "reasons": list(result.faults), "pictures": len(result.pictures),
        "used": 0 if result.solution is None else len(result.solution.views),
        "faults": {p.name: p.fault for p in result.pictures if p.fault},
        "covered": round(result.coverage.covered, 3),
    }  # fmt: skip
    if result.solution is None:
        return values
    camera = camera_values(result.solution, board, depth_scale, mount, day=dt.datetime.now(dt.UTC).date().isoformat())
    values |= {"reprojection_px": round(result.solution.rms_px, 4), "camera": camera}
    path = residuals or out.with_name(f"{out.stem}-residuals.png")
    picture = residual_picture(result, limits, f"{board.kind} {board.columns}x{board.rows}")
    _write(path, bytes(cv2.imencode(".png", picture)[1]))
    values["residual_picture"] = str(path)
    if result.passed:
        _write(out, camera_bytes(camera))
        values["out"] = str(out)
    return values


def _tell(result: Result, limits: Limits, values: dict[str, Any], mount: Mounting | None, *, as_json: bool) -> None:
    from services.camera.calibration.report import mount_lines, report_lines

    lines = report_lines(result, limits)
    if mount is not None:
        lines += mount_lines(mount)
    if "residual_picture" in values:
        lines.append(f"residual picture: {values['residual_picture']}")
    if result.passed:
        lines.append(
            f"PASS: {values['out']} written; process --camera, camera.camera_file and a folder's camera.json take it"
        )
    typer.echo("\n".join(lines), err=as_json)
    if as_json:
        typer.echo(json.dumps(values))


def _write(path: Path, data: bytes) -> None:
    from services.common.errors import InputError

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
