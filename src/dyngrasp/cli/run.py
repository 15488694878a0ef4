"""`dyngrasp run` and `dyngrasp plan`: one trial, in physics or on paper."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dyngrasp.cli.arguments import DELIVERED, NOT_DELIVERED
from dyngrasp.closed_loop.first_look import FirstLook
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import RenderingUnavailable
from dyngrasp.experiments.draws import Trial, draw_trial
from dyngrasp.experiments.output import OutputFolder, atomic, check_writable, write_json
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.trial import (
    ExecutedTrial,
    PlannedTrial,
    episode_meta,
    execute_trial,
    plan_trial,
    planner_for,
)
from dyngrasp.experiments.trial_summary import summary
from dyngrasp.experiments.trial_world import TrialWorld, first_look, trial_world
from dyngrasp.experiments.vision_files import write_pictures
from dyngrasp.experiments.workcell import Workcell, load_workcell
from dyngrasp.report.summary import run_table


def run(options: argparse.Namespace) -> int:
    """Plan, carry out, judge, and write what happened."""
    console = Console()
    workcell, trial = _prepare(options)
    folder = options.out or Path("out") / workcell.scenario.name
    with OutputFolder(folder) as out:
        _announce(console, workcell, trial)
        done = _carry_out(console, workcell, trial)
        document = summary(workcell, trial, done.look, done.planned, done.executed, done.vision)
        _write(console, workcell, done, document, out, options.video)
        console.print()
        console.print(run_table(document))
        console.print()
        if document["success"]:
            console.print(f"[bold green]delivered[/]; results in {escape(str(folder))}")
            return DELIVERED
        console.print(f"[bold red]not delivered[/]: {escape(document['cause'])}; results in {escape(str(folder))}")
        return NOT_DELIVERED


def plan(options: argparse.Namespace) -> int:
    """Plan only and write the plan."""
    console = Console()
    workcell, trial = _prepare(options)
    check_writable(options.out)
    _announce(console, workcell, trial)
    with trial_world(workcell, trial) as world:
        look = _look(console, workcell, world)
    planned = _plan(console, workcell, trial, look) if _found(look) else None
    document = summary(workcell, trial, look, planned, None, world.vision())
    if planned is None or not planned.result.ok:
        console.print(f"[bold red]no valid plan[/]: {escape(document['cause'])}")
        return NOT_DELIVERED
    with atomic(options.out) as temporary:
        planned.result.require().save(temporary)
    console.print(run_table(document))
    console.print(f"plan in {escape(str(options.out))}")
    return DELIVERED


@dataclass(frozen=True)
class _Done:
    """What a trial got to: the first look, a plan, an execution; and what the camera saw on the way."""

    look: FirstLook | None
    planned: PlannedTrial | None
    executed: ExecutedTrial | None
    vision: VisionRecord | None


def _carry_out(console: Console, workcell: Workcell, trial: Trial) -> _Done:
    with trial_world(workcell, trial) as world:
        look = _look(console, workcell, world)
        planned = executed = None
        if _found(look):
            planned = _plan(console, workcell, trial, look)
        if planned is not None and planned.result.ok:
            with _bar(console, "physics", planned.result.require().end_time) as advance:
                executed = execute_trial(
                    workcell, trial, planned, lambda t, phase: advance(t, f"physics: {phase}"), world=world
                )
        return _Done(look, planned, executed, world.vision(episode_meta(workcell, trial)))


def _look(console: Console, workcell: Workcell, world: TrialWorld) -> FirstLook | None:
    with _bar(console, "first look", workcell.scenario.camera.look_s) as advance:
        look = first_look(workcell, world, lambda t, label: advance(t, f"physics: {label}"))
    if look is not None and look.estimate is not None:
        console.print(f"part found in {look.ended - look.began:.2f} s, known to ± {1e3 * look.deviation:.1f} mm")
    return look


def _found(look: FirstLook | None) -> bool:
    """Whether there is something to plan for: what a look found, or, without one, what the trial is told."""
    return look is None or look.estimate is not None


def _prepare(options: argparse.Namespace) -> tuple[Workcell, Trial]:
    scenario = load_scenario(options.scenario, options.overrides)
    workcell = load_workcell(scenario, options.scenario)
    return workcell, draw_trial(workcell, scenario.seed if options.seed is None else options.seed)


def _announce(console: Console, workcell: Workcell, trial: Trial) -> None:
    scenario, task, T = workcell.scenario, workcell.task, trial.T_world_object
    yaw = np.rad2deg(np.arctan2(T.rotation[1, 0], T.rotation[0, 0]))
    console.print(
        f"[bold]{escape(scenario.name)}[/]: {task.robot.name} with {task.gripper.name} takes {task.grasp_object.name}"
    )
    x, y, _ = T.translation
    console.print(f"part at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.0f}°; seed {trial.seed}")


def _plan(console: Console, workcell: Workcell, trial: Trial, look: FirstLook | None) -> PlannedTrial:
    planner = planner_for(workcell)
    with console.status("planning"):
        first = plan_trial(workcell, trial, planner, look)
        if not first.result.ok:
            return first
        # The first plan of a process loads compiled code. What planning takes is what it takes from then on.
        planned = plan_trial(workcell, trial, planner, look)
    console.print(
        f"planned in {planned.planning_ms:.1f} ms (the first time, with compiled code to load, {first.planning_ms:.0f} "
        "ms); every constraint of the audit holds"
    )
    return planned


def _write(console: Console, workcell: Workcell, done: _Done, document: dict, out: OutputFolder, video: bool) -> None:
    write_json(out / "summary.json", document)
    planned, executed = done.planned, done.executed
    if planned is not None and planned.result.plan is not None:
        with atomic(out / "plan.json") as temporary:
            planned.result.plan.save(temporary)
    if done.vision is not None:
        _vision(console, done.vision, out)
    if planned is None or executed is None:
        return
    with atomic(out / "record.npz") as temporary:
        executed.record.save(temporary)
    _figure(workcell, planned, executed, document, out)
    if video and workcell.scenario.render.video:
        _video(console, workcell, executed, out)


def _vision(console: Console, vision: VisionRecord, out: OutputFolder) -> None:
    with atomic(out / "vision.npz") as temporary:
        vision.save(temporary)
    words = f"detections and estimates of {len(vision.reports)} pictures in {escape(str(out / 'vision.npz'))}"
    if vision.pictures:
        folder = OutputFolder(out / "pictures")
        size = write_pictures(vision, folder)
        words += f", {len(vision.pictures)} of the pictures in {escape(str(folder.path))} ({1e-6 * size:.1f} MB)"
    console.print(words)


def _figure(
    workcell: Workcell, planned: PlannedTrial, executed: ExecutedTrial, document: dict, out: OutputFolder
) -> None:
    from dyngrasp.report.episode_figures import episode_figure
    from dyngrasp.report.figures import save_figure

    verdict = "delivered" if document["success"] else "not delivered"
    title = f"{workcell.scenario.name} · seed {document['seed']} · {verdict}"
    first = planned.result.require()
    figure = episode_figure(workcell.task, planned.targets, first, executed.record, title, executed.plan)
    save_figure(figure, out / "trajectory.png")


def _video(console: Console, workcell: Workcell, executed: ExecutedTrial, out: OutputFolder) -> None:
    from dyngrasp.report.camera_inset import CameraInset
    from dyngrasp.report.video import write_video
    from dyngrasp.simulation.rendering import Renderer

    render, record = workcell.scenario.render, executed.record
    times = np.arange(record.t[0], record.t[-1], 1.0 / render.frames_per_second)
    inset = None if executed.vision is None else CameraInset(executed.vision, render.width)
    try:
        with (
            Renderer(executed.scene, width=render.width, height=render.height) as renderer,
            _bar(console, "video", len(times)) as advance,
        ):

            def frames() -> Iterator[np.ndarray]:
                for i, t in enumerate(times):
                    advance(i, "video")
                    frame = renderer.frame(record.scene_state[record.index_at(t)])
                    yield frame if inset is None else inset.over(frame, t)

            write_video(out / "episode.mp4", frames(), render.frames_per_second)
    except RenderingUnavailable as error:
        console.print(f"no video: {escape(str(error))}")


@contextmanager
def _bar(console: Console, label: str, total: float) -> Iterator[Callable[[float, str], None]]:
    """A progress bar on a terminal, one line for each new label elsewhere."""
    if not console.is_terminal:
        seen: set[str] = set()

        def line(_: float, text: str) -> None:
            if text not in seen:
                seen.add(text)
                console.print(text)

        yield line
        return
    columns = (TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done, text: bar.update(task, completed=done, description=text)
