"""What an experiment moves, and when: steps, doublets and a relay with hysteresis, led by what the output does.

Nothing is known of the plant beforehand, so no time is given: a level is held until the output has settled, or has
moved by as much as it may, or at the latest after `hold`. Without ROS.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from tdof_npid_ros.identification.noise import roughness

Kind = Literal["step", "doublet", "relay"]
By = Literal["setpoint", "effort"]
KINDS: Final[tuple[Kind, ...]] = ("step", "doublet", "relay")
RELAY_CYCLES = 4
LEAST_SAMPLES = 40  # of a level
SETTLED = 0.05  # of what a level has moved: a smaller drift between its last two thirds is none
IN_NOISE = 4.0  # standard deviations of a mean: the same
MOVED = 5.0  # times the noise: the output has moved
OUT_OF_NOISE = 30.0  # standard deviations: what the output is moved by at the least
SAFE = 4.0  # times the output's move: what is safe where nobody says it
EFFORT_FRACTION = 0.1  # of the actuator's range: how far an experiment by hand moves the effort
LOOKS = 1.03  # a level is looked at anew when it is so many times longer


class Excitation:
    """The levels of setpoint or effort, one after the other, as the outputs come.

    Args:
        kind: `step` moves to one level, `doublet` up, down and back, `relay` up and down some times and back.
        base: the level at rest.
        size: how far the levels are from it; its sign says where it goes first.
        limits: within which the levels are kept.
        noise: standard deviation of the output's.
        hold: s that a level lasts at the most.
        swing: how far the output may move from where it rests, to either side; then the next level comes.

    Attributes:
        level: of now.
        done: whether the experiment is.
        changes: when the level changed, s, and to what.
    """

    def __init__(
        self,
        kind: Kind,
        base: float,
        size: float,
        noise: float,
        hold: float,
        swing: float = math.inf,
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        signs = {"step": (1.0,), "doublet": (1.0, -1.0, 0.0), "relay": (1.0, -1.0) * RELAY_CYCLES + (0.0,)}[kind]
        self._levels = [min(max(base + sign * size, limits[0]), limits[1]) for sign in signs]
        self._noise, self._hold, self._swing = noise, hold, swing
        self.done = False
        self.changes: list[tuple[float, float]] = []
        self._rest: float | None = None
        self._direction = 0.0  # in which the output moves with the first level
        self._longest = 0.0
        self._times: list[float] = []
        self._outputs: list[float] = []
        self._next_look = 0.0

    @property
    def level(self) -> float:
        """What is to be given now."""
        return self._levels[len(self.changes) - 1]

    def begin(self, time: float, rest: float) -> None:
        """Go to the first level; the output rests at `rest`."""
        self._rest = rest
        self._enter(time)

    def take(self, time: float, output: float) -> bool:
        """Look at an output; whether the level has changed by it, or the experiment is done."""
        self._times.append(time)
        self._outputs.append(output)
        if not self._is_over(time, output):
            return False
        self._longest = max(self._longest, time - self.changes[-1][0])
        if len(self.changes) == len(self._levels):
            self.done = True
        else:
            self._enter(time)
        return True

    def _enter(self, time: float) -> None:
        self.changes.append((time, self._levels[len(self.changes)]))
        self._times, self._outputs, self._next_look = [], [], 0.0

    def _is_over(self, time: float, output: float) -> bool:
        assert self._rest is not None
        elapsed, number = time - self.changes[-1][0], len(self.changes)
        if elapsed > self._hold:
            return True
        is_last = number == len(self._levels) and number > 1
        moved = output - self._rest
        if math.isfinite(self._swing) and not is_last:
            if not self._direction and abs(moved) >= self._swing:
                self._direction = math.copysign(1.0, moved)
                return True
            if self._direction and moved * self._direction * (-1.0) ** (number - 1) >= self._swing:
                return True
        count = len(self._times)
        if count < LEAST_SAMPLES or elapsed < self._next_look or (number > 1 and elapsed < 0.5 * self._longest):
            return False
        self._next_look = LOOKS * elapsed
        y = np.array(self._outputs)
        middle, last = y[count // 3 : 2 * count // 3], y[2 * count // 3 :]
        came_from, now = float(np.mean(y[: max(1, count // 50)])), float(np.mean(last))
        travelled = max(abs(now - came_from), float(np.ptp(y)) - 2.0 * MOVED * self._noise)
        if number == 1 and travelled <= MOVED * self._noise:
            return False  # the dead time, or a step that is too small
        still = max(SETTLED * travelled, IN_NOISE * self._noise / math.sqrt(count / 3.0))
        ripple = float(np.ptp(last)) - 2.0 * MOVED * self._noise
        return abs(now - float(np.mean(middle))) <= still and ripple <= 2.0 * still


class Rest(NamedTuple):
    """A loop at rest, or not.

    Attributes:
        output, effort, setpoint: their means.
        noise: standard deviation of the output's white noise.
        drift: of the output, from the first half to the second.
        is_rest: whether the drift is no more than the noise explains, or `tolerance`.
    """

    output: float
    effort: float
    setpoint: float
    noise: float
    drift: float
    is_rest: bool


def rest_of(outputs: Sequence[float], efforts: Sequence[float], setpoints: Sequence[float], tolerance: float) -> Rest:
    """Whether a loop rests, from some of its samples."""
    y = np.array(outputs)
    half = len(y) // 2
    drift = float(y[half:].mean() - y[:half].mean())
    noise = roughness([y])
    explained = IN_NOISE * max(noise, float(y.std()) if noise else 0.0) * math.sqrt(2.0 / max(half, 1))
    return Rest(
        float(y.mean()), float(np.mean(efforts)), float(np.mean(setpoints)), noise, drift,
        abs(drift) <= max(explained, tolerance),
    )  # fmt: skip


@dataclass(frozen=True)
class Proposal:
    """An experiment that suits a loop.

    Attributes:
        kind, by: what is done, with what.
        base: where it begins.
        size: of its levels, signed; `swing` as of `Excitation`.
        safe_output, safe_effort: ranges in which the loop must stay.
    """

    kind: Kind
    by: By
    base: float
    size: float
    swing: float
    safe_output: tuple[float, float]
    safe_effort: tuple[float, float]

    def excitation(self, noise: float, hold: float) -> Excitation:
        """The experiment."""
        limits = self.safe_output if self.by == "setpoint" else self.safe_effort
        return Excitation(self.kind, self.base, self.size, noise, hold, self.swing, limits)


def proposed(
    rest: Rest,
    by: By,
    kind: Kind,
    scale: float,
    safe_output: tuple[float, float],
    safe_effort: tuple[float, float],
    size: float | None = None,
    times: float = 1.0,
) -> Proposal:
    """An experiment that moves the output well out of its noise, and no farther than needed.

    Args:
        rest: the loop's.
        scale: the largest change of the setpoint that is usual: sigma.
        safe_output: infinite ends: chosen from the experiment's size.
        safe_effort: finite where the actuator is limited.
        size: in place of the one chosen.
        times: the size chosen, so many times.

    Raises:
        ValueError: nothing tells how large it may be, or there is no room.
    """
    room = [abs(end - rest.output) for end in safe_output]
    swing = max(OUT_OF_NOISE * rest.noise, 0.2 * scale) * times
    swing = min(swing, 0.5 * max(room))
    if by == "setpoint":
        size = math.copysign(swing, room[1] - room[0] if min(room) < 2.0 * swing else 1.0) if size is None else size
        reach, swing, base = abs(size), math.inf, rest.setpoint
        limits = (rest.output - room[0] * 0.6, rest.output + room[1] * 0.6)
        if not limits[0] <= base + size <= limits[1]:
            raise ValueError(f"a setpoint of {base + size:g} is too near the end of safe_range.output: give a --size")
    else:
        low, high = safe_effort
        if size is None:
            width = high - low
            size = EFFORT_FRACTION * width * times if math.isfinite(width) else 0.2 * abs(rest.effort) * times
            size = min(size, 0.9 * max(high - rest.effort, rest.effort - low))
            size = size if high - rest.effort >= min(size, rest.effort - low) else -size
        base, reach = rest.effort, swing
    if not abs(size) > 0.0:
        raise ValueError(f"nothing tells how far the {by} may be moved: give --size, in the {by}'s unit")
    safe_output = tuple(
        end if math.isfinite(end) else rest.output + sign * SAFE * reach
        for end, sign in zip(safe_output, (-1.0, 1.0), strict=True)
    )  # type: ignore[assignment]
    return Proposal(kind, by, base, size, swing, safe_output, safe_effort)


@dataclass(frozen=True)
class RelayPoint:
    """One point of the plant's frequency response, by the describing function: the ratio of the first harmonics.

    Attributes:
        period: s, of the oscillation.
        gain: |G| there, output/effort.
        phase: of G there, in degrees, -360 to 0.
    """

    period: float
    gain: float
    phase: float


def relay_point(time: np.ndarray, effort: np.ndarray, output: np.ndarray) -> RelayPoint | None:
    """The point that a relay's oscillation tells; None if it has not gone round twice.

    The last whole period counts: by then the oscillation has built up. The effort is the one applied, so whatever
    delays it on its way to the plant does no harm.

    Args:
        time: s, (samples,).
        effort: held from each time on; output: (samples,).
    """
    middle = 0.5 * (effort.max() + effort.min())
    rises = np.flatnonzero((effort[1:] > middle) & (effort[:-1] <= middle)) + 1
    if len(rises) < 3:
        return None
    first, last = int(rises[-2]), int(rises[-1])
    if last - first < 8:
        return None
    period = float(time[last] - time[first])
    part = slice(first, last)
    widths = np.diff(time[first : last + 1])
    angle = 2.0 * math.pi * (time[part] - time[first]) / period
    half = math.pi * widths / period  # the effort is held: its harmonic is that of a staircase
    u = np.sum((effort[part] - middle) * widths * np.exp(-1j * (angle + half)) * np.sinc(half / math.pi))
    y = np.sum((output[part] - output[part].mean()) * widths * np.exp(-1j * angle))
    ratio = complex(y / u)
    phase = math.degrees(math.atan2(ratio.imag, ratio.real))
    return RelayPoint(period, abs(ratio), phase if phase <= 0.0 else phase - 360.0)
