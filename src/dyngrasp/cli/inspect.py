"""`dyngrasp models` and `dyngrasp check`: what there is, and whether a file can be used."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dyngrasp.cli.arguments import BAD_INPUT, DELIVERED
from dyngrasp.errors import DyngraspError
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.models.catalogue import catalogue, check_model
from dyngrasp.models.model_file import read_toml


def models(_: argparse.Namespace) -> int:
    """List robots, grippers and objects."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("kind", "name", "description"):
        table.add_column(column)
    for row in catalogue():
        table.add_row(row.kind, f"[bold]{escape(row.name)}[/]", escape(row.description))
    Console().print(table)
    return DELIVERED


def check(options: argparse.Namespace) -> int:
    """Validate files one after the other; all are looked at, even after an error."""
    console, errors = Console(), Console(stderr=True)
    bad = False
    for name in options.files:
        try:
            facts = _facts(Path(name))
        except DyngraspError as error:
            bad = True
            errors.print(f"[red]✗[/] {escape(' '.join(str(error).split()))}", soft_wrap=True)
            continue
        console.print(f"[green]✓[/] [bold]{escape(name)}[/]", soft_wrap=True)
        for fact in facts:
            console.print(f"    {escape(fact)}", soft_wrap=True)
    return BAD_INPUT if bad else DELIVERED


def _facts(path: Path) -> list[str]:
    # A model file says what it is; a scenario has no such key.
    if "kind" in read_toml(path):
        return list(check_model(path))
    workcell = load_workcell(load_scenario(path), path)
    task, scenario = workcell.task, workcell.scenario
    return [
        f"scenario {scenario.name!r}: {scenario.description}",
        f"{task.robot.name} ({task.robot.n} joints) with {task.gripper.name} takes {task.grasp_object.name}",
        f"planner: {scenario.planner.backend}, effort weight {scenario.planner.effort_weight:g}, "
        f"{scenario.planner.intervals} intervals a phase",
    ]
