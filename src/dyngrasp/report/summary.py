"""What the terminal shows at the end of a run or a study."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from dyngrasp.trajectory import PHASE_NAMES

# Name of each criterion, its values with their formats, and what passes.
_CRITERIA = (
    ("clear", "{collisions:d} collisions", "none"),
    ("undisturbed", "{undisturbed_mm:.2f} mm", "< 3 mm"),
    ("lifted", "{lifted}", "off the ground"),
    ("held", "{held}", "to the end"),
    ("slip", "{slip_mm:.2f} mm, {slip_deg:.2f}°", "< 5 mm, 5°"),
    ("placed", "{place_mm:.2f} mm, {place_deg:.2f}°", "< 10 mm, 5°"),
    ("limits", "{limits_ratio:.3f} of limit", "≤ 1"),
    ("moving", "slowest {min_speed_ratio:.4f}", "≥ 0.01"),
)
_WORST = (
    ("position", "position, plant"),
    ("velocity", "speed, plant"),
    ("torque_planned", "torque, planned"),
    ("torque_plant", "torque, plant"),
    ("acceleration", "acceleration, planned"),
)


def run_table(summary: dict[str, Any]) -> Table:
    """The closing table of `dyngrasp run`: plan, criteria, worst ratio to each limit."""
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column(justify="right")
    table.add_column(style="dim")
    if summary["first_look"]:
        _add_look(table, summary["first_look"])
    phases = summary["phases"]
    if phases:
        table.add_row("Plan", "", "")
        for name, duration in zip(PHASE_NAMES, phases, strict=False):
            table.add_row(f"  {name}", f"{duration:.3f} s", "")
        table.add_row("  whole motion", f"{sum(phases):.3f} s", "")
        table.add_row("  planning", f"{summary['planning_ms']:.1f} ms", _attempts(summary["planning_attempts"]))
    replanning = summary.get("replanning")
    if replanning:
        published = f"{replanning['published']} of {replanning['replans']}"
        median = replanning["median_ms"]
        table.add_row("  plans replaced", published, "" if median is None else f"median {median:.1f} ms each")
        if replanning["too_uncertain"]:
            table.add_row("  updates not taken", str(replanning["too_uncertain"]), "pose too uncertain")
    criteria = summary["criteria"]
    if criteria:
        table.add_row("Criteria", "", "passes when")
        for name, pattern, rule in _CRITERIA:
            verdict = "[green]✓[/]" if criteria["passed"][name] else "[red]✗[/]"
            value = pattern.format(**{k: _words(v) for k, v in criteria.items() if k != "passed"})
            table.add_row(f"{verdict} {name}", value, rule)
    worst = summary["worst"]
    if worst:
        table.add_row("Worst ratio to limit", "", "")
        for key, label in _WORST:
            if key not in worst:
                continue
            ratio = worst[key]
            table.add_row(f"  {label}", "no limit stated" if ratio is None else f"{ratio:.3f}", "")
    if summary["tracking"]:
        tracking = summary["tracking"]
        table.add_row(
            "Tracking error",
            f"{1e3 * tracking['tracking_rms_rad']:.2f} mrad",
            f"rms; largest {1e3 * tracking['tracking_max_rad']:.2f} mrad",
        )
    return table


def _add_look(table: Table, look: dict[str, Any]) -> None:
    table.add_row("First look", f"{look['s']:.2f} s", f"{look['frames']} pictures, {look['with_markers']} with markers")
    if "deviation_mm" in look:
        table.add_row("  grasp point", f"± {look['deviation_mm']:.1f} mm", "as the filter says, one standard deviation")
        table.add_row(
            "  off by", f"{look['error_mm']:.1f} mm, {look['error_deg']:.2f}°", "which only a simulation knows"
        )


def study_table(report: dict[str, Any]) -> Table:
    """The closing table of `dyngrasp study`."""
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column(justify="right")
    table.add_column(style="dim")
    n = report["trials"]
    table.add_row("planned", f"{report['planned']} of {n}", "plans that passed the audit")
    interval = f"{100 * report['low']:.1f} to {100 * report['high']:.1f} %, 95 % (Wilson)"
    table.add_row("delivered", f"{report['delivered']} of {n}", interval)
    for name, count in report["failed_criterion"].items():
        if count:
            table.add_row(f"  failed: {name}", str(count), "")
    planning = report["planning"]
    if planning["n"]:
        table.add_row(
            "planning",
            f"{planning['median_ms']:.0f} ms",
            f"median; p99 {planning['p99_ms']:.0f}, max {planning['max_ms']:.0f} ms",
        )
    return table


def _attempts(count: int) -> str:
    return "" if count == 1 else f"{count} arm postures tried"


def _words(value: Any) -> Any:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value
