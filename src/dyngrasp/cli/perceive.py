"""`dyngrasp perceive`: poses of the part from a folder of pictures."""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
import pinocchio as pin
from rich.console import Console
from rich.markup import escape

from dyngrasp.cli.arguments import DELIVERED, NOT_DELIVERED
from dyngrasp.experiments.output import atomic, check_writable
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.vision_files import deviations, perceive, pose_table
from dyngrasp.experiments.workcell import load_workcell


def perceive_folder(options: argparse.Namespace) -> int:
    """Work out every picture, write one row for each, and say where the part is in the end."""
    console = Console()
    workcell = load_workcell(load_scenario(options.scenario, options.overrides), options.scenario)
    check_writable(options.out)
    with console.status("looking"):
        seen = perceive(workcell, options.folder)
    with atomic(options.out) as temporary:
        temporary.write_text(pose_table(seen), encoding="utf-8")
    reports = [report for _, report in seen]
    verdicts = Counter(report.verdict.value for report in reports if report.verdict is not None)
    words = ", ".join(f"{count} {name}" for name, count in verdicts.items()) or "none with a pose"
    console.print(f"{len(reports)} pictures: {words}; rows in {escape(options.out)}")
    last = reports[-1]
    if last.estimate is None:
        console.print("[bold red]not found[/]: too few pictures in a row agree on a pose")
        return NOT_DELIVERED
    T = last.estimate.T_world_object
    x, y, z = T.translation
    roll, pitch, yaw = np.rad2deg(pin.rpy.matrixToRpy(T.rotation))
    position, turn = deviations(last)
    console.print(
        f"[bold]{escape(workcell.task.grasp_object.name)}[/] at {last.estimate.t_capture:.3f} s: "
        f"x {x:.4f} m, y {y:.4f} m, z {z:.4f} m; roll {roll:.2f}°, pitch {pitch:.2f}°, yaw {yaw:.2f}° "
        f"(± {1e3 * position:.1f} mm, ± {np.rad2deg(turn):.2f}°)"
    )
    return DELIVERED
