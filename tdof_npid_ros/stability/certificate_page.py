"""The certificate on one page: verdict, claim, numbers, and the picture of Re G."""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.output_file import OutputError
from tdof_npid_ros.plotting import new_figure, save, style
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.certificate import Certificate
from tdof_npid_ros.stability.criteria import FALL, FINE
from tdof_npid_ros.stability.margins import one_lane
from tdof_npid_ros.stability.pd_loop import PdLoop
from tdof_npid_ros.stability.plant import loop_plant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 7.6, 4.2  # inches
DECADES = 4.0  # of frequencies that the picture shows, up to where Re G has died out
DIED_OUT = 0.01  # of the least Re G
MEANING = """\
<p>The law integrates k(e)·e, with k(e) between 0 and 1: large errors count less. So the loop is not linear, and its
margins tell only how it behaves near the setpoint. Seen from this integral action, the rest of the loop is a linear
system with the frequency response G. If Re G nowhere falls to −1, the loop comes to rest from every state, whatever
values k(e) takes (circle criterion). Where it does, a multiplier may still prove it for the one k(e) of the law.</p>
"""
_STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; max-width: 52rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 1.6rem; }
.verdict { font-size: 1.25rem; font-weight: 600; padding: .6rem .9rem; border-left: .4rem solid; }
.yes { border-color: #009e73; background: #e6f5f0; } .no { border-color: #d55e00; background: #fbeee6; }
table { border-collapse: collapse; } td { padding: .15rem 1.2rem .15rem 0; } td + td { text-align: right; }
img { max-width: 100%; } footer { margin-top: 2rem; color: #666; font-size: .85rem; }
"""


def write_page(case: Case, gains: Gains, found: Certificate, path: Path, title: str) -> None:
    """Write the certificate as one page that needs nothing else.

    Raises:
        OutputError: the file cannot be written.
    """
    mark = "yes" if found.is_certified else "no"
    head, *details = found.lines()
    details = details[: details.index("")]
    reasons = "".join(_paragraph(reason) for reason in found.reasons)
    claims = "".join(map(_paragraph, found.claim)) or _paragraph("Nothing.")
    rows = [line.strip() for line in details[len(found.reasons) :]]
    if found.margins is not None:
        rows += found.margins.lines()
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}: certificate</title><style>{
        _STYLE
    }</style></head>
<body><h1>{html.escape(title)}</h1>
<p class="verdict {mark}">{html.escape(head[0].upper() + head[1:])}</p>{reasons}
<h2>What is claimed</h2>{claims}
<h2>What is not claimed</h2>{"".join(map(_paragraph, found.not_claimed))}
{_picture(case, gains, found, title)}
<h2>Numbers</h2><table>{"".join(map(_row, rows))}</table>
<h2>What the loop is</h2><table>{
        "".join(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>" for name, value in _loop(case, gains)
        )
    }</table>
<footer>Proved for all frequencies, between grid points too, in floating-point numbers with an allowance for their
rounding.</footer>
</body></html>
"""
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error


def draw_certificate(case: Case, gains: Gains, found: Certificate, path: Path, title: str) -> None:
    """Write the picture of Re G over the frequency.

    Raises:
        StabilityError: there is no such function: the plant is not linear, or the PD loop not stable.
        PlottingError: the file cannot be written.
    """
    if found.re_g_least is None:
        raise StabilityError(f"there is no Re G to draw: {found.reasons[0] if found.reasons else 'no integral action'}")
    save(_figure(case, gains, found, title), path)


def _figure(case: Case, gains: Gains, found: Certificate, title: str) -> Figure:
    loop = PdLoop(loop_plant(case), one_lane(gains))
    points = np.arange(len(loop.edges) * FINE - FINE + 1) / FINE
    omega = np.interp(points, np.arange(len(loop.edges)), loop.edges)[1:]
    re_g = loop.re_g(omega)
    assert found.re_g_least is not None and found.re_g_zero is not None
    alive = np.flatnonzero(np.abs(re_g) > DIED_OUT * abs(found.re_g_least))
    last = min(float(omega[alive[-1]]) * 3.0, math.pi) if len(alive) else math.pi
    shown = (omega <= last) & (omega >= last * 10.0**-DECADES)
    rate = omega[shown] / case.sample_period
    figure, axes = new_figure(1, 1, WIDTH, HEIGHT)
    axis = axes[0][0]
    axis.semilogx(rate, re_g[shown], label="Re G", **style(0))
    axis.axhline(-1.0, label="−1: the circle criterion's bound", **style(1))
    if found.k_max is not None and found.method == "circle":
        axis.semilogx(rate, found.k_max * re_g[shown], label=f"Re G with {found.k_max:.3g} K_i", **style(2))
    if found.q is not None:
        h = loop.h(omega)
        bent = 0.5 * abs(found.q) * (1.0 if found.q > 0 else FALL) * np.abs(h) ** 2
        criterion = re_g + found.q * h.real - bent
        axis.semilogx(rate, criterion[shown], label=f"with the multiplier, q = {found.q:.4g}", **style(2))
        axis.set_ylim(min(float(re_g.min()), -1.0) - 0.3, max(float(np.quantile(criterion[shown], 0.7)), 1.0))
    axis.set(xlabel="frequency (rad/s)", ylabel="Re G", title=title)
    axis.legend(frameon=False, fontsize=9)
    return figure


def _picture(case: Case, gains: Gains, found: Certificate, title: str) -> str:
    if found.re_g_least is None:
        return ""
    image = io.BytesIO()
    _figure(case, gains, found, title).savefig(image, format="png")
    encoded = base64.b64encode(image.getvalue()).decode()
    return f'<h2>Why</h2>{MEANING}<img alt="Re G over the frequency" src="data:image/png;base64,{encoded}">'


def _loop(case: Case, gains: Gains) -> list[tuple[str, str]]:
    """Plant and controller, by the names of the parameter file."""
    plant = {name: value for name, value in case.plant_values.items() if name not in ("sample_period", "mode")}
    shown = {"sample_period": f"{case.sample_period:g} s", "model": case.model, **plant, **gains.as_dict()}
    return [(name, f"{value:g}" if isinstance(value, float) else str(value)) for name, value in shown.items()]


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _row(line: str) -> str:
    """A line of a name and a value, two blanks or more between them, as a row of a table."""
    name, _, value = line.partition("  ")
    return f"<tr><td>{html.escape(name)}</td><td>{html.escape(value.strip())}</td></tr>"
