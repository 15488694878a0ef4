"""Figures for print and screen: a trajectory in the form of the paper's Figure 5, and success against pose error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, NullFormatter, PercentFormatter

from dyngrasp.experiments.output import atomic
from dyngrasp.experiments.statistics import Proportion
from dyngrasp.models.limits import JointLimits
from dyngrasp.signals import Array, read_only

# Okabe and Ito's colours, told apart with any kind of colour vision; their yellow, lost on white, gives way to wine.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#882255")
PHASE_GREY = "#e4e4e6"
INK = "#26262b"
FAINT = "#9a9aa2"

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "axes.titlesize": 10,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "mathtext.fontset": "dejavusans",
    "savefig.dpi": 200,
}


@dataclass(frozen=True)
class MotionCurves:
    """A motion of arm and gripper over time, planned or measured.

    Attributes:
        times: (K,) in s.
        position, velocity, torque: (K, n) of the arm, in rad, rad/s and Nm.
        gripper_position: (K, m) of the planned gripper joints, in rad.
    """

    times: Array
    position: Array
    velocity: Array
    torque: Array
    gripper_position: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", read_only(self.times, (-1,)))
        for name in ("position", "velocity", "torque", "gripper_position"):
            object.__setattr__(self, name, read_only(getattr(self, name), (self.times.size, -1)))


def trajectory_figure(
    planned: MotionCurves,
    measured: MotionCurves | None,
    phase_ends: Array,
    limits: JointLimits,
    gripper_range: tuple[Array, Array],
    joint_names: Sequence[str],
    gripper_joint_names: Sequence[str],
    title: str = "",
    moving_threshold: float = 0.01,
    planned_name: str = "planned",
) -> Figure:
    """Scaled positions, speeds and torques over time, in the form of the paper's Figure 5.

    Each curve is divided by its own limit, so that ±1 is the limit of every joint; ranges that are not symmetric are
    centred first. The grasp phase lies on grey, the plan is dashed, what was measured is solid. Two more panels show
    the gripper on the same clock and the criterion `moving`.

    Args:
        planned: The plan.
        measured: What the plant did; None draws the plan alone.
        phase_ends: (3,) ends of the phases (s).
        limits: Limits of the arm's n joints.
        gripper_range: Lower and upper limits (m,) of the planned gripper joints (rad).
        joint_names: n names.
        gripper_joint_names: m names.
        title: Set over the figure.
        moving_threshold: The least max-norm of q̇/q̇max that counts as moving.
        planned_name: What the legend calls the plan.
    """
    n, m = len(joint_names), len(gripper_joint_names)
    colours, gripper_colours = _colours(n), _colours(m)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.4, 7.6), layout="constrained")
        figure.get_layout_engine().set(h_pad=0.045, w_pad=0.04)  # type: ignore[union-attr]
        axes = figure.subplots(5, 1, sharex=True, height_ratios=[1.5, 1.5, 1.5, 0.9, 0.9])
        middle = (limits.position_upper + limits.position_lower) / 2
        half = (limits.position_upper - limits.position_lower) / 2
        gripper_middle = (gripper_range[1] + gripper_range[0]) / 2
        gripper_half = (gripper_range[1] - gripper_range[0]) / 2
        panels = (
            ("position", r"$q\,/\,q_{\max}$", lambda c: (c.position - middle) / half, colours),
            ("speed", r"$\dot q\,/\,\dot q_{\max}$", lambda c: c.velocity / limits.velocity, colours),
            ("torque", r"$\tau\,/\,\tau_{\max}$", lambda c: c.torque / limits.torque, colours),
            ("gripper", r"$q_h\,/\,q_{h,\max}$", lambda c: (c.gripper_position - gripper_middle) / gripper_half,
             gripper_colours),
        )  # fmt: skip
        for ax, (name, symbol, scaled, palette) in zip(axes, panels, strict=False):
            _draw(ax, planned, measured, scaled, palette)
            _scaled_axis(ax, f"{name}\n{symbol}", scaled(planned), None if measured is None else scaled(measured))
        _moving_panel(axes[4], planned, measured, limits, moving_threshold)
        for ax in axes:
            ax.axvspan(phase_ends[0], phase_ends[1], color=PHASE_GREY, zorder=0, lw=0)
        end = max(planned.times[-1], measured.times[-1] if measured is not None else 0.0)
        axes[-1].set_xlim(planned.times[0], end)
        axes[-1].set_xlabel("time (s)")
        _name_phases(axes[0], np.concatenate([[planned.times[0]], phase_ends]))
        figure.align_ylabels(axes)
        motions = (planned_name,) if measured is None else (planned_name, "measured")
        _legends(axes, joint_names, colours, gripper_joint_names, gripper_colours, motions)
        if title:
            figure.suptitle(title, x=0.02, ha="left", fontsize=10.5, fontweight="bold", color=INK)
    return figure


@dataclass(frozen=True)
class ErrorCurve:
    """Shares of success at several magnitudes of an error.

    Attributes:
        label: What the curve is, for the legend.
        magnitude: (k,) magnitudes.
        outcomes: k proportions with their intervals.
    """

    label: str
    magnitude: tuple[float, ...]
    outcomes: tuple[Proportion, ...]


def error_curve_figure(
    curves: Sequence[ErrorCurve], x_label: str = "error of the pose (mm)", title: str = ""
) -> Figure:
    """Share of delivered parts against the error of the pose, with Wilson 95 % intervals.

    Args:
        curves: One a direction or a method.
        x_label: What the magnitudes are.
        title: Set over the figure.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.4), layout="constrained")
        ax = figure.subplots()
        magnitudes = sorted({x for curve in curves for x in curve.magnitude})
        span = (magnitudes[-1] - magnitudes[0]) or 1.0
        for i, (curve, colour) in enumerate(zip(curves, _colours(len(curves)), strict=True)):
            # Curves that coincide stay readable: each stands a little beside the magnitude it belongs to.
            x = np.array(curve.magnitude) + 0.008 * span * (i - (len(curves) - 1) / 2)
            share = np.array([outcome.share for outcome in curve.outcomes])
            low = share - np.array([outcome.low for outcome in curve.outcomes])
            high = np.array([outcome.high for outcome in curve.outcomes]) - share
            ax.errorbar(x, share, yerr=np.clip([low, high], 0.0, None), color=colour, marker="o", ms=4.5, lw=1.5,
                        capsize=2.5, elinewidth=1.0, markeredgecolor="white", markeredgewidth=0.7, clip_on=False,
                        zorder=3, label=curve.label)  # fmt: skip
        ax.set_ylim(0.0, 1.0)
        ax.set_xticks(magnitudes)
        ax.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        ax.grid(axis="y", color="#ededf0", lw=0.7, zorder=0)
        ax.set_xlabel(x_label)
        ax.set_ylabel("delivered by every criterion")
        trials = sorted({outcome.trials for curve in curves for outcome in curve.outcomes})
        count = f"{trials[0]}" if len(trials) == 1 else f"{trials[0]} to {trials[-1]}"
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), alignment="left",
                  title=f"{count} trials a point\n95 % intervals (Wilson)", title_fontsize=8)  # fmt: skip
        if title:
            ax.set_title(title, loc="left", fontweight="bold", color=INK)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the suffix; the file appears whole or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic(path) as temporary, mpl.rc_context(STYLE):
        figure.savefig(temporary)


def _colours(count: int) -> list[Any]:
    if count <= len(PALETTE):
        return list(PALETTE[:count])
    return [mpl.colormaps["turbo"](x) for x in np.linspace(0.05, 0.95, count)]


def _darker(colour: Any) -> tuple[float, ...]:
    return tuple(0.55 * c for c in to_rgb(colour))


def _draw(ax: Axes, planned: MotionCurves, measured: MotionCurves | None, scaled: Any, colours: list[Any]) -> None:
    plan = scaled(planned)
    motion = None if measured is None else scaled(measured)
    for i, colour in enumerate(colours):
        if motion is None or measured is None:
            ax.plot(planned.times, plan[:, i], color=colour, lw=1.3, ls=(0, (4, 1.6)), zorder=3)
            continue
        ax.plot(measured.times, motion[:, i], color=colour, lw=1.6, zorder=3, solid_capstyle="round")
        # A good controller hides the plan under the measurement; a darker, thinner dash on top stays visible.
        ax.plot(planned.times, plan[:, i], color=_darker(colour), lw=0.8, ls=(0, (4, 2.2)), zorder=4)


def _scaled_axis(ax: Axes, label: str, plan: Array, motion: Array | None) -> None:
    ax.set_ylabel(label)
    largest = max(np.abs(plan).max(), 0.0 if motion is None else np.abs(motion).max())
    ax.set_ylim(-1.12 * max(1.0, largest), 1.12 * max(1.0, largest))
    ax.yaxis.set_major_locator(FixedLocator([-1.0, -0.5, 0.0, 0.5, 1.0]))
    ax.axhline(0.0, color=FAINT, lw=0.5, zorder=1)
    for limit in (-1.0, 1.0):
        ax.axhline(limit, color=INK, lw=0.7, ls=(0, (1, 1.5)), zorder=1)


def _moving_panel(
    ax: Axes, planned: MotionCurves, measured: MotionCurves | None, limits: JointLimits, threshold: float
) -> None:
    def ratio(curves: MotionCurves) -> Array:
        return np.abs(curves.velocity / limits.velocity).max(axis=1)

    if measured is not None:
        ax.plot(measured.times, ratio(measured), color="#4a4a52", lw=1.6, zorder=3)
    ax.plot(planned.times, ratio(planned), color=INK, lw=0.8, ls=(0, (4, 2.2)), zorder=4)
    ax.axhline(threshold, color="#b3261e", lw=0.9, zorder=2)
    ax.text(1.0, threshold, f" {threshold:g}", color="#b3261e", va="center", ha="left", fontsize=7.5,
            transform=ax.get_yaxis_transform())  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylim(threshold / 3, 1.3)
    ax.yaxis.set_major_locator(FixedLocator([0.01, 0.1, 1.0]))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_ylabel("fastest joint\n" + r"$\max_i|\dot q_i|/\dot q_{i,\max}$")


def _name_phases(ax: Axes, edges: Array) -> None:
    width = edges[-1] - edges[0]
    for name, start, end in zip(("approach", "grasp", "deliver"), edges[:-1], edges[1:], strict=True):
        if end - start > 0.03 * width:
            ax.text((start + end) / 2, 1.03, f"{name}\n{end - start:.2f} s", ha="center", va="bottom", fontsize=7.5,
                    color="#5c5c66", transform=ax.get_xaxis_transform())  # fmt: skip


def _legends(
    axes: Any,
    joint_names: Sequence[str],
    colours: list[Any],
    gripper_names: Sequence[str],
    gripper_colours: list[Any],
    motions: tuple[str, ...],
) -> None:
    beside = {"loc": "upper left", "bbox_to_anchor": (1.015, 1.03), "borderaxespad": 0.0, "handlelength": 1.7}
    joints = [Line2D([], [], color=c, lw=2.0, label=name) for name, c in zip(joint_names, colours, strict=True)]
    axes[0].legend(handles=joints, title="joint", alignment="left", title_fontsize=8, **beside)
    styles = ({"color": INK, "lw": 0.9, "ls": (0, (4, 2.2))}, {"color": "#4a4a52", "lw": 1.8})
    lines = [Line2D([], [], label=name, **style) for name, style in zip(motions, styles, strict=False)]
    lines.append(Line2D([], [], color=INK, lw=0.7, ls=(0, (1, 1.5)), label="limit"))
    axes[1].legend(handles=[*lines, Patch(color=PHASE_GREY, label="grasp phase")], **beside)
    hand = [Line2D([], [], color=c, lw=2.0, label=name) for name, c in zip(gripper_names, gripper_colours, strict=True)]
    axes[3].legend(handles=hand, title="gripper joint", alignment="left", title_fontsize=8, **beside)
