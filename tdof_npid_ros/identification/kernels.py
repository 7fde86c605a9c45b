"""The compiled side of identification: one pass over a record gives the normal equations of a least-squares step.

A model is den(s) x = u(t - dead time) in controllable form, with time in units of `scale`: x[0] is u/den, x[1] its
derivative, …; the output is a combination of the first two. The input is held between stamps, so every step is exact,
whatever the dead time and the stamps are. A pass keeps one block of rows: memory does not grow with the record.

The base system (index 0) gives the columns of the linear parameters. Each further system is the same model with one
parameter a little changed: the difference of its residual is the column of that parameter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.compiled import compiled, entry_point

STATES = 3  # of the largest order; smaller ones are padded with zeros, so that a state lives in registers
BLOCK = 256  # rows that are kept at once
TABLE = 96  # steps of the table of transitions for uneven stamps
TABLE_STEPS_PER_PERIOD = 32
RIDGE = 1e-13  # of scaled normal equations: a column that is nothing, or a combination of others, gets next to nothing


class Systems(NamedTuple):
    """Models that are run side by side: the base and its variations; first index: the system.

    Attributes:
        phi, gamma: one sample on, (systems, STATES, STATES) and (systems, STATES).
        gamma_old, gamma_new: of the input `delay + 1` and `delay` samples ago, (systems, STATES).
        delay: whole samples of dead time, (systems,).
        dead_time: s, (systems,).
        load_time: when a load step reaches the plant, s, (systems,); infinity without one.
        load_index: the first sample that a load step moves, (systems,).
        load_first: what a load step gives until then, (systems, STATES).
        growth: of an unstable model's pole over one sample, (systems,); 1 for others.
        a: denominator without its leading 1, lowest power first, (systems, order).
        scale: s, (systems,).
        table_phi, table_gamma: transitions over 0, 1, … table steps, (systems, TABLE, STATES, STATES) and (systems,
            TABLE, STATES); empty for even stamps.
    """

    phi: np.ndarray
    gamma: np.ndarray
    gamma_old: np.ndarray
    gamma_new: np.ndarray
    delay: np.ndarray
    dead_time: np.ndarray
    load_time: np.ndarray
    load_index: np.ndarray
    load_first: np.ndarray
    growth: np.ndarray
    a: np.ndarray
    scale: np.ndarray
    table_phi: np.ndarray
    table_gamma: np.ndarray


class Coefficients(NamedTuple):
    """The linear parameters at which residuals are taken.

    Attributes:
        numerator: of x[0], x[1], (numerators,).
        initial: of the free response, (order,), or fewer for a start from rest.
        level: of the constant or, for an integrating model, the ramp, (levels,).
        load: size of the load step, in units of the effort.
    """

    numerator: np.ndarray
    initial: np.ndarray
    level: np.ndarray
    load: float


class Data(NamedTuple):
    """A stretch of a record.

    Attributes:
        time: s from 0 on, (samples,).
        effort: held from each stamp on, less the effort before the record, (samples,).
        output: (samples,).
        used: which samples count, (samples,).
        even: whether the stamps are even, every `period` s.
        period: s.
    """

    time: np.ndarray
    effort: np.ndarray
    output: np.ndarray
    used: np.ndarray
    even: bool
    period: float


class Form(NamedTuple):
    """What kind of rows a pass makes.

    Attributes:
        integrating, unstable: of the model.
        loaded: whether there is a load step.
        sensitivities: whether to give the columns of the nonlinear parameters, and residuals instead of outputs.
    """

    integrating: bool
    unstable: bool
    loaded: bool
    sensitivities: bool


@compiled
def _transition(a: Any, time: Any, phi: Any, gamma: Any) -> None:
    """The state `time` on, in units of the scale, under a held input: the exponential's series, scaled and squared."""
    n = a.shape[0]
    size = n + 1
    norm = 1.0
    for i in range(n):
        norm += abs(a[i])
    squarings = 0
    step = time
    while abs(step) * norm > 0.5:
        step *= 0.5
        squarings += 1
    m = np.zeros((size, size))
    for i in range(n - 1):
        m[i, i + 1] = step
    for i in range(n):
        m[n - 1, i] = -a[i] * step
    m[n - 1, n] = step
    total = np.eye(size)
    term = np.eye(size)
    for power in range(1, 15):
        term = _product(term, m)
        for i in range(size):
            for j in range(size):
                term[i, j] /= power
                total[i, j] += term[i, j]
    for _ in range(squarings):
        total = _product(total, total)
    for i in range(n):
        gamma[i] = total[i, n]
        for j in range(n):
            phi[i, j] = total[i, j]


@compiled
def _product(a: Any, b: Any) -> Any:
    n = a.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            for j in range(n):
                out[i, j] += a[i, k] * b[k, j]
    return out


@entry_point
def prepare(systems: Any, period: Any, even: Any, unstable: Any) -> None:
    """Fill in the transitions of `systems` from their `a`, `scale`, `dead_time` and `load_time`."""
    count, n = systems.a.shape
    late_phi, late_gamma = np.zeros((STATES, STATES)), np.zeros(STATES)
    rest_phi, rest_gamma = np.zeros((STATES, STATES)), np.zeros(STATES)
    for p in range(count):
        a, scale = systems.a[p], systems.scale[p]
        _transition(a, period / scale, systems.phi[p], systems.gamma[p])
        delay = np.floor(systems.dead_time[p] / period)
        late = systems.dead_time[p] - delay * period
        systems.delay[p] = int(delay)
        _transition(a, late / scale, late_phi, late_gamma)
        _transition(a, (period - late) / scale, rest_phi, rest_gamma)
        for i in range(n):
            systems.gamma_new[p, i] = rest_gamma[i]
            systems.gamma_old[p, i] = 0.0
            for j in range(n):
                systems.gamma_old[p, i] += rest_phi[i, j] * late_gamma[j]
        load = systems.load_time[p]
        systems.load_index[p] = -1
        if load < np.inf:
            index = np.ceil(load / period)
            systems.load_index[p] = int(index)
            _transition(a, (index * period - load) / scale, rest_phi, systems.load_first[p])
        if unstable:
            systems.growth[p] = systems.phi[p, 0, 0]
            systems.phi[p, 0, 0] = 1.0 / systems.growth[p]
        if not even:
            step = period / TABLE_STEPS_PER_PERIOD
            _transition(a, step / scale, late_phi, late_gamma)
            for i in range(n):
                systems.table_phi[p, 0, i, i] = 1.0
            for q in range(1, TABLE):
                systems.table_phi[p, q] = _product(late_phi, systems.table_phi[p, q - 1])
                for i in range(n):
                    total = late_gamma[i]
                    for j in range(n):
                        total += late_phi[i, j] * systems.table_gamma[p, q - 1, j]
                    systems.table_gamma[p, q, i] = total


@compiled
def _run_even(
    first: Any, last: Any, x: Any, phi: Any, old: Any, new: Any, delay: Any, effort: Any, scale: Any, out: Any
) -> None:
    """The forced response of samples first to last - 1, x[0] and x[1] to `out`; x goes on to `last`."""
    a00, a01, a02 = phi[0, 0], phi[0, 1], phi[0, 2]
    a10, a11, a12 = phi[1, 0], phi[1, 1], phi[1, 2]
    a20, a21, a22 = phi[2, 0], phi[2, 1], phi[2, 2]
    o0, o1, o2 = old[0], old[1], old[2]
    n0, n1, n2 = new[0], new[1], new[2]
    x0, x1, x2 = x[0], x[1], x[2]
    v_old = scale * effort[first - delay - 1] if first - delay >= 1 else 0.0
    for k in range(first, last):
        out[0, k - first] = x0
        out[1, k - first] = x1
        v_new = scale * effort[k - delay] if k >= delay else 0.0
        y0 = a00 * x0 + a01 * x1 + a02 * x2 + (o0 * v_old + n0 * v_new)
        y1 = a10 * x0 + a11 * x1 + a12 * x2 + (o1 * v_old + n1 * v_new)
        x2 = a20 * x0 + a21 * x1 + a22 * x2 + (o2 * v_old + n2 * v_new)
        x0, x1 = y0, y1
        v_old = v_new
    x[0], x[1], x[2] = x0, x1, x2


@compiled
def _run_load(first: Any, last: Any, x: Any, phi: Any, gamma: Any, index: Any, at_index: Any, out: Any) -> None:
    """The response to a load step of 1 that moves the samples from `index` on; as `_run_even`."""
    for k in range(first, last):
        if k == index:
            for i in range(STATES):
                x[i] = at_index[i]
        out[0, k - first] = x[0]
        out[1, k - first] = x[1]
        if k >= index:
            y0 = phi[0, 0] * x[0] + phi[0, 1] * x[1] + phi[0, 2] * x[2] + gamma[0]
            y1 = phi[1, 0] * x[0] + phi[1, 1] * x[1] + phi[1, 2] * x[2] + gamma[1]
            x[2] = phi[2, 0] * x[0] + phi[2, 1] * x[1] + phi[2, 2] * x[2] + gamma[2]
            x[0], x[1] = y0, y1


@compiled
def _run_free(first: Any, last: Any, x: Any, phi: Any, out: Any) -> None:
    """The free response, x[0] to `out`; as `_run_even`."""
    a00, a01, a02 = phi[0, 0], phi[0, 1], phi[0, 2]
    a10, a11, a12 = phi[1, 0], phi[1, 1], phi[1, 2]
    a20, a21, a22 = phi[2, 0], phi[2, 1], phi[2, 2]
    x0, x1, x2 = x[0], x[1], x[2]
    for k in range(first, last):
        out[k - first] = x0
        y0 = a00 * x0 + a01 * x1 + a02 * x2
        y1 = a10 * x0 + a11 * x1 + a12 * x2
        x2 = a20 * x0 + a21 * x1 + a22 * x2
        x0, x1 = y0, y1
    x[0], x[1], x[2] = x0, x1, x2


@compiled
def _advance_by(x: Any, v: Any, time: Any, a: Any, scale: Any, phi: Any, gamma: Any, table_step: Any) -> None:
    """x any `time` on under the input v: whole steps of the table, and the rest to third order."""
    n = a.shape[0]
    a0 = a[0]
    a1 = a[1] if n > 1 else 0.0
    a2 = a[2] if n > 2 else 0.0
    while time > 0.0:
        q = min(int(time / table_step + 0.5), TABLE - 1)
        rest = time - q * table_step
        if q == TABLE - 1:
            rest = min(rest, 0.5 * table_step)
        time -= q * table_step + rest
        rest /= scale
        d0, d1, d2 = x[0], x[1], x[2]
        force, factor = v, 1.0
        for power in range(1, 4):
            factor *= rest / power
            top = force - (a0 * d0 + a1 * d1 + a2 * d2)
            if n == 1:
                d0 = top
            elif n == 2:
                d0, d1 = d1, top
            else:
                d0, d1, d2 = d1, d2, top
            x[0] += factor * d0
            x[1] += factor * d1
            x[2] += factor * d2
            force = 0.0
        y0 = phi[q, 0, 0] * x[0] + phi[q, 0, 1] * x[1] + phi[q, 0, 2] * x[2] + gamma[q, 0] * v
        y1 = phi[q, 1, 0] * x[0] + phi[q, 1, 1] * x[1] + phi[q, 1, 2] * x[2] + gamma[q, 1] * v
        y2 = phi[q, 2, 0] * x[0] + phi[q, 2, 1] * x[1] + phi[q, 2, 2] * x[2] + gamma[q, 2] * v
        x[0], x[1], x[2] = y0, y1, y2
        if abs(time) < 1e-9 * table_step:
            break


@compiled
def _run_uneven(
    first: Any, last: Any, x: Any, time: Any, effort: Any, effort_scale: Any, load_scale: Any, begin: Any,
    dead_time: Any, load_time: Any, a: Any, scale: Any, phi: Any, gamma: Any, table_step: Any, unstable: Any, out: Any,
) -> Any:  # fmt: skip
    """As `_run_even` for uneven stamps, with or without effort and load; `begin`: the newest effort at hand."""
    samples = time.shape[0]
    for k in range(first, last):
        out[0, k - first] = x[0]
        out[1, k - first] = x[1]
        if k + 1 == samples:
            break
        now, end, before = time[k], time[k + 1], x[0]
        while now < end:
            until = end
            v = 0.0
            if effort_scale != 0.0:
                while begin + 1 < samples and time[begin + 1] + dead_time <= now:
                    begin += 1
                if begin + 1 < samples:
                    until = min(until, time[begin + 1] + dead_time)
                v = effort_scale * effort[begin] if begin >= 0 else 0.0
            if load_scale != 0.0:
                if now >= load_time:
                    v += load_scale
                else:
                    until = min(until, load_time)
            _advance_by(x, v, until - now, a, scale, phi, gamma, table_step)
            now = until
        if unstable:  # the stable predictor, as phi = 1/growth has it for even stamps
            growth = np.exp((end - time[k]) / scale)
            x[0] += (1.0 / growth - growth) * before
    return begin


@compiled
def _filtered(first: Any, last: Any, data: Any, before: Any, growth: Any, scale: Any, out: Any) -> Any:
    """The output for the predictor of an unstable model: less its pole, over the mirrored pole."""
    y = data.output
    for k in range(first, last):
        if k == 0:
            before = y[0]
        else:
            if not data.even:
                growth = np.exp((data.time[k] - data.time[k - 1]) / scale)
            before = y[k] - growth * y[k - 1] + before / growth
        out[k - first] = before
    return before


@entry_point
def accumulate(data: Any, systems: Any, form: Any, at: Any, whitening: Any, gram: Any, residual: Any) -> None:
    """One pass over a stretch: gram += sum of row · row', over the rows that are used.

    A row is: the numerator's columns; with sensitivities, one column per variation, then one of the load's size;
    the free response's; the level's; last the output, or with sensitivities the residual, which is kept too.

    Args:
        whitening: row k less these times the rows k - 1, k - 2, …, (lags,).
        gram: (columns, columns).
        residual: of each sample, not whitened, (samples,), or empty.
    """
    samples, columns, lags = data.time.shape[0], gram.shape[0], whitening.shape[0]
    count = systems.scale.shape[0]
    numerators, frees, levels = at.numerator.shape[0], at.initial.shape[0], at.level.shape[0]
    x, s = np.zeros((count, STATES)), np.zeros((count, STATES))
    free, free_columns = np.zeros((count, STATES)), np.eye(STATES)
    for i in range(frees):
        free[:, i] = at.initial[i]
    filtered_before, begins = np.zeros(count), np.full(count, -1)
    forced, load, free_out = np.zeros((2, BLOCK)), np.zeros((2, BLOCK)), np.zeros((2, BLOCK))
    filtered, base = np.zeros(BLOCK), np.zeros(BLOCK)
    rows = np.zeros((columns, lags + BLOCK))  # the lags before the block stand first
    white = np.zeros((columns, BLOCK))
    step = data.period / TABLE_STEPS_PER_PERIOD
    span = data.time[samples - 1] if samples > 1 else 1.0
    for first in range(0, samples, BLOCK):
        last = min(first + BLOCK, samples)
        size = last - first
        level_at = columns - 1 - levels
        for j in range(size):
            level = data.time[first + j] / span if form.integrating else 1.0
            for i in range(levels):
                rows[level_at + i, lags + j] = level
        for i in range(frees):
            if data.even:
                _run_free(first, last, free_columns[i], systems.phi[0], free_out[0])
            else:
                _run_uneven(first, last, free_columns[i], data.time, data.effort, 0.0, 0.0, -1, 0.0, 0.0,
                            systems.a[0], systems.scale[0], systems.table_phi[0], systems.table_gamma[0], step,
                            form.unstable, free_out)  # fmt: skip
            for j in range(size):
                rows[level_at - frees + i, lags + j] = free_out[0, j]
        for p in range(count):
            phi, scale = systems.phi[p], systems.scale[p]
            if data.even:
                _run_even(first, last, x[p], phi, systems.gamma_old[p], systems.gamma_new[p], systems.delay[p],
                          data.effort, 1.0, forced)  # fmt: skip
            else:
                begins[p] = _run_uneven(first, last, x[p], data.time, data.effort, 1.0, 0.0, begins[p],
                                        systems.dead_time[p], 0.0, systems.a[p], scale, systems.table_phi[p],
                                        systems.table_gamma[p], step, form.unstable, forced)  # fmt: skip
            if form.loaded:
                if data.even:
                    _run_load(
                        first, last, s[p], phi, systems.gamma[p], systems.load_index[p], systems.load_first[p], load
                    )
                else:
                    _run_uneven(first, last, s[p], data.time, data.effort, 0.0, 1.0, -1, 0.0,
                                systems.load_time[p], systems.a[p], scale, systems.table_phi[p],
                                systems.table_gamma[p], step, form.unstable, load)  # fmt: skip
                for i in range(numerators):
                    for j in range(size):
                        forced[i, j] += at.load * load[i, j]
            if form.unstable:
                filtered_before[p] = _filtered(
                    first, last, data, filtered_before[p], systems.growth[p], scale, filtered
                )
            else:
                for j in range(size):
                    filtered[j] = data.output[first + j]
            if form.sensitivities:
                if frees:
                    if data.even:
                        _run_free(first, last, free[p], phi, free_out[0])
                    else:
                        _run_uneven(first, last, free[p], data.time, data.effort, 0.0, 0.0, -1, 0.0, 0.0,
                                    systems.a[p], scale, systems.table_phi[p], systems.table_gamma[p], step,
                                    form.unstable, free_out)  # fmt: skip
                    for j in range(size):
                        filtered[j] -= free_out[0, j]
                for i in range(numerators):
                    for j in range(size):
                        filtered[j] -= at.numerator[i] * forced[i, j]
                for i in range(levels):
                    for j in range(size):
                        filtered[j] -= at.level[i] * rows[level_at + i, lags + j]
            if p == 0:
                for i in range(numerators):
                    for j in range(size):
                        rows[i, lags + j] = forced[i, j]
                for j in range(size):
                    base[j] = filtered[j]
                    rows[columns - 1, lags + j] = filtered[j]
                if form.sensitivities and form.loaded:
                    for j in range(size):
                        total = 0.0
                        for i in range(numerators):
                            total += at.numerator[i] * load[i, j]
                        rows[numerators + count - 1, lags + j] = total
            else:
                for j in range(size):
                    rows[numerators + p - 1, lags + j] = base[j] - filtered[j]
        if residual.shape[0]:
            residual[first:last] = base[:size]
        for i in range(columns):
            for j in range(size):
                white[i, j] = rows[i, lags + j]
            for lag in range(lags):
                for j in range(size):
                    white[i, j] -= whitening[lag] * rows[i, lags + j - 1 - lag]
            for j in range(size):
                if not data.used[first + j] or first + j < lags:
                    white[i, j] = 0.0
            for j in range(size, BLOCK):
                white[i, j] = 0.0
            for j in range(lags):
                rows[i, j] = rows[i, size + j]
        gram += np.dot(white, white.T)


@compiled
def _solved(matrix: Any, right: Any) -> Any:
    """Solve symmetric normal equations, (n, n) and (n, columns), scaled and with a ridge, by Cholesky's method."""
    n, columns = right.shape
    scale = np.ones(n)
    for i in range(n):
        if matrix[i, i] > 0.0:
            scale[i] = np.sqrt(matrix[i, i])
    lower = np.zeros((n, n))
    out = np.zeros((n, columns))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] / (scale[i] * scale[j])
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = np.sqrt(max(total, 0.0) + RIDGE)
            else:
                lower[i, j] = total / lower[j, j]
        for c in range(columns):
            total = right[i, c] / scale[i]
            for k in range(i):
                total -= lower[i, k] * out[k, c]
            out[i, c] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(columns):
            total = out[i, c]
            for k in range(i + 1, n):
                total -= lower[k, i] * out[k, c]
            out[i, c] = total / lower[i, i]
    for i in range(n):
        for c in range(columns):
            out[i, c] /= scale[i]
    return out


@entry_point
def solved(matrix: Any, right: Any) -> Any:
    """Solve symmetric normal equations, (n, n) and (n, columns)."""
    return _solved(matrix, right)


@compiled
def _eliminated(gram: Any, shared: Any) -> Any:
    """Normal equations, [shared, nuisance, right side], without the nuisance parameters; and how those follow."""
    size = gram.shape[0]
    inner = size - 1 - shared
    right = np.zeros((inner, shared + 1))
    for i in range(inner):
        for j in range(shared):
            right[i, j] = gram[shared + i, j]
        right[i, shared] = gram[shared + i, size - 1]
    follow = _solved(gram[shared : size - 1, shared : size - 1], right)
    rest = np.zeros((shared + 1, shared + 1))
    for i in range(shared + 1):
        for j in range(shared + 1):
            total = gram[i if i < shared else size - 1, j if j < shared else size - 1]
            for k in range(inner):
                total -= right[k, i] * follow[k, j]
            rest[i, j] = total
    return rest, follow


@entry_point
def eliminated(gram: Any, shared: Any) -> Any:
    """Normal equations without the nuisance parameters, (shared + 1)², and how those follow from the shared."""
    return _eliminated(gram, shared)


@entry_point
def grid_values(data: Any, systems: Any, form: Any, at: Any, whitening: Any, rests: Any) -> None:
    """At every system as a base of its own: rests[system] += the numerator's normal equations, (numerators + 1)²."""
    numerators = at.numerator.shape[0]
    size = numerators + at.initial.shape[0] + at.level.shape[0] + 1
    for p in range(systems.scale.shape[0]):
        one = slice(p, p + 1)
        base = Systems(
            systems.phi[one], systems.gamma[one], systems.gamma_old[one], systems.gamma_new[one], systems.delay[one],
            systems.dead_time[one], systems.load_time[one], systems.load_index[one], systems.load_first[one],
            systems.growth[one], systems.a[one], systems.scale[one], systems.table_phi[one], systems.table_gamma[one],
        )  # fmt: skip
        gram = np.zeros((size, size))
        accumulate(data, base, form, at, whitening, gram, np.zeros(0))
        rest, _ = _eliminated(gram, numerators)
        rests[p] += rest


@entry_point
def residual_sums(rests: Any) -> Any:
    """The residual sum of squares at the best numerator, for each of `rests`, (points,)."""
    points, size, _ = rests.shape
    out = np.zeros(points)
    for p in range(points):
        matrix, right = rests[p, : size - 1, : size - 1], rests[p, : size - 1, size - 1 :]
        best = _solved(matrix, right)
        out[p] = rests[p, size - 1, size - 1]
        for i in range(size - 1):
            out[p] -= best[i, 0] * right[i, 0]
    return out
