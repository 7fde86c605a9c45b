"""The picture and the page of a sweep: fans of responses, histograms of the metrics, the worst plants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.interactive import Page, finish_legend, new_plot, source_of
from tdof_npid_ros.interactive import draw as curve
from tdof_npid_ros.metrics import in_units
from tdof_npid_ros.plotting import GUIDE, PALETTE, Curve, Panel, new_figure, save, shown_until
from tdof_npid_ros.robustness.result import QUANTILES, RobustResult
from tdof_npid_ros.robustness.sweep import METRICS, shown_samples

BANDS = ((0.05, 0.95, 0.18), (0.25, 0.75, 0.3))  # quantiles, and how dark what lies between them is
HISTOGRAM = 40  # bins
LAST_BIN = "the last bin holds all beyond"


def draw(result: RobustResult, path: Path) -> None:
    """Write the picture.

    Raises:
        PlottingError: it cannot be written.
    """
    shown = _histogram_metrics(result)
    figure, axes = new_figure(1 + -(-len(shown) // 2), 2, height=2.6)
    for axis, episode in zip(axes[0], result.fans, strict=True):
        time, fan, nominal = _fan(result, episode)
        signals = result.case.signals[episode]
        axis.plot(signals.time, signals.setpoint, color=GUIDE, linewidth=1.1, linestyle=(0, (4, 3)), label="setpoint r")
        for low, high, alpha in BANDS:
            lower, upper = np.quantile(fan, (low, high), axis=1)
            label = f"{100 * low:g} to {100 * high:g} % of the plants"
            axis.fill_between(time, lower, upper, color=PALETTE[0], alpha=alpha, linewidth=0, label=label)
        axis.plot(time, np.median(fan, axis=1), color=PALETTE[0], linewidth=1.6, label="median")
        axis.plot(signals.time, nominal, color=PALETTE[1], linewidth=1.6, linestyle=(0, (6, 2)), label="the model")
        axis.set_title(episode, fontsize=11, loc="left", fontweight="bold")
        axis.set_xlabel("time (s)")
        axis.set_ylim(*_limits(fan, nominal))
        axis.set_xlim(time[0], _until(time, fan))
    axes[0][0].set_ylabel("output y")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    cells = [axis for row in axes[1:] for axis in row]
    for axis, name in zip(cells, shown, strict=False):
        counts, edges = _histogram(result.metrics[name])
        axis.stairs(counts, edges, fill=True, color=PALETTE[0], alpha=0.6)
        axis.set_axisbelow(True)
        for quantile, dash in zip(QUANTILES, (":", "-", ":"), strict=True):
            if np.isfinite(value := result.quantile(name, quantile)):
                axis.axvline(value, color=PALETTE[1], linewidth=1.2, linestyle=dash)
        axis.set_title(METRICS[name], fontsize=10, loc="left")
        axis.set_title(LAST_BIN, fontsize=8, loc="right", color="#555555")
        axis.set_ylabel("plants", fontsize=9)
    for axis in cells[len(shown) :]:
        axis.set_visible(False)
    figure.suptitle(f"{result.case.name}, {result.gains.type}: {result.unstable_line()}", fontsize=10)
    save(figure, path)


def page(result: RobustResult) -> Page:
    """The same and all numbers, for a browser."""
    made = Page(f"{result.case.name}: {len(result.unstable)} plants near the model")
    made.text(f"{result.unstable_line()} (by {result.judged_by}).")
    made.heading("Spreads")
    made.table(
        [
            ["parameter", "from", "to", "the model's"],
            *([one.name, f"{one.low:g}", f"{one.high:g}", f"{one.nominal:g}"] for one in result.spreads),
        ]
    )
    for episode in result.fans:
        made.heading(f"Responses: {episode}")
        made.plot(_fan_plot(result, episode))
    made.heading("Metrics")
    made.text("An unstable loop, and a time that is not reached, count as infinitely bad: '-'.")
    made.table(
        [
            ["", *(f"{100 * q:g} %" for q in QUANTILES), "mean"],
            *(
                [METRICS[name], *map(_cell, [*(result.quantile(name, q) for q in QUANTILES), result.mean(name)])]
                for name in result.metrics
            ),
        ]
    )
    made.text(f"Plants by metric; {LAST_BIN}.")
    for name in _histogram_metrics(result):
        made.plot(_histogram_plot(result, name))
    made.heading("What they depend on")
    made.text(
        "The part of a metric's variance (of its ranks) that a parameter alone explains; in brackets, Spearman's."
    )
    made.table(
        [
            ["", *(one.name for one in result.spreads)],
            *(
                [METRICS[name], *(f"{100 * s.explained:.0f} % ({s.correlation:+.2f})" for s in found.values())]
                for name in result.metrics
                if (found := result.sensitivity(name))
            ),
        ]
    )
    made.heading("The worst plants")
    made.table(
        [
            ["sample", *(one.name for one in result.spreads), *(METRICS[name] for name in result.metrics)],
            *(
                [
                    str(index),
                    *(f"{x:.6g}" for x in result.values[index]),
                    *(_cell(float(values[index])) for values in result.metrics.values()),
                ]
                for index in result.worst()
            ),
        ]
    )
    return made


def _fan(result: RobustResult, episode: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and outputs of the first plants, (points,) and (points, plants), and the model's output, (steps + 1,)."""
    shown = shown_samples(result.case.signals[episode].steps)
    time = result.case.signals[episode].time[shown]
    return time, result.fans[episode], result.case.simulate(episode, result.gains).output[:, 0]


def _limits(fan: np.ndarray, nominal: np.ndarray) -> tuple[float, float]:
    """Of the axis: an unstable plant must not make all others a flat line."""
    low, high = float(nominal.min()), float(nominal.max())
    size = max(high - low, 1e-300)
    low = min(low, max(float(np.quantile(fan, 0.05, axis=1).min()), low - 2.0 * size))
    high = max(high, min(float(np.quantile(fan, 0.95, axis=1).max()), high + 2.0 * size))
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _until(time: np.ndarray, fan: np.ndarray) -> float:
    """When nearly all plants have come to rest."""
    unknown = np.full(len(time), np.nan)
    edges = np.quantile(fan, (0.05, 0.5, 0.95), axis=1)
    return shown_until(Panel("", [Curve("", time, edge, unknown) for edge in edges]))


def _histogram_metrics(result: RobustResult) -> list[str]:
    """Those with numbers enough to show."""
    return [name for name, values in result.metrics.items() if np.isfinite(values).sum() > 1]


def _histogram(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the finite ones; the farthest hundredth is in the last bin."""
    known = values[np.isfinite(values)]
    most = float(np.quantile(known, 0.99))
    counts, edges = np.histogram(np.minimum(known, most), bins=HISTOGRAM)
    return counts, edges


def _fan_plot(result: RobustResult, episode: str) -> Any:
    time, fan, nominal = _fan(result, episode)
    signals = result.case.signals[episode]
    plot = new_plot("output", 300)
    setpoint = source_of(signals.time, signals.setpoint, "setpoint", steps=True)
    curve(plot, setpoint, "setpoint", color=GUIDE, dash="dashed", width=1.4)
    for low, high, alpha in BANDS:
        lower, upper = np.quantile(fan, (low, high), axis=1)
        label = f"{100 * low:g} to {100 * high:g} %"
        plot.varea(time, lower, upper, fill_color=PALETTE[0], fill_alpha=alpha, legend_label=label)
    curve(plot, source_of(time, np.median(fan, axis=1), "median"), "median", color=PALETTE[0])
    curve(plot, source_of(signals.time, nominal, "the model"), "the model", color=PALETTE[1], dash="dashed")
    plot.y_range.start, plot.y_range.end = _limits(fan, nominal)
    plot.x_range.start, plot.x_range.end = float(time[0]), _until(time, fan)
    finish_legend(plot)
    return plot


def _histogram_plot(result: RobustResult, name: str) -> Any:
    from bokeh.models import Span

    counts, edges = _histogram(result.metrics[name])
    plot = new_plot("plants", 180, x_label=METRICS[name])
    plot.quad(
        top=counts, bottom=0, left=edges[:-1], right=edges[1:], fill_color=PALETTE[0], fill_alpha=0.6, line_color=None
    )
    for quantile in QUANTILES:
        if np.isfinite(value := result.quantile(name, quantile)):
            plot.add_layout(Span(location=value, dimension="height", line_color=PALETTE[1], line_width=1.4))
    return plot


def _cell(value: float) -> str:
    return in_units(value) if np.isfinite(value) else "-"
