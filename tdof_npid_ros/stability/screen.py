"""Margins of many candidates at once: the plant's response is computed once, each lane's loop is followed along it.

What is followed is the closed loop's characteristic function on the unit circle,

    χ(w) = a v s + z^-lag b (v (K_p s + K_dh w) + h K_i s),   w = z - 1,

with the plant z^-lag b/a, v = w the integral action's pole (1 without it) and s = w + 1 - φ the derivative filter's (1
without it). It has no poles there, so a plant on the border of stability needs no indentation, and hidden modes are in
it. The loop is stable exactly if its argument grows by π times the number of its zeros on the half circle.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.compiled import called, compiled, entry_point
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.law import KD_H, KI_H, KP, PHI, coefficients
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.pulse import PulseTransfer, polynomial

COARSE = 0.2  # spacing of the grid in ln ω
TURN = 0.25  # most that the plant's response changes between two points: rad of its phase, or part of its magnitude
SLOWEST = 1e-4  # of the slowest of the plant's frequencies: where the grid begins
MOST_POINTS = 1_000_000
DEEPEST = 40  # halvings of a stretch of the grid

_SEGMENTS = 3  # the highest peaks that are followed to their top, of S and of T each
_PEAK_STEPS = 24  # at most, towards the top of a peak
_PEAK_WIDTH = 1e-4  # part of a peak's distance from 0 by which it may still be nearer
_NEAREST = 1e-13  # to the circle that a mode may lie and still be told from one on it
_STEPS = 30  # towards a mode
# Rows of the result: see LaneMargins.
(_STABLE, _MS, _MT, _GAIN, _GAIN_LOW, _PHASE, _DELAY, _RADIUS) = range(8)
_RESULTS = 8


class _Response(NamedTuple):
    """The plant on the half circle, one number per point; a, b: see `PulseTransfer`; beyond: see `_response`."""

    omega: np.ndarray
    w: np.ndarray
    a: np.ndarray
    b: np.ndarray
    turn_left: np.ndarray
    beyond: np.ndarray
    a_polynomial: np.ndarray
    b_polynomial: np.ndarray
    lag: int


@dataclass(frozen=True)
class LaneMargins:
    """Margins by lane, (lanes,) each; nan for a lane that is not stable, inf for a margin that nothing limits.

    Attributes:
        stable: whether the closed loop is asymptotically stable. False also where a mode is so near the circle
            (within 1e-13) that this cannot be told.
        m_s, m_t: largest magnitudes of S = 1/(1 + L) and T = L S, to 1 % also at sharp resonances.
        gain_margin: the least factor above 1 on K_p, K_i and K_d that brings a mode onto the circle, to 1 %.
        gain_margin_low: the largest factor below 1 that does (0: none), for plants that need feedback.
        phase_margin: rad.
        delay_margin: s: the least extra dead time that brings a mode onto the circle.
        time_constant: -h/ln(modulus) of the slowest mode found, in s; found from the peaks of S and from low frequency,
            so a slower one may be missed: `margins` finds all.
    """

    stable: np.ndarray
    m_s: np.ndarray
    m_t: np.ndarray
    gain_margin: np.ndarray
    gain_margin_low: np.ndarray
    phase_margin: np.ndarray
    delay_margin: np.ndarray
    time_constant: np.ndarray


class Screen:
    """Margins of any number of candidates of one linear plant, with the loop's exact dead time.

    A candidate costs 2 to 4 µs, and as much again for its modes: a tenth of its simulation.

    Example:
        screen = Screen(loop_plant(case))
        found = screen(gains)  # of any number of lanes
        feasible = found.stable & (found.m_s <= 2.0)

    Args:
        plant: with the controller's filter, if it has one; see `loop_plant`.

    Raises:
        StabilityError: the dead time is so long that the response would take more than MOST_POINTS points.
    """

    def __init__(self, plant: PulseTransfer) -> None:
        self.plant = plant
        self._response = _response(plant)

    @property
    def points(self) -> int:
        """Of the grid."""
        return len(self._response.omega)

    def __call__(self, gains: Gains, modes: bool = True) -> LaneMargins:
        """The margins of each lane, as long as no limit is active; safe to call from several threads.

        Args:
            gains: of any number of lanes.
            modes: whether to look for the slowest mode, which doubles the time; without, `time_constant` is nan.
        """
        c = coefficients(gains, self.plant.sample_period)
        found = np.empty((_RESULTS, gains.lanes))
        _screen_lanes(self._response, c[KP], c[KI_H], c[KD_H], c[PHI], modes, found)
        return _lane_margins(found, self.plant.sample_period)


class Screens:
    """Margins of any number of candidates with each of several linear plants.

    Args:
        plants: as for `Screen`, of one sample period.

    Raises:
        StabilityError: see `Screen`.
    """

    def __init__(self, plants: Sequence[PulseTransfer]) -> None:
        self._sample_period = plants[0].sample_period
        self._responses = [_response(plant) for plant in plants]

    def __call__(self, gains: Gains, modes: bool = True, plants: slice = slice(None)) -> LaneMargins:
        """The margins, (lanes * plants,): first of the first lane with all plants, and so on; else as `Screen`.

        Args:
            gains, modes: as for `Screen`.
            plants: which; by default all.
        """
        c = coefficients(gains, self._sample_period)
        responses = self._responses[plants]
        found = np.empty((len(responses), _RESULTS, gains.lanes))
        for response, of_plant in zip(responses, found, strict=True):
            _screen_lanes(response, c[KP], c[KI_H], c[KD_H], c[PHI], modes, of_plant)
        by_lane = np.ascontiguousarray(found.transpose(1, 2, 0)).reshape(_RESULTS, -1)
        return _lane_margins(by_lane, self._sample_period)


def _lane_margins(found: np.ndarray, h: float) -> LaneMargins:
    """From the rows of the result, (_RESULTS, lanes)."""
    stable = found[_STABLE] > 0.0
    with np.errstate(divide="ignore"):
        time_constant = -h / np.log(np.minimum(found[_RADIUS], 1.0))
    return LaneMargins(
        stable,
        found[_MS],
        found[_MT],
        found[_GAIN],
        found[_GAIN_LOW],
        found[_PHASE],
        found[_DELAY] * h,
        np.where(stable, time_constant, np.nan),
    )


def frequency_grid(plant: PulseTransfer) -> np.ndarray:
    """Frequencies in rad per sample, up to π, between which neither a nor P changes by more than TURN, (points,).

    Raises:
        StabilityError: they are more than MOST_POINTS.
    """
    if plant.lag * math.pi / TURN > MOST_POINTS:
        raise StabilityError(
            f"a dead time of {plant.lag - 1:,} samples: margins are computed up to "
            f"{int(MOST_POINTS * TURN / math.pi):,}; take a longer sample_period"
        )
    corners = np.abs(np.concatenate([plant.poles, plant.zeros, [1.0 / plant.lag]]))
    first = SLOWEST * min(1.0, float(np.min(corners[corners > 1e-14], initial=1.0)))
    even = TURN / plant.lag  # spacing from where the dead time turns faster than COARSE
    bend = min(max(even / COARSE, first), math.pi)
    omega = np.geomspace(first, bend, math.ceil(math.log(bend / first) / COARSE) + 1)
    omega = np.union1d(omega, np.linspace(bend, math.pi, math.ceil((math.pi - bend) / even) + 1))
    for _ in range(DEEPEST):
        w = on_circle(omega)
        values = [polynomial(plant.a, w), polynomial(plant.b, w)]
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.max([np.abs(np.diff(x)) / np.minimum(np.abs(x[1:]), np.abs(x[:-1])) for x in values], axis=0)
        wide = (change > TURN) & (np.diff(omega) > 1e-12 * omega[1:])
        if not wide.any() or len(omega) > MOST_POINTS:
            break
        omega = np.union1d(omega, 0.5 * (omega[1:] + omega[:-1])[wide])
    return omega


def on_circle(omega: np.ndarray) -> np.ndarray:
    """w = exp(jω) - 1 without loss of digits at small ω, complex."""
    return np.asarray(-2.0 * np.sin(0.5 * omega) ** 2 + 1j * np.sin(omega))


def _response(plant: PulseTransfer) -> _Response:
    """The response on the grid; `turn_left`: by how much a still turns up to π; `beyond`: max|P| from a point on."""
    omega = frequency_grid(plant)
    w = on_circle(omega)
    a = polynomial(plant.a, w)
    b = polynomial(plant.b, w) * np.exp(-1j * plant.lag * omega)
    turn = np.unwrap(np.angle(a))
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.abs(b) / np.abs(a)
    beyond = np.maximum.accumulate(np.nan_to_num(size, nan=np.inf, posinf=np.inf)[::-1])[::-1]
    return _Response(omega, w, a, b, turn[-1] - turn, beyond.copy(), np.array(plant.a), np.array(plant.b), plant.lag)


@compiled
def _squared(x: Any) -> Any:
    return x.real * x.real + x.imag * x.imag


@compiled
def _quotient(x: Any, y: Any) -> Any:
    """x/y; not finite, instead of an exception, for y = 0."""
    return x * y.conjugate() * (1.0 / _squared(y))


@compiled
def _horner(coefficients: Any, w: Any) -> Any:
    """A polynomial and its first two derivatives at w."""
    value, slope, half_bend = 0j, 0j, 0j
    for i in range(coefficients.shape[0] - 1, -1, -1):
        half_bend = half_bend * w + slope
        slope = slope * w + value
        value = value * w + coefficients[i]
    return value, slope, 2.0 * half_bend


@compiled
def _value(coefficients: Any, w: Any) -> Any:
    """A polynomial at w."""
    value = 0j
    for i in range(coefficients.shape[0] - 1, -1, -1):
        value = value * w + coefficients[i]
    return value


@compiled
def _loop_at(a: Any, b: Any, w: Any, c: Any) -> Any:
    """Numerator and denominator of L at a point; c: K_p, h K_i, K_dh, s and v as constant and slope each."""
    kp, ki_h, kd_h, s0, s1, v0, v1 = c
    s = s0 + s1 * w
    v = v0 + v1 * w
    return b * (v * (kp * s + kd_h * w) + ki_h * s), a * v * s


@called
def _loop_at_frequency(response: Any, omega: Any, c: Any) -> Any:
    half = math.sin(0.5 * omega)
    w = complex(-2.0 * half * half, math.sin(omega))
    a, b = _value(response.a_polynomial, w), _value(response.b_polynomial, w)
    angle = response.lag * omega
    return _loop_at(a, b * complex(math.cos(angle), -math.sin(angle)), w, c)


@called
def _inverse(response: Any, omega: Any, c: Any, of_t: Any) -> Any:
    """1/|S|², or 1/|T|²."""
    n, d = _loop_at_frequency(response, omega, c)
    return _squared(n + d) / _squared(n if of_t else d)


@called
def _peak(response: Any, low: Any, middle: Any, high: Any, c: Any, of_t: Any) -> Any:
    """The largest |S|² or |T|² between two frequencies, and where.

    By parabolas through 1/|S|², which is nearly one where L passes -1, and golden sections where they do not serve.
    """
    x, f = middle, _inverse(response, middle, c, of_t)
    x2, f2 = low, _inverse(response, low, c, of_t)
    x3, f3 = high, _inverse(response, high, c, of_t)
    for _ in range(_PEAK_STEPS):
        r, q = (x - x2) * (f - f3), (x - x3) * (f - f2)
        across = 2.0 * (q - r)
        new = x - ((x - x3) * q - (x - x2) * r) / across if across != 0.0 else x
        if not low < new < high or abs(new - x) > 0.6 * (high - low):
            new = x + 0.381966 * ((high if high - x > x - low else low) - x)
        step = abs(new - x)
        if step < 1e-12 * x:
            break
        g = _inverse(response, new, c, of_t)
        gain = f - g
        if g <= f:
            if new > x:
                low = x
            else:
                high = x
            x3, f3, x2, f2, x, f = x2, f2, x, f, new, g
        else:
            if new > x:
                high = new
            else:
                low = new
            if f2 >= f3:
                x2, f2 = new, g
            else:
                x3, f3 = new, g
        if abs(gain) < _PEAK_WIDTH * f and step < 0.02 * (high - low) + 1e-3 * x:
            break
    return 1.0 / f, x


@called
def _half_turns(response: Any, c: Any, low: Any, p: Any, high: Any, q: Any) -> Any:
    """How often χ crosses the real axis between two frequencies, counter-clockwise positive; and if that is sure.

    p, q: χ at both. Halved until neighbours differ by less than a right angle.
    """
    turns = 0
    sure = True
    stack_x = np.empty(_DEPTH)
    stack_f = np.empty(_DEPTH, dtype=np.complex128)
    stack_x[0], stack_f[0] = high, q
    top = 0
    x, f = low, p
    while top >= 0:
        target, g = stack_x[top], stack_f[top]
        if f.real * g.real + f.imag * g.imag > 0.0 or top + 1 == _DEPTH:
            if not f.real * g.real + f.imag * g.imag > 0.0:
                sure = False
            turns += _crossing(f, g)
            x, f = target, g
            top -= 1
        else:
            top += 1
            middle = math.sqrt(x * target) if target > 4.0 * x and x > 0.0 else 0.5 * (x + target)
            n, d = _loop_at_frequency(response, middle, c)
            stack_x[top], stack_f[top] = middle, n + d
    return turns, sure


_DEPTH = 48


@compiled
def _crossing(p: Any, q: Any) -> Any:
    """Whether the straight line from p to q crosses the real axis: +1 counter-clockwise, -1 clockwise."""
    if (p.imag >= 0.0) == (q.imag >= 0.0):
        return 0
    return 1 if p.real * q.imag - p.imag * q.real > 0.0 else -1


@compiled
def _nearest(p: Any, q: Any) -> Any:
    """The least squared distance from 0 to the straight line from p to q."""
    step = q - p
    length = _squared(step)
    along = -(p.real * step.real + p.imag * step.imag)
    if 0.0 < along < length:
        cross = p.real * step.imag - p.imag * step.real
        return cross * cross / length
    return min(_squared(p), _squared(q))


@compiled
def _nearest_of(p: Any, q: Any, r: Any) -> Any:
    """The least squared distance from 0 to the straight lines from p to q and from q to r."""
    return min(_nearest(p, q), _nearest(q, r))


@called
def _keep(estimate: Any, index: Any, best: Any, where: Any) -> None:
    """Enter a peak into the list of the highest."""
    i = _SEGMENTS - 1
    if not estimate > best[i]:
        return
    while i > 0 and estimate > best[i - 1]:
        best[i], where[i] = best[i - 1], where[i - 1]
        i -= 1
    best[i], where[i] = estimate, index


@called
def _mode(response: Any, w: Any, c: Any, found: Any, count: Any) -> Any:
    """A zero of χ near w by Laguerre's method, those already found divided out; nan if it does not converge."""
    kp, ki_h, kd_h, s0, s1, v0, v1 = c
    lag = response.lag
    degree = response.a_polynomial.shape[0] + s1 + v1
    pd_slope = kp * s1 + kd_h
    for _ in range(_STEPS):
        z = 1.0 + w
        size = _squared(z)
        if not 0.01 < size < 100.0:
            break
        a, a1, a2 = _horner(response.a_polynomial, w)
        b, b1, b2 = _horner(response.b_polynomial, w)
        shrunk = math.exp(-0.5 * lag * math.log(size))
        angle = lag * math.atan2(z.imag, z.real)
        delay = complex(shrunk * math.cos(angle), -shrunk * math.sin(angle))
        back = z.conjugate() * (1.0 / size)
        s, v = s0 + s1 * w, v0 + v1 * w
        pd = kp * s + kd_h * w
        q, q1, q2 = v * s, v1 * s + v * s1, 2.0 * v1 * s1
        n, n1, n2 = v * pd + ki_h * s, v1 * pd + v * pd_slope + ki_h * s1, 2.0 * v1 * pd_slope
        g, g1, g2 = b * n, b1 * n + b * n1, b2 * n + 2.0 * b1 * n1 + b * n2
        value = a * q + delay * g
        if value == 0j:
            return w
        slope = a1 * q + a * q1 + delay * (g1 - lag * back * g)
        bend = a2 * q + 2.0 * a1 * q1 + a * q2
        bend += delay * (g2 - 2.0 * lag * back * g1 + lag * (lag + 1.0) * back * back * g)
        rate = _quotient(slope, value)
        spread = rate * rate - _quotient(bend, value)
        for i in range(count):
            other = _quotient(complex(1.0), w - found[i])
            rate -= other
            spread -= other * other
        root = cmath.sqrt((degree - 1.0) * (degree * spread - rate * rate))
        if _squared(rate - root) > _squared(rate + root):
            root = -root
        step = degree * _quotient(complex(1.0), rate + root)
        w = w - step
        if _squared(step) < 1e-18 * _squared(w):
            return w
    return complex(np.nan, np.nan)


@called
def _slowest(response: Any, starts: Any, c: Any, found: Any) -> Any:
    """The largest modulus of the modes that lie next to the starting points, frequencies; 0 stands for z = 1."""
    largest = 0.0
    count = 0
    for _ in range(2):
        for j in range(starts.shape[0]):
            if starts[j] < 0.0 or count == found.shape[0]:
                continue
            half = math.sin(0.5 * starts[j])
            w = _mode(response, complex(-2.0 * half * half, math.sin(starts[j])), c, found, count)
            if w.real != w.real:
                continue
            found[count] = w
            count += 1
            if w.imag != 0.0 and count < found.shape[0]:
                found[count] = w.conjugate()
                count += 1
            largest = max(largest, math.sqrt(_squared(1.0 + w)))
    return largest


@compiled
def _angle(x: Any) -> Any:
    return math.atan2(x.imag, x.real)


@called
def _crossover(response: Any, c: Any, margins: Any, lane: Any, low: Any, before: Any, high: Any, after: Any) -> None:
    """Take the margins of what L, known at two frequencies, crosses: the negative real axis, and the unit circle."""
    angle, turn, growth = _angle(before), _angle(after * before.conjugate()), _growth(before, after)
    if (before.imag >= 0.0) != (after.imag >= 0.0):
        to_axis = (math.pi if turn > 0.0 else -math.pi) - angle
        if abs(to_axis) <= abs(turn) and turn != 0.0:
            part = to_axis / turn
            meets = _loop_between(response, c, low, high, part)
            part -= _angle(-meets) / turn  # what is left to the axis, by the slope of the whole stretch
            meets = _loop_between(response, c, low, high, part)
            off = _angle(-meets)
            _gain(margins, lane, math.exp(0.5 * math.log(_squared(meets)) - off / turn * growth))
    size = 0.5 * math.log(_squared(before))
    if (size >= 0.0) != (size + growth >= 0.0):
        part = -size / growth
        meets = _loop_between(response, c, low, high, part)
        off = -0.5 * math.log(_squared(meets)) / growth
        ahead = _angle(meets) + off * turn + math.pi  # from -1 counter-clockwise to L
        ahead -= 2.0 * math.pi * math.floor(ahead / (2.0 * math.pi))
        margins[_PHASE, lane] = min(margins[_PHASE, lane], ahead, 2.0 * math.pi - ahead)
        omega = low * math.exp((part + off) * math.log(high / low))
        margins[_DELAY, lane] = min(margins[_DELAY, lane], ahead / omega)


@compiled
def _growth(before: Any, after: Any) -> Any:
    """ln|after/before|."""
    return 0.5 * math.log(_squared(after) / _squared(before))


@compiled
def _loop_between(response: Any, c: Any, low: Any, high: Any, part: Any) -> Any:
    """L at a part of the way between two frequencies, on a logarithmic scale."""
    n, d = _loop_at_frequency(response, low * math.exp(part * math.log(high / low)), c)
    return _quotient(n, d)


@called
def _gain(margins: Any, lane: Any, size: Any) -> None:
    """Take the gain margin of L = -size."""
    if size <= 1.0:
        margins[_GAIN, lane] = min(margins[_GAIN, lane], 1.0 / size)
    else:
        margins[_GAIN_LOW, lane] = max(margins[_GAIN_LOW, lane], 1.0 / size)


@entry_point
def _screen_lanes(response: Any, kp: Any, ki_h: Any, kd_h: Any, phi: Any, modes_too: Any, found: Any) -> None:
    """The margins of every lane: gains (lanes,), found (_RESULTS, lanes)."""
    points = response.omega.shape[0]
    order = response.a_polynomial.shape[0] - 1
    best_s, best_t = np.empty(_SEGMENTS), np.empty(_SEGMENTS)
    where_s, where_t = np.empty(_SEGMENTS, dtype=np.int64), np.empty(_SEGMENTS, dtype=np.int64)
    modes = np.empty(8, dtype=np.complex128)
    starts = np.empty(_SEGMENTS + 1)
    for lane in range(kp.shape[0]):
        s0, s1 = (1.0 - phi[lane], 1.0) if kd_h[lane] != 0.0 else (1.0, 0.0)
        v0, v1 = (0.0, 1.0) if ki_h[lane] != 0.0 else (1.0, 0.0)
        c = (kp[lane], ki_h[lane], kd_h[lane], s0, s1, v0, v1)
        zeros = order + s1 + v1
        found[:, lane] = np.nan
        found[_STABLE, lane] = 0.0
        margins = found
        margins[_GAIN, lane] = margins[_PHASE, lane] = margins[_DELAY, lane] = np.inf
        margins[_GAIN_LOW, lane] = 0.0
        best_s[:], best_t[:] = 0.0, 0.0
        where_s[:], where_t[:] = -1, -1

        n, d = _loop_at(complex(response.a_polynomial[0]), complex(response.b_polynomial[0]), 0j, c)
        before = n + d
        if before.real == 0.0:
            margins[_STABLE + 1 :, lane] = np.nan  # a mode at z = 1
            continue
        sign = 1.0 if before.real > 0.0 else -1.0
        if d.real != 0.0 and n.real / d.real < 0.0:
            _gain(margins, lane, -n.real / d.real)
        highest_s = _squared(d) / _squared(before)
        highest_t = _squared(n) / _squared(before)
        kp_size, ki_size, kd_size = abs(kp[lane]), abs(ki_h[lane]), abs(kd_h[lane])
        before *= sign
        two_before, loop_before, omega_before = before, 0j, 0.0
        s_before, t_before, s_rises, t_rises = highest_s, highest_t, False, False
        outside_before = False
        half_turns = 0
        sure = True
        finished = False
        for i in range(points):
            n, d = _loop_at(response.a[i], response.b[i], response.w[i], c)
            chi = (n + d) * sign
            omega = response.omega[i]
            if i == points - 1:
                chi = complex(chi.real, 0.0)
            if before.real * chi.real + before.imag * chi.imag > 0.0:
                half_turns += _crossing(before, chi)
            else:
                turns, resolved = _half_turns(response, c, omega_before, before * sign, omega, chi * sign)
                half_turns += turns
                sure = sure and resolved
            size = _squared(chi)
            if size == 0.0:
                sure = False
                break
            squared, n_squared, inverse = _squared(d), _squared(n), 1.0 / size
            s_size, t_size = squared * inverse, n_squared * inverse
            if s_rises and s_size < s_before:
                _keep(s_before * _squared(before) / _nearest_of(two_before, before, chi), i - 1, best_s, where_s)
            if t_rises and t_size < t_before:
                _keep(t_before * _squared(before) / _nearest_of(two_before, before, chi), i - 1, best_t, where_t)
            s_rises, t_rises = s_size >= s_before, t_size >= t_before
            highest_s, highest_t = max(highest_s, s_size), max(highest_t, t_size)
            loop = n * d.conjugate()
            outside = n_squared >= squared
            if i > 0 and ((loop.imag >= 0.0) != (loop_before.imag >= 0.0) or outside != outside_before):
                n_before, d_before = _loop_at(response.a[i - 1], response.b[i - 1], response.w[i - 1], c)
                _crossover(
                    response, c, margins, lane, omega_before, _quotient(n_before, d_before), omega, _quotient(n, d)
                )
            two_before, before, loop_before, omega_before = before, chi, loop, omega
            s_before, t_before, outside_before = s_size, t_size, outside
            if i % 16 == 0 and i < points - 1:
                # |L| from here on, w growing and with it w/s: where it is too small to matter, the rest is passed over.
                w_size, s_size = math.sqrt(_squared(response.w[i])), math.sqrt(_squared(s0 + s1 * response.w[i]))
                last_s = abs(s0 - 2.0 * s1)
                steepest = max(w_size / s_size, 2.0 / last_s)
                largest = response.beyond[i] * (kp_size + ki_size / w_size + kd_size * steepest)
                if largest < 0.9 and largest * margins[_GAIN, lane] < 1.0:
                    top_s, top_t = math.sqrt(highest_s), math.sqrt(highest_t)
                    if 1.0 / (1.0 - largest) < top_s and largest / (1.0 - largest) < top_t:
                        turned = math.atan2(chi.imag, chi.real)
                        turned = half_turns * math.pi + (turned if chi.imag >= 0.0 else turned + math.pi)
                        turned += response.turn_left[i] - _angle((n + d) * d.conjugate())
                        if s1 > 0.0:
                            turned += math.pi - _angle(s0 + response.w[i])
                        if v1 > 0.0:
                            turned += math.pi - _angle(response.w[i])
                        finished = abs(turned - zeros * math.pi) < 0.5
                        break
        else:
            # χ(π) is real: its argument is half_turns π or the next multiple, the one of its sign.
            even = half_turns % 2 == 0
            last = half_turns if (before.real > 0.0) == even else half_turns + 1
            finished = last == zeros
            if n.real * d.real < 0.0:
                _gain(margins, lane, -n.real / d.real)
            if outside_before:  # |L| >= 1 at half the sampling frequency, too: one more sample turns it about -1
                margins[_DELAY, lane] = min(margins[_DELAY, lane], 1.0)
        if not (finished and sure):
            margins[_STABLE + 1 :, lane] = np.nan
            continue
        starts[0] = 0.0
        for k in range(_SEGMENTS):
            starts[k + 1] = -1.0
            i = where_s[k]
            if i >= 0 and best_s[k] > 0.9 * highest_s:
                low = response.omega[i - 1] if i > 0 else 0.0
                top, starts[k + 1] = _peak(response, low, response.omega[i], response.omega[i + 1], c, False)
                highest_s = max(highest_s, top)
            i = where_t[k]
            if i >= 0 and best_t[k] > 0.9 * highest_t:
                low = response.omega[i - 1] if i > 0 else 0.0
                highest_t = max(highest_t, _peak(response, low, response.omega[i], response.omega[i + 1], c, True)[0])
        radius = _slowest(response, starts, c, modes) if modes_too else np.nan
        if radius >= 1.0 - _NEAREST or highest_s > 1.0 / (_NEAREST * _NEAREST):
            margins[_STABLE + 1 :, lane] = np.nan
            continue
        margins[_STABLE, lane] = 1.0
        margins[_MS, lane], margins[_MT, lane] = math.sqrt(highest_s), math.sqrt(highest_t)
        margins[_RADIUS, lane] = radius
