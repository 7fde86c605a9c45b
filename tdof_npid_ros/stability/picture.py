"""The pictures of a loop's margins: Nyquist's curve, the sensitivities and the step responses."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tdof_npid_ros.case import EPISODES, Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.plotting import GUIDE, new_figure, save, style
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.margins import Margins, loop_of
from tdof_npid_ros.stability.screen import frequency_grid, on_circle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEIGHT, WIDTH = 4.2, 4.6  # inches of one set of axes
REACH = 3.0  # largest magnitude of L that the Nyquist picture shows
USUAL_M_S = 2.0
DECADES = 3.0  # below the crossover that the sensitivities are shown


def draw_margins(case: Case, gains: Gains, found: Margins, path: Path, title: str) -> None:
    """Write the picture of a loop's margins.

    Args:
        found: the margins, see `margins`.

    Raises:
        StabilityError: there is no linear loop to draw.
        PlottingError: the file cannot be written.
    """
    if found.operating_point is None:
        raise StabilityError(f"there is no picture of the margins: {found.reason}")
    loop = loop_of(case, gains, found.operating_point)
    omega = _dense(frequency_grid(loop.plant))
    with np.errstate(all="ignore"):
        response = loop.loop(on_circle(omega))
    figure, axes = new_figure(1, 3, WIDTH, HEIGHT)
    nyquist, sensitivity, step = axes[0]
    _draw_nyquist(nyquist, response, found.m_s)
    _draw_sensitivity(sensitivity, omega / case.sample_period, response, found)
    _draw_steps(step, case, gains)
    figure.suptitle(title, fontsize=12)
    save(figure, path)


def _dense(omega: np.ndarray) -> np.ndarray:
    """Twice the points, for smooth curves."""
    return np.union1d(omega, 0.5 * (omega[1:] + omega[:-1]))


def _draw_nyquist(axis: Axes, response: np.ndarray, m_s: float | None) -> None:
    near = np.where(np.abs(response) <= REACH, response, np.nan)
    axis.plot(near.real, near.imag, label="L", **style(0))
    circle = np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 200))
    axis.plot(circle.real, circle.imag, color=GUIDE, linewidth=0.8, linestyle=(0, (1, 2)))
    for size, number in ((USUAL_M_S, 2), (m_s, 1)):
        if size is not None:
            axis.plot(-1.0 + circle.real / size, circle.imag / size, label=f"M_s = {size:.3g}", **style(number))
    axis.plot([-1.0], [0.0], "+", color="#000000", markersize=9)
    axis.set(xlim=(-2.2, 1.2), ylim=(-2.0, 1.4), xlabel="Re L", ylabel="Im L", title="Nyquist curve")
    axis.set_aspect("equal")
    axis.legend(frameon=False, fontsize=9)


def _draw_sensitivity(axis: Axes, omega: np.ndarray, response: np.ndarray, found: Margins) -> None:
    crossed = np.flatnonzero(np.diff(np.abs(response) > 1.0))
    middle = float(omega[crossed[-1]]) if len(crossed) else float(omega[-1]) / 30.0
    shown = omega >= middle * 10.0**-DECADES
    with np.errstate(all="ignore"):
        s = 1.0 / np.abs(1.0 + response)
        t = np.abs(response) * s
    axis.loglog(omega[shown], s[shown], label="|S|", **style(0))
    axis.loglog(omega[shown], t[shown], label="|T|", **style(1))
    axis.axhline(USUAL_M_S, color=GUIDE, linewidth=0.8, linestyle=(0, (1, 2)))
    peaks = "unstable" if not found.stable else f"M_s {found.m_s:.3g}, M_t {found.m_t:.3g}"
    axis.set(xlabel="frequency (rad/s)", ylim=(1e-2, None), title=f"Sensitivities: {peaks}")
    axis.legend(frameon=False, fontsize=9)


def _draw_steps(axis: Axes, case: Case, gains: Gains) -> None:
    axis.set(xlabel="time (s)", ylabel="output y", title="Responses")
    for number, episode in enumerate(name for name in EPISODES if name in case.plans):
        run = case.simulate(episode, gains)
        axis.plot(run.time, run.output[:, 0], label=episode, **style(number))
        axis.plot(run.time, run.setpoint, color=GUIDE, linewidth=0.8, drawstyle="steps-post", zorder=1)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False, fontsize=9)
