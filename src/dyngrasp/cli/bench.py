"""`dyngrasp bench`: how long planning and replanning take, and what other solvers take on the same problems."""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console
from rich.table import Table

from dyngrasp.cli.arguments import DELIVERED
from dyngrasp.experiments.bench_plan import CASES, MOVE, PEERS, WARM, PlanBenchmark, bench_plan
from dyngrasp.experiments.bench_replan import MOVES, bench_replan
from dyngrasp.experiments.output import check_writable, write_json
from dyngrasp.experiments.provenance import machine, versions


def bench(options: argparse.Namespace) -> int:
    """Measure, print the tables, write the JSON. A benchmark is done and good whatever it found."""
    if options.benchmark == "replan":
        return _replan(options)
    if options.benchmark == "perception":
        return _perception(options)
    console = _console()
    if options.json:
        check_writable(options.json)
    against = tuple(name.strip() for name in options.against.split(",") if name.strip())
    with console.status("…") as status:
        found = bench_plan(options.trials, options.seed, tuple(options.rho), against, status.update)
    for name, words in CASES.items():
        console.print(f"[bold]{name}[/]: {words}")
    console.print(f"[bold]{WARM}[/]: after the part has moved by {100 * MOVE:g} cm, from the solution before")
    for name in found.peers:
        console.print(f"[bold]{name}[/]: {PEERS[name][0]}")
    for table in tables(found):
        console.print(table)
    if options.json:
        arguments = {"trials": options.trials, "seed": options.seed, "weights": options.rho, "against": against}
        write_json(
            options.json,
            {"benchmark": "plan", "arguments": arguments, "machine": machine(), "versions": versions()}
            | found.report(),
        )
        console.print(f"written to {options.json}")
    return DELIVERED


def _console() -> Console:
    """The terminal as it is; in a file or a pipe lines are long enough for the widest table."""
    console = Console()
    return console if console.is_terminal else Console(width=140)


def _perception(options: argparse.Namespace) -> int:
    from dyngrasp.experiments.bench_perception import bench_perception

    console = _console()
    if options.json:
        check_writable(options.json)
    resolution = (640, 480) if options.small else None
    with console.status("…") as status:
        rows = bench_perception(options.runs, options.seed, resolution, progress=status.update)
    for title, shown in (
        (f"From a picture of {rows[0]['resolution']} to a pose, one thread", [r for r in rows if "median_ms" in r]),
        ("A part at rest, against the truth", [r for r in rows if r["stage"] == "accuracy"]),
        ("Noise an axis while the hand nears, and the noise model's", [r for r in rows if r["stage"] == "noise"]),
        ("Wrong poses, and jumps of the part", [r for r in rows if r["stage"] == "outliers"]),
    ):
        hidden = {"resolution"} if "median_ms" in shown[0] else {"resolution", "stage"}
        table = Table(title=title, title_justify="left", box=None, pad_edge=False)
        for name in (name for name in shown[0] if name not in hidden):
            table.add_column(name, justify="right")
        for row in shown:
            values = (value for name, value in row.items() if name not in hidden)
            table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in values))
        console.print(table)
    if options.json:
        arguments = {"runs": options.runs, "seed": options.seed}
        document = {"benchmark": "perception", "arguments": arguments, "machine": machine(), "versions": versions()}
        write_json(options.json, document | {"rows": rows})
        console.print(f"written to {options.json}")
    return DELIVERED


def _replan(options: argparse.Namespace) -> int:
    console = _console()
    if options.json:
        check_writable(options.json)
    against = tuple(name.strip() for name in options.against.split(",") if name.strip())
    with console.status("…") as status:
        rows = bench_replan(options.cycles, options.seed, options.rho, against, status.update)
    programs = [row for row in rows if row["case"].startswith("qp_")]
    late = [row for row in rows if row["case"] == "late_moves"]
    cycles = [row for row in rows if row["solver"] == "replanner" and row["case"] != "late_moves"]
    errors = [row for row in rows if row["case"] == "end_point_error"]
    for title, shown, columns in (
        ("Quadratic program, ms", programs, ("case", "solver", "n", "solved", "active_rows", *_TIMES)),
        ("Whole cycle, ms", cycles, ("case", "n", *_TIMES, "published", "kept", "late", "published_invalid", "jumps")),
        ("Share of moves followed, by the rest of the approach", late, ("left_s", "n", *(f"{mm}_mm" for mm in MOVES))),
        ("Miss at the pre-grasp", errors, ("solver", "duration_weight", "move", "error_mm")),
    ):
        console.print(_table(title, shown, columns))
    if options.json:
        write_json(options.json, {"rows": rows, "machine": machine(), "versions": versions()})
        console.print(f"written to {options.json}")
    return DELIVERED


def tables(found: PlanBenchmark) -> list[Table]:
    """What the terminal shows."""
    shown = [
        _table("Whole plan, ms", found.stage_rows(), ("case", "weight", "stage", "ok", "n", *_TIMES)),
        _table(
            "Phases, ms",
            found.phase_rows(),
            ("case", "weight", "phase", "solver", "ok", "n", *_TIMES, "iterations", "objective", "worst_violation"),
        ),
        _table("Growth, ms", list(found.growth), ("joints", "intervals", "ok", "n", *_TIMES, "iterations")),
    ]
    if found.peers:
        columns = ("both", "only_ours", "only_theirs", "same", "better", "worse", "speedup")
        shown.insert(2, _table("Against peers", found.comparison_rows(), ("case", "weight", "phase", "peer", *columns)))
    return shown


_TIMES = ("median_ms", "p99_ms", "max_ms")


def _table(title: str, rows: list[dict[str, Any]], columns: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in columns:
        words = name.removesuffix("_ms").replace("weight", "ρ").replace("_", " ")
        table.add_column(words, justify="left" if isinstance(rows[0][name], str) else "right")
    for row in rows:
        table.add_row(*(_text(name, row[name]) for name in columns))
    return table


def _text(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name.endswith("_ms"):
        return f"{value:.3f}" if value < 1 else f"{value:.2f}"
    if name == "left_s":
        return f"{value:.2f} s"
    if name.endswith("_mm") and name != "error_mm":
        return f"{100 * value:.0f} %"
    if name == "error_mm":
        return f"{value:.2g}"
    if name == "objective":
        return f"{value:.5f}"
    if name == "worst_violation":
        return f"{value:.1e}"
    return f"{value:g}" if name in ("weight", "iterations") else f"{value:.0f}"
