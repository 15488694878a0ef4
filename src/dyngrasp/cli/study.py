"""`dyngrasp study`: many seeded trials in local processes."""

from __future__ import annotations

import argparse
import sys

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dyngrasp.cli.arguments import DELIVERED, INTERRUPTED
from dyngrasp.experiments.monte_carlo import Study, run_study
from dyngrasp.experiments.output import OutputFolder, check_writable, write_json
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.report.summary import study_table


def study(options: argparse.Namespace) -> int:
    """Run the trials, show progress, write the table and a summary. A study is done and good whatever it found."""
    console = Console()
    scenario = load_scenario(options.scenario, options.overrides)
    seed = scenario.seed if options.seed is None else options.seed
    if options.json:
        check_writable(options.json)
    with OutputFolder(options.out) as out:
        console.print(f"[bold]{escape(scenario.name)}[/]: {options.trials} trials, seed {seed}")
        try:
            finished = _run(console, options, scenario, seed)
        except KeyboardInterrupt as interrupt:
            finished = interrupt.args[0] if interrupt.args else None
            if finished is not None and finished.rows:
                _write(finished, out, options.json)
                console.print(f"interrupted; {len(finished.rows)} finished trials are in {escape(options.out)}")
            else:
                print("dyngrasp: interrupted before the first trial was finished", file=sys.stderr)
            return INTERRUPTED
        _write(finished, out, options.json)
    report = finished.report()
    console.print(study_table(report))
    for failure in report["causes"][:20]:
        console.print(f"  seed {failure['seed']}: {escape(failure['cause'])}", style="dim")
    if len(report["causes"]) > 20:
        console.print(f"  … and {len(report['causes']) - 20} more in study.json", style="dim")
    console.print(f"rows in {escape(str(out / 'trials.parquet'))}")
    return DELIVERED


def _run(console: Console, options: argparse.Namespace, scenario, seed: int) -> Study:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    plain_step = max(1, options.trials // 10)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("delivered 0", total=options.trials)

        def show(so_far: Study) -> None:
            done, delivered = len(so_far.rows), so_far.delivered.successes
            bar.update(task, completed=done, description=f"delivered {delivered}")
            if not console.is_terminal and (done % plain_step == 0 or done == options.trials):
                console.print(f"{done} of {options.trials} trials, delivered {delivered}")

        return run_study(
            scenario, options.scenario, trials=options.trials, seed=seed, workers=options.workers, progress=show
        )


def _write(finished: Study, out: OutputFolder, json_file: str | None) -> None:
    finished.write_parquet(out / "trials.parquet")
    report = {**finished.report(), "machine": machine(), "versions": versions()}
    report["resolved_scenario"] = finished.scenario.model_dump(mode="json")
    write_json(out / "study.json", report)
    if json_file:
        write_json(json_file, {"rows": finished.ordered, "machine": machine(), "versions": versions()})
