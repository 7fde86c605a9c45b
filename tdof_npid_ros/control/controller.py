"""The controller: the law with its state and its options, answering each output once.

It knows no ROS. The controller node calls `answer` for each message, `verify` for each message of a bag.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields
from functools import lru_cache

import numpy as np

from tdof_npid_ros.control.gains import LIMITS_PER_LANE, Gains
from tdof_npid_ros.control.law import (
    ALPHA,
    BETA,
    KD_H,
    KI_H,
    KP,
    TERMS,
    answer_lanes,
    any_at_limit,
    coefficients,
    conditional_integration,
    limits_of,
    settled,
    unwinding_of,
)
from tdof_npid_ros.control.options import PLAIN, ControllerOptions
from tdof_npid_ros.control.shaping import EFFORT, OUTPUT, SETPOINT, STATES, shape_lanes, shape_of

(INTEGRAL, FILTER) = range(2)  # rows of the law's state


class Controller:
    """A sampled TDOF-NPID controller for one lane or many.

    A change of parameters and a start within a running loop take effect at the next answer. So the answers depend on
    nothing but the sequence of what was answered with what, and `verify` finds them again.

    Attributes:
        effort: the latest answer u, (lanes,).
        terms: of the latest answer, (6, lanes): see `TERMS`.
        stamp_ns: of the output that the latest answer was for; None before the first.
        gains, options: the parameters of the next answer.
    """

    def __init__(self, gains: Gains, sample_period_ns: int, options: ControllerOptions = PLAIN) -> None:
        self.sample_period_ns = sample_period_ns
        self.stamp_ns: int | None = None
        self._applied: np.ndarray | None = None
        self._integral: np.ndarray | None = None
        self._rest: np.ndarray | None = None
        options.check_lanes(gains)
        self._law = _Law(gains, options, sample_period_ns)
        self._allocate()
        self.change(gains, options)

    @property
    def lanes(self) -> int:
        """Number of independent loops."""
        return self.gains.lanes

    @property
    def digest(self) -> str:
        """The name of the parameters that answers are computed with."""
        return self._digest

    @property
    def integral(self) -> np.ndarray:
        """The integral action as the next answer will find it, (lanes,)."""
        return np.array(self._state[INTEGRAL])

    @property
    def integral_before(self) -> np.ndarray:
        """The integral action that the latest answer was computed with, (lanes,)."""
        return np.asarray(self.terms[TERMS.index("integral")])

    @property
    def saturated(self) -> bool:
        """Whether the latest answer is at the effort's limits, in any lane."""
        return bool(any_at_limit(self.effort, self._law.least, self._law.most))

    def change(self, gains: Gains, options: ControllerOptions) -> None:
        """Go on with other parameters. The state is kept, unless the number of lanes changes.

        Raises:
            GainsError: the two do not fit together.
        """
        options.check_lanes(gains)
        self.gains, self.options = gains, options
        self._digest = parameters_digest(gains, self.sample_period_ns, options)
        self._settled = False
        if gains.lanes != self._law.gains.lanes:
            self._law = _Law(gains, options, self.sample_period_ns)
            self._allocate()

    def change_gains(self, gains: Gains) -> None:
        """Go on with other gains, operated as before."""
        self.change(gains, self.options)

    def reset(self) -> None:
        """Forget the state and the latest answer."""
        self._state[:] = 0.0
        self.stamp_ns = None
        self._applied = self._integral = self._rest = None
        self._settled = False

    def warm_up(self) -> None:
        """Compile all that an answer may need, so that no answer waits for it; for a controller at its start."""
        nothing = np.zeros(self.lanes)
        self.begin_within(nothing)
        self.answer(0, nothing, nothing)
        any_at_limit(nothing, nothing, nothing)
        self.reset()

    def begin_within(self, applied: np.ndarray, integral: np.ndarray | None = None) -> None:
        """Let the next answer begin within a running loop, without a jump.

        Args:
            applied: the effort that the plant has now, (lanes,).
            integral: the integral action to begin with, (lanes,); None: the one with which the answer is `applied`.
        """
        self.stamp_ns = None
        self._applied, self._integral, self._rest = applied, integral, None
        self._settled = False

    def begin_at_rest(self, applied: np.ndarray, setpoint: np.ndarray) -> None:
        """Let the next answer begin settled: at this setpoint, with the effort that the plant rests with.

        Args:
            applied, setpoint: (lanes,).
        """
        self.begin_within(applied)
        self._rest = setpoint

    def answer(self, stamp_ns: int, setpoint: np.ndarray, output: np.ndarray) -> np.ndarray:
        """The answer u to the output of `stamp_ns`, (lanes,): `effort`, which the next answer overwrites.

        The same stamp again leaves everything as it is, so the answer is the same and no state advances.

        Args:
            setpoint, output: (lanes,), finite.
        """
        if stamp_ns == self.stamp_ns:
            return self.effort
        if not self._settled:
            self._settle(setpoint, output)
        self.stamp_ns = stamp_ns
        self._law.answer(setpoint, output, self._state, self._shaping, self.effort, self.terms)
        self._latest = setpoint, output
        return self.effort

    def _allocate(self) -> None:
        lanes = self._law.gains.lanes
        self.stamp_ns = self._applied = self._integral = self._rest = None
        self._state = np.zeros((2, lanes))
        self._shaping = np.zeros((STATES, lanes))
        self._latest = np.zeros(lanes), np.zeros(lanes)
        self.effort: np.ndarray = np.zeros(lanes)
        self.terms: np.ndarray = np.zeros((len(TERMS), lanes))
        self._settled = False

    def _settle(self, setpoint: np.ndarray, output: np.ndarray) -> None:
        """Before an answer: begin, or take over changed parameters."""
        before, self._settled = self._law, True
        if (before.gains, before.options) != (self.gains, self.options):
            self._law = _Law(self.gains, self.options, self.sample_period_ns)
        if self.stamp_ns is None:
            self._begin(setpoint, output)
        elif self._law is not before:
            self._take_over(before, setpoint, output)

    def _begin(self, setpoint: np.ndarray, output: np.ndarray) -> None:
        law, applied = self._law, self._applied
        if self._rest is not None:
            setpoint = self._rest
        ramps = law.shape.setpoint_step < np.inf and self._rest is None
        self._shaping[SETPOINT] = output if ramps else setpoint
        self._shaping[OUTPUT] = output
        self._shaping[EFFORT] = 0.0 if applied is None else applied
        if applied is None:
            return
        r, y = law.shaped(setpoint, output, self._shaping)
        self._state[:] = settled(law.c, law.gains, r, y, applied)
        if self._integral is not None:
            self._state[INTEGRAL] = law.integral(self._integral, 0.0)
        self._applied = self._integral = self._rest = None

    def _take_over(self, before: _Law, setpoint: np.ndarray, output: np.ndarray) -> None:
        """Give the state of the law before to the one now, so that the effort does not jump."""
        if before.options.is_plain:
            self._shaping[SETPOINT], self._shaping[OUTPUT] = self._latest
            self._shaping[EFFORT] = self.effort
        if not self.options.bumpless:
            return
        effort, terms = np.empty_like(self.effort), np.empty_like(self.terms)
        before.answer(setpoint, output, self._state.copy(), self._shaping.copy(), effort, terms)
        law = self._law
        r, y = law.shaped(setpoint, output, self._shaping)
        derivative = terms[TERMS.index("derivative")] * self._derivative_that_stays(before)
        e_d = law.derivative_error(r, y)
        back = np.divide(derivative, law.c[KD_H], out=np.zeros_like(e_d), where=law.c[KD_H] != 0)
        self._state[FILTER] = e_d - back
        needed = effort - law.proportional(r, y) - derivative
        if not before.options.manual and before.limits == law.limits:
            # Beyond a limit in force the effort has room: the integral action need not give way, nor need it wind up.
            now, unlimited = self._state[INTEGRAL], terms[TERMS.index("unlimited_effort")]
            needed = np.where(unlimited > effort, np.maximum(needed, now), needed)
            needed = np.where(unlimited < effort, np.minimum(needed, now), needed)
        self._state[INTEGRAL] = law.integral(needed, self._state[INTEGRAL])

    def _derivative_that_stays(self, before: _Law) -> np.ndarray:
        """How much of the derivative action the new law goes on with, (lanes,), 0 to 1.

        With a smaller K_d less of it, or what the new, faster filter would drop at the next sample would be a late
        jump.
        """
        kd, kd_before = self.gains.per_lane("kd"), before.gains.per_lane("kd")
        with np.errstate(over="ignore"):
            fraction = np.divide(kd, kd_before, out=np.zeros(len(kd)), where=kd_before != 0)
        return np.asarray(np.clip(fraction, 0.0, 1.0))


def rest_setpoint(start: float | None, output: np.ndarray, effort: np.ndarray) -> np.ndarray | None:
    """The setpoint at which a controller begins settled with a plant that begins at rest; None: it begins from nothing.

    Args:
        start: where the plan says that everything is settled; None: it does not.
        output, effort: of the plant at its start, (lanes,). Without `start`, an effort other than 0 is an operating
            point, and the setpoint counts as the output there.
    """
    if start is not None:
        return np.full(len(output), start)
    return output.copy() if effort.any() else None


class _Law:
    """The law for one set of parameters, without state."""

    def __init__(self, gains: Gains, options: ControllerOptions, sample_period_ns: int) -> None:
        self.gains, self.options = gains, options
        self.c, self._limits = coefficients(gains, sample_period_ns / 1e9), limits_of(gains)
        self._conditional = conditional_integration(gains)
        self._unwinding = unwinding_of(gains) or 0.0  # a number in any case: a change must not have to compile
        self.shape = shape_of(options, sample_period_ns / 1e9)
        self._flat = self.c.ravel()
        lanes = gains.lanes
        self.least, self.most = (gains.per_lane(name).copy() for name in LIMITS_PER_LANE)
        self._low, self._high = self.least.copy(), self.most.copy()
        self._shaped = np.empty((2, lanes))
        self._is_plain = options.is_plain
        self._manual = np.broadcast_to(np.asarray(options.manual_effort, dtype=np.float64), (lanes,))

    def answer(
        self,
        setpoint: np.ndarray,
        output: np.ndarray,
        state: np.ndarray,
        shaping: np.ndarray,
        effort: np.ndarray,
        terms: np.ndarray,
    ) -> None:
        """One answer; state and shaping advance, effort and terms are written."""
        r, y = setpoint, output
        if not self._is_plain:
            shape_lanes(self.shape, r, y, self.least, self.most, shaping, self._shaped, self._low, self._high)
            integral = state[INTEGRAL].copy()
            r, y = self._shaped
        answer_lanes(
            self._flat,
            self._limits,
            self._conditional,
            self._unwinding,
            self._low,
            self._high,
            r,
            y,
            state,
            effort,
            terms,
        )
        if self._is_plain:
            return
        if self.options.manual:
            state[INTEGRAL] = integral  # the law's is set when it takes over again
            np.minimum(np.maximum(self._manual, self._low), self._high, out=effort)
        shaping[EFFORT] = effort

    def shaped(self, setpoint: np.ndarray, output: np.ndarray, shaping: np.ndarray) -> np.ndarray:
        """Setpoint and output as the law will see them, (2, lanes)."""
        shaped = np.empty_like(self._shaped)
        shape_lanes(
            self.shape,
            setpoint,
            output,
            self.least,
            self.most,
            shaping.copy(),
            shaped,
            self._low.copy(),
            self._high.copy(),
        )
        return shaped

    @property
    def limits(self) -> tuple[object, ...]:
        """All that bounds the effort."""
        gains, options = self.gains, self.options
        return gains.effort_min, gains.effort_max, options.effort_rate

    def proportional(self, r: np.ndarray, y: np.ndarray) -> np.ndarray:
        """u_p (7)."""
        return np.asarray(self.c[KP] * ((1.0 - self.c[ALPHA]) * r - y))

    def derivative_error(self, r: np.ndarray, y: np.ndarray) -> np.ndarray:
        """What the derivative action differentiates; as its filter's state, it makes u_d 0."""
        return np.asarray((1.0 - self.c[BETA]) * r - y)

    def integral(self, wanted: np.ndarray, otherwise: np.ndarray | float) -> np.ndarray:
        """The integral action nearest to what is wanted; lanes without integral gain could never leave it again."""
        within = np.clip(wanted, self.gains.integral_min, self.gains.integral_max)
        return np.where(self.c[KI_H] != 0, within, otherwise)


@lru_cache(maxsize=1024)
def parameters_digest(gains: Gains, sample_period_ns: int, options: ControllerOptions = PLAIN) -> str:
    """A name for what answers are computed with: 12 hexadecimal digits made from the values alone.

    An option that is added later has no part in it as long as it is at its default, so the digests in recorded bags
    are found for ever.
    """
    content = repr((_named(gains), _named(options), sample_period_ns))
    return hashlib.sha256(content.encode()).hexdigest()[:12]


# What the first bags' digests were made of: these have their part in it also at their defaults.
_ALWAYS_NAMED = frozenset(
    (
        *("type", "kp", "ki", "kd", "alpha", "beta", "sigma", "n", "effort_min", "effort_max", "anti_windup"),
        *("tracking_time", "integral_min", "integral_max", "manual", "manual_effort", "setpoint_min", "setpoint_max"),
        *("setpoint_rate", "effort_rate", "dead_band", "filter_time", "angle", "bumpless"),
    )
)


def _named(values: Gains | ControllerOptions) -> list[tuple[str, object]]:
    default = {field.name: field.default for field in fields(values)}
    return sorted(
        (name, value) for name, value in values.as_dict().items() if name in _ALWAYS_NAMED or value != default[name]
    )
