"""`dyngrasp calibrate`: the camera's lens and mount from pictures of a board; the board; pictures to try it on."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dyngrasp.cli.arguments import DELIVERED, NOT_DELIVERED
from dyngrasp.errors import InputFileError
from dyngrasp.experiments.camera_calibration import (
    LensFound,
    LookedAt,
    lens_difference,
    lens_from_folder,
    mount_difference,
    mount_from_folder,
    outliers,
    require_new_file,
    write_camera,
)
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.catalogue import load_camera, load_gripper, load_robot
from dyngrasp.perception.calibration import Board

# Below these a lens extrapolates: share of the picture that the board has been in, and tilt of the board (rad).
LEAST_COVERED, LEAST_TILT = 0.6, np.deg2rad(25.0)

# Above it, something other than noise is at work: a bent board, wrong measures, a moving camera (pixels).
LARGEST_ERROR = 0.5

# Above it, what was found is of no use: pictures and postures, or pictures and board, do not belong together (pixels).
WORTHLESS = 5.0


def calibrate(options: argparse.Namespace) -> int:
    """Do what was asked for; every file it writes is a new one."""
    # In a file or a pipe, lines as wide as the widest sentence.
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    board = Board(options.columns, options.rows, options.square, options.marker, options.dictionary)
    commands = {"camera": _lens, "handeye": _mount, "board": _board, "render": _render}
    return commands[options.what](options, board, console)


def _lens(options: argparse.Namespace, board: Board, console: Console) -> int:
    require_new_file(options.out)
    start = _camera(options)
    against = _against(options, start)
    with console.status("looking"):
        found = lens_from_folder(options.folder, board, start)
    camera, result = found.result.camera, found.result
    (fx, fy), (dx, dy), (cx, cy) = camera.focal, result.focal_deviation, camera.centre
    _print_pictures(found.pictures, console)
    console.print(f"reprojection error [bold]{result.error:.3f} px[/] (root mean square)")
    console.print(f"focal lengths {fx:.2f} ± {dx:.2f} px, {fy:.2f} ± {dy:.2f} px; centre ({cx:.2f}, {cy:.2f}) px")
    console.print(f"distortion k1, k2, p1, p2, k3: {', '.join(f'{value:.5f}' for value in camera.distortion)}")
    console.print(
        f"the corners cover {100 * found.covered:.0f} % of the picture, tilt up to {np.rad2deg(found.tilt):.0f}°"
    )
    if against is not None:
        console.print(
            f"against {escape(options.against)}: the lens shows points up to "
            f"{lens_difference(camera, against):.2f} px away"
        )
    used = _used(found.pictures)
    remarks = [
        f"Lens from {used} views of a ChArUco board: reprojection error {result.error:.3f} px,",
        f"focal lengths ± {dx:.2f} and {dy:.2f} px. The mount is that of the file it began with.",
    ]
    write_camera(options.out, camera, remarks)
    console.print(f"written to {escape(options.out)}")
    for advice in _lens_advice(found):
        console.print(f"[yellow]note[/]: {advice}")
    if result.error > WORTHLESS:
        return _worthless(console)
    console.print(
        f"next: [bold]dyngrasp calibrate handeye FOLDER --camera {escape(options.out)}[/] "
        "(the mount in this file is still the old one)"
    )
    return DELIVERED


def _mount(options: argparse.Namespace, board: Board, console: Console) -> int:
    require_new_file(options.out)
    camera = load_camera(options.camera)
    against = _against(options, camera)
    robot, gripper = load_robot(options.robot), load_gripper(options.gripper)
    with console.status("looking"):
        found = mount_from_folder(options.folder, board, camera, robot, gripper)
    result = found.result
    _print_pictures(found.pictures, console)
    console.print(f"reprojection error [bold]{result.error:.3f} px[/] (root mean square; the arm's errors count in it)")
    x, y, z = 1e3 * result.T_hand_camera.translation
    both = np.hypot(result.deviation, result.lens_deviation)
    shift, turn = 1e3 * float(np.linalg.norm(both[:3])), float(np.rad2deg(np.linalg.norm(both[3:])))
    alone = 1e3 * float(np.linalg.norm(result.deviation[:3])), np.rad2deg(np.linalg.norm(result.deviation[3:]))
    console.print(f"mount in the hand frame: x {x:.2f} mm, y {y:.2f} mm, z {z:.2f} mm; ± {shift:.2f} mm, ± {turn:.3f}°")
    console.print(
        f"  of that with an exact lens ± {alone[0]:.2f} mm, ± {alone[1]:.3f}°; the rest is what the lens leaves open"
    )
    moved, turned = mount_difference(camera, found.camera)
    console.print(f"  {1e3 * moved:.2f} mm and {np.rad2deg(turned):.3f}° from that of {escape(options.camera)}")
    bx, by, bz = 1e3 * result.T_world_board.translation
    console.print(f"board's corner in the arm's base frame: x {bx:.1f} mm, y {by:.1f} mm, z {bz:.1f} mm")
    if against is not None:
        off, angle = mount_difference(found.camera, against)
        console.print(
            f"against {escape(options.against)}: the mount is {1e3 * off:.2f} mm and {np.rad2deg(angle):.3f}° away"
        )
    remarks = [
        f"Mount from {_used(found.pictures)} views of a ChArUco board with {robot.name} and {gripper.name}:",
        f"reprojection error {result.error:.3f} px, mount ± {shift:.2f} mm and ± {turn:.3f}°.",
    ]
    write_camera(options.out, found.camera, remarks)
    console.print(f"written to {escape(options.out)}")
    for advice in _advice(found.pictures, result.error):
        console.print(f"[yellow]note[/]: {advice}")
    if result.error > WORTHLESS:
        return _worthless(console)
    console.print(
        "next: measure where the board's corner is and compare; then "
        f"[bold]dyngrasp run SCENARIO --pose camera --set camera.model={escape(options.out)}[/]"
    )
    return DELIVERED


def _board(options: argparse.Namespace, board: Board, console: Console) -> int:
    from dyngrasp.experiments.output import OutputError, atomic
    from dyngrasp.perception.board_pictures import board_svg

    if Path(options.out).suffix.lower() != ".svg":
        raise OutputError(
            options.out, "a name that ends in .svg expected: only such a drawing has a size in millimetres"
        )
    require_new_file(options.out)
    with atomic(options.out) as temporary:
        temporary.write_text(board_svg(board), encoding="utf-8")
    console.print(
        f"{board.columns} x {board.rows} squares of {1e3 * board.square:g} mm, markers of {1e3 * board.marker:g} mm "
        f"({board.dictionary}), written to {escape(options.out)}"
    )
    console.print("next: print it at 100 %, glue it to something flat, and measure it over several squares;")
    console.print("if they are not that wide, say so to the other commands with --square-mm and --marker-mm")
    return DELIVERED


def _render(options: argparse.Namespace, board: Board, console: Console) -> int:
    from dyngrasp.experiments.filmed_board import TRUTH, write_board_film
    from dyngrasp.simulation.camera_sensor import ImagingSettings

    camera = _camera(options)
    settings = ImagingSettings(seed=options.seed, noise=options.noise)
    with console.status("…") as status:
        true = write_board_film(
            options.folder, camera, board, options.views, options.seed, settings,
            lambda done: status.update(f"{done} of {options.views} pictures"),
        )  # fmt: skip
    moved, turned = mount_difference(camera, true)
    folder = escape(options.folder)
    console.print(f"{options.views} pictures and frames.csv in {folder}")
    console.print(
        f"the camera that took them is in {folder}/{TRUTH}: its lens differs from {escape(camera.name)}'s by up to "
        f"{lens_difference(camera, true):.1f} px, its mount by {1e3 * moved:.1f} mm and {np.rad2deg(turned):.2f}°"
    )
    console.print(f"next: [bold]dyngrasp calibrate camera {folder} --out lens.toml[/]")
    return DELIVERED


def _worthless(console: Console) -> int:
    console.print(f"[bold red]not calibrated[/]: above {WORTHLESS:g} px the numbers mean nothing")
    return NOT_DELIVERED


def _camera(options: argparse.Namespace) -> CameraModel:
    camera = load_camera(options.camera)
    if options.size is None:
        return camera
    return camera.scaled(*options.size)


def _against(options: argparse.Namespace, camera: CameraModel) -> CameraModel | None:
    if options.against is None:
        return None
    other = load_camera(options.against)
    if (other.width, other.height) != (camera.width, camera.height):
        raise InputFileError(
            options.against, "sensor", f"{other.width} x {other.height}",
            f"pictures of {camera.width} x {camera.height}, as the camera that is calibrated takes them",
        )  # fmt: skip
    return other


def _used(pictures: Sequence[LookedAt]) -> int:
    return sum(picture.left_out is None for picture in pictures)


def _print_pictures(pictures: Sequence[LookedAt], console: Console) -> None:
    bad = set(outliers(pictures))
    table = Table("picture", "corners", "error (px)", "", box=None, pad_edge=False)
    for picture in pictures:
        error = "" if picture.error is None else f"{picture.error:.3f}"
        words = f"[red]left out[/]: {picture.left_out}" if picture.left_out else ""
        if picture in bad:
            words = "[yellow]stands out[/]"
        table.add_row(escape(picture.path.name), str(len(picture.view.ids)), error, words)
    console.print(table)
    used = _used(pictures)
    console.print(f"{used} of {len(pictures)} views used, {len(pictures) - used} left out")


def _lens_advice(found: LensFound) -> list[str]:
    advice = _advice(found.pictures, found.result.error)
    if found.covered < LEAST_COVERED:
        advice.append(
            f"the corners cover only {100 * found.covered:.0f} % of the picture: towards its edge the lens is a guess; "
            "add views with the board in each corner of the picture"
        )
    if found.tilt < LEAST_TILT:
        advice.append(
            f"the board was tilted by at most {np.rad2deg(found.tilt):.0f}°: focal length and distance are hard to "
            "tell apart; add views with 30° to 50°"
        )
    return advice


def _advice(pictures: Sequence[LookedAt], error: float) -> list[str]:
    advice = []
    if bad := outliers(pictures):
        names = ", ".join(escape(picture.path.name) for picture in bad)
        advice.append(
            f"{names}: blurred, or the row of another picture; take away and repeat, the others will fit better"
        )
    if error > LARGEST_ERROR:
        advice.append(
            f"{error:.2f} px is more than detection explains ({LARGEST_ERROR} px): is the board flat and as wide as "
            "stated, did it lie still, are the postures those of the pictures, is the lens calibrated?"
        )
    if _used(pictures) < 15:
        advice.append(f"{_used(pictures)} views are few: 20 or more make the deviations small and reliable")
    return advice
