"""The noise model beside the camera that it was fitted to."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dyngrasp.experiments.pose_noise_fit import PoseNoiseFit
from dyngrasp.report.figures import FAINT, INK, PALETTE, STYLE
from dyngrasp.signals import Array

POSITION, ANGLE, MODEL = PALETTE[0], PALETTE[5], INK


def pose_noise_figure(fit: PoseNoiseFit) -> Figure:
    """Deviation of position and rotation against distance, and how long errors last: measured, and the model.

    Args:
        fit: Of films of approaches.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.4, 3.5), layout="constrained")
        figure.get_layout_engine().set(w_pad=0.09)  # type: ignore[union-attr]
        position, angle, time = figure.subplots(1, 3)
        _deviation(position, fit, slice(0, 3), 1e3, "mm", POSITION)
        _deviation(angle, fit, slice(3, 6), float(np.rad2deg(1.0)), "deg", ANGLE)
        position.set_title("error of the position, per axis (mm)", loc="left", fontsize=8.5)
        angle.set_title("error of the rotation, per axis (°)", loc="left", fontsize=8.5)
        _correlation(time, fit)
        films = np.unique(fit.errors.film).size
        figure.suptitle(
            f"How far off the pose is while the hand nears: {films} rendered approaches, and the noise model",
            x=0.01, ha="left", fontsize=10, fontweight="bold", color=INK,
        )  # fmt: skip
    return figure


def _deviation(ax: Axes, fit: PoseNoiseFit, axes: slice, unit: float, name: str, colour: str) -> None:
    errors, rows = fit.errors, fit.rows()
    known = np.isfinite(errors.filtered[:, 0])
    # One dot a frame: all three axes together, as large as one of them would be.
    size = unit * np.sqrt(np.mean(errors.filtered[known][:, axes] ** 2, axis=1))
    ax.plot(errors.distance[known], size, ".", ms=3.5, color=colour, alpha=0.35, mew=0, zorder=2,
            label="estimate after a frame")  # fmt: skip
    middle = [0.5 * (row["from_m"] + row["to_m"]) for row in rows]
    ax.plot(middle, [row[f"filter_{name}"] for row in rows], "o", color=colour, ms=6, mec="white", mew=0.8, zorder=4,
            label="root mean square of 5 cm")  # fmt: skip
    distance = np.linspace(0.0, float(errors.distance.max()), 100)
    model = np.array([fit.settings.deviation(d)[axes.start] for d in distance])
    constant, growth = model[0], (model[-1] - model[0]) / distance[-1] ** 2
    ax.plot(distance, unit * model, color=MODEL, lw=1.6, zorder=3,
            label=f"noise model, {unit * constant:.2f} + {unit * growth:.1f} d²")  # fmt: skip
    top = 1.15 * max(np.percentile(size, 99.0), unit * model.max())
    ax.set_ylim(0.0, top)
    if above := int((size > top).sum()):
        note = f"{above} dots above"
        ax.text(1.0, 0.99, note, transform=ax.transAxes, ha="right", va="top", fontsize=7, color="#6a6a72")
    ax.set_xlim(0.0, 1.03 * float(errors.distance.max()))
    ax.set_xlabel("distance of the hand from the grasp, d (m)")
    _grid(ax)
    ax.legend(loc="upper left", handletextpad=0.5, borderaxespad=0.2)


def _correlation(ax: Axes, fit: PoseNoiseFit) -> None:
    ax.plot(fit.lags, fit.correlation[:, 0], "o", ms=4, color=POSITION, mec="white", mew=0.5, label="position")
    ax.plot(fit.lags, fit.correlation[:, 1], "o", ms=4, color=ANGLE, mec="white", mew=0.5, label="rotation")
    lags: Array = np.linspace(0.0, float(fit.lags[-1]), 100)
    tau = fit.settings.correlation_time
    ax.plot(lags, np.exp(-lags / tau), color=MODEL, lw=1.6, label=f"noise model, exp(−Δt / {tau:.1f} s)")
    ax.set_ylim(0.0, 1.05)
    ax.set_xlim(0.0, 1.03 * float(fit.lags[-1]))
    ax.set_xlabel("time apart, Δt (s)")
    ax.set_title("correlation of errors Δt apart", loc="left", fontsize=8.5)
    _grid(ax)
    ax.legend(loc="lower left", handletextpad=0.5, borderaxespad=0.2)


def _grid(ax: Axes) -> None:
    ax.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6, zorder=0)
    ax.set_axisbelow(True)
