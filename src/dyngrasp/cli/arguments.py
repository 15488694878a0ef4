"""What the commands take; imports nothing heavy, so that `--help` answers at once."""

from __future__ import annotations

import argparse
from typing import Any

DELIVERED, NOT_DELIVERED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: done and good, done and not good, bad input or usage, interrupted."""

_SCENARIO = "a scenario file (TOML)"
_SEED = "draws where the part lies and how the plant deviates; default: the scenario's own seed"
_no_replan: dict[str, Any] = {
    "action": "append_const",
    "const": "replanner.enabled=false",
    "dest": "overrides",
    "default": [],
    "help": "keep the first plan whatever becomes known of the pose, for comparison",
}
_POSES = {
    "camera": ("pose.source=camera", "replanner.enabled=true"),
    "noise": ("pose.source=noise",),
    "truth": (
        "pose.source=truth",
        *(f"pose.{key}=0" for key in ("position_mm", "rotation_deg", "along_mm", "across_mm", "up_mm")),
    ),
}
# As `models.grasp_object.MARKER_DICTIONARIES`, which would be slow to import; a test compares them.
DICTIONARIES = ("4x4_50", "5x5_50", "6x6_50", "apriltag_36h11")
_SET = "override a key of the scenario, e.g. --set part.yaw_deg=30; may be repeated"


class _Pose(argparse.Action):
    """`--pose`: overrides that come before all others, so that `--set` and `--no-replan` have the last word."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: str | None = None
    ) -> None:
        namespace.overrides = [*_POSES[values], *namespace.overrides]


_pose: dict[str, Any] = {
    "action": _Pose,
    "choices": tuple(_POSES),
    "dest": "overrides",
    "default": [],
    "help": "where the pose of the part comes from: pictures of the camera on the hand, from a first look on, which "
    "has to see the part from task.start_deg (table [camera], defaults without one); a noise model; or the truth, "
    "without the scenario's errors. Short for --set pose.source=…",
}


def argument_parser(version: str) -> argparse.ArgumentParser:
    """The parser of all commands; `command` holds the chosen one."""
    parser = argparse.ArgumentParser(
        prog="dyngrasp",
        description="Plan dynamic grasps, carry them out in physics, and measure them.",
        epilog="Exit status: 0 done and good, 1 done and not good (part not delivered), 2 bad input, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"dyngrasp {version}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="plan a grasp and carry it out in physics")
    run.add_argument("scenario", metavar="SCENARIO", help=_SCENARIO)
    run.add_argument("--out", metavar="DIR", help="where the results go; default: out/<name of the scenario>")
    run.add_argument("--seed", type=_seed, metavar="S", help=_SEED)
    run.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=_SET)
    run.add_argument("--pose", **_pose)
    run.add_argument("--no-replan", **_no_replan)
    run.add_argument("--no-video", action="store_false", dest="video", help="do not render")

    plan = commands.add_parser("plan", help="plan only and write the plan")
    plan.add_argument("scenario", metavar="SCENARIO", help=_SCENARIO)
    plan.add_argument("--out", metavar="FILE", default="plan.json", help="where the plan goes; default: plan.json")
    plan.add_argument("--seed", type=_seed, metavar="S", help=_SEED)
    plan.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=_SET)

    study = commands.add_parser("study", help="run many seeded trials in local processes")
    study.add_argument("scenario", metavar="SCENARIO", help=_SCENARIO)
    study.add_argument("--trials", type=_count, metavar="N", required=True, help="number of trials")
    study.add_argument("--seed", type=_seed, metavar="S", help="every trial's own seed is drawn from this one")
    study.add_argument("--out", metavar="DIR", required=True, help="where trials.parquet and study.json go")
    study.add_argument("--pose", **_pose)
    study.add_argument("--no-replan", **_no_replan)
    study.add_argument("--workers", type=_count, metavar="W", help="processes; default: one a core")
    study.add_argument("--json", metavar="FILE", help="write the rows also as JSON, with machine and versions")
    study.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=_SET)

    perceive = commands.add_parser("perceive", help="find the part in a folder of pictures")
    perceive.add_argument("scenario", metavar="SCENARIO", help=f"{_SCENARIO}; names arm, hand, part and camera")
    perceive.add_argument(
        "folder",
        metavar="FOLDER",
        help="pictures and frames.csv with times and joint angles, as `dyngrasp run` keeps them",
    )
    perceive.add_argument("--out", metavar="FILE", default="poses.csv", help="where the poses go; default: poses.csv")
    perceive.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=_SET)

    _add_calibrate(commands)

    bench = commands.add_parser("bench", help="measure how long planning takes")
    benchmarks = bench.add_subparsers(dest="benchmark", required=True, metavar="WHAT")
    bench_plan = benchmarks.add_parser("plan", help="whole plans and their phases, against other solvers")
    bench_plan.add_argument("--trials", type=_count, metavar="N", default=200, help="poses of each case; default: 200")
    bench_plan.add_argument("--seed", type=_seed, metavar="S", default=0, help="draws poses and postures; default: 0")
    bench_plan.add_argument(
        "--rho", type=_weight, nargs="+", metavar="W", default=[1.0, 1e-3], help="effort weights; default: 1 1e-3"
    )
    bench_plan.add_argument("--against", metavar="NAMES", default="", help="other solvers, e.g. ipopt")
    bench_plan.add_argument("--json", metavar="FILE", help="write all figures, with machine and versions")
    bench_replan = benchmarks.add_parser("replan", help="the online program, whole cycles, and the paper's update")
    bench_replan.add_argument("--cycles", type=_count, metavar="N", default=1000, help="of each kind; default: 1000")
    bench_replan.add_argument("--seed", type=_seed, metavar="S", default=0, help="draws splices and moves; default: 0")
    bench_replan.add_argument("--rho", type=_weight, metavar="W", default=1.0, help="effort weight; default: 1")
    bench_replan.add_argument(
        "--against", metavar="NAMES", default="", help="general solvers: ipopt, osqp, piqp, piqp_multistage, clarabel"
    )
    bench_replan.add_argument("--json", metavar="FILE", help="write all rows, with machine and versions")
    bench_perception = benchmarks.add_parser("perception", help="from pictures to poses: times and accuracy")
    bench_perception.add_argument(
        "--runs", type=_count, metavar="N", default=3, help="a distance and angle; default: 3"
    )
    bench_perception.add_argument(
        "--seed", type=_seed, metavar="S", default=0, help="draws views and noise; default: 0"
    )
    bench_perception.add_argument("--small", action="store_true", help="pictures of 640 x 480 in place of 1024 x 1024")
    bench_perception.add_argument("--json", metavar="FILE", help="write all rows, with machine and versions")

    commands.add_parser("models", help="list robots, grippers and objects")

    check = commands.add_parser("check", help="validate model and scenario files")
    check.add_argument("files", nargs="+", metavar="FILE", help="a model.toml or a scenario file")
    return parser


def _add_calibrate(commands: Any) -> None:
    board = argparse.ArgumentParser(add_help=False)
    geometry = board.add_argument_group("board (ChArUco)")
    geometry.add_argument(
        "--columns", type=_count, metavar="N", default=8, help="squares from left to right; default: 8"
    )
    geometry.add_argument("--rows", type=_count, metavar="N", default=6, help="squares from top to bottom; default: 6")
    geometry.add_argument(
        "--square-mm", type=_millimetres, metavar="MM", dest="square", default=0.030,
        help="edge of a square, as measured; default: 30",
    )  # fmt: skip
    geometry.add_argument(
        "--marker-mm", type=_millimetres, metavar="MM", dest="marker", default=0.022,
        help="edge of a marker; default: 22",
    )  # fmt: skip
    geometry.add_argument(
        "--dictionary", choices=DICTIONARIES, default="5x5_50", help="family of the markers; default: 5x5_50"
    )
    start = "camera file or name to begin with: size of the pictures, rough focal lengths; default: ava1000"
    size: dict[str, Any] = {
        "type": _pixels,
        "nargs": 2,
        "metavar": ("WIDTH", "HEIGHT"),
        "help": "of the pictures, if not the camera file's",
    }
    out = "the camera file to write; there must be none of that name yet"
    against = "a camera file to compare with, e.g. of the last calibration"

    calibrate = commands.add_parser("calibrate", help="find the camera's lens and its place on the hand")
    things = calibrate.add_subparsers(dest="what", required=True, metavar="WHAT")
    lens = things.add_parser("camera", parents=[board], help="the lens, from a folder of pictures of the board")
    lens.add_argument("folder", metavar="FOLDER", help="PNG or JPEG pictures of the board, at least 5, better 20")
    lens.add_argument("--camera", metavar="FILE", default="ava1000", help=start)
    lens.add_argument("--size", **size)
    lens.add_argument("--out", metavar="FILE", required=True, help=out)
    lens.add_argument("--against", metavar="FILE", help=against)
    mount = things.add_parser("handeye", parents=[board], help="the mount, from pictures and the arm's postures")
    mount.add_argument(
        "folder",
        metavar="FOLDER",
        help="pictures, and frames.csv with columns picture and NAME_rad or NAME_deg a joint",
    )
    mount.add_argument("--camera", metavar="FILE", required=True, help="camera file with the calibrated lens")
    mount.add_argument("--robot", metavar="NAME", default="iiwa14", help="name or model.toml; default: iiwa14")
    mount.add_argument("--gripper", metavar="NAME", default="sdh2", help="name or model.toml; default: sdh2")
    mount.add_argument("--out", metavar="FILE", required=True, help=out)
    mount.add_argument("--against", metavar="FILE", help=against)
    drawn = things.add_parser("board", parents=[board], help="the board as a drawing to print")
    drawn.add_argument("--out", metavar="FILE", default="board.svg", help="a new SVG file; default: board.svg")
    film = things.add_parser("render", parents=[board], help="pictures of a board in the simulated cell, to try it on")
    film.add_argument("folder", metavar="FOLDER", help="for pictures, frames.csv and truth.toml; new or empty")
    film.add_argument("--views", type=_count, metavar="N", default=30, help="number of pictures; default: 30")
    film.add_argument("--seed", type=_seed, metavar="S", default=0, help="draws views, noise and camera; default: 0")
    film.add_argument(
        "--camera", metavar="FILE", default="ava1000", help="the camera as its file has it; default: ava1000"
    )
    film.add_argument("--size", **size)
    film.add_argument(
        "--noise", type=_weight, metavar="G", default=1.5, help="of the pictures (grey values of 255); default: 1.5"
    )


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"a whole number from 0 to 2**63 - 1 expected, got {text}")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"a whole number of at least 1 expected, got {text}")
    return value


def _millimetres(text: str) -> float:
    value = float(text)
    if not 0.1 <= value <= 10000.0:
        raise argparse.ArgumentTypeError(f"0.1 to 10000 mm expected, got {text}")
    return 1e-3 * value


def _pixels(text: str) -> int:
    value = int(text)
    if not 16 <= value <= 16384:
        raise argparse.ArgumentTypeError(f"16 to 16384 pixels expected, got {text}")
    return value


def _weight(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"a number of at least 0 expected, got {text}")
    return value


# argparse puts these names into its messages: "invalid whole number value: 'x'"
_seed.__name__ = _count.__name__ = _pixels.__name__ = "whole number"
_millimetres.__name__ = _weight.__name__ = "number"
