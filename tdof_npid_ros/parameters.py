"""The parameters of the nodes and of the plant's models: one table each, in which a default or a range is said once.

From here a node declares them, values are checked, parameter files are read, misspelt names are found, and
`--help` of a node and `docs/parameters.md` are made. What an entry says is in `parameter.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final, Literal, get_args

from tdof_npid_ros.parameter import (
    ABOVE_0,
    ABOVE_0_FINITE,
    FINITE,
    FROM_0,
    Parameter,
    ParameterError,
    Range,
    Table,
    table,
    unknown_parameters,
)

ControllerType = Literal["pid", "npid", "tdof_npid1", "tdof_npid2"]
AntiWindup = Literal["none", "conditional", "back_calculation"]
CONTROLLER_TYPES: Final[tuple[ControllerType, ...]] = get_args(ControllerType)
ANTI_WINDUP: Final[tuple[AntiWindup, ...]] = get_args(AntiWindup)

# Within these bounds no effort overflows, whatever the gains, setpoints and outputs are.
LARGEST_GAIN: Final = 1e50  # in SI units, of the absolute value; 1/LARGEST_GAIN is the smallest sigma
LARGEST_SIGNAL: Final = 1e100  # of setpoints and outputs

GAIN: Final = Range(-LARGEST_GAIN, LARGEST_GAIN, words=f"finite, within ±{LARGEST_GAIN:g}")
SIGMA: Final = Range(1 / LARGEST_GAIN, LARGEST_GAIN, words=f"above 0, from {1 / LARGEST_GAIN:g} to {LARGEST_GAIN:g}")
SIGNAL: Final = Range(-LARGEST_SIGNAL, LARGEST_SIGNAL, words=f"finite, within ±{LARGEST_SIGNAL:g}")
TIMEOUT: Final = Range(0.0, 3600.0)
PATIENCE: Final = Range(0.1, 1e6)
WHOLE_64: Final = Range(0, 2**63 - 1)

# What several nodes have

SAMPLE_PERIOD: Final = Parameter(
    "sample_period",
    0.01,
    "time of one step, between two outputs; a whole number of nanoseconds; the same for all nodes of a loop",
    "s",
    Range(0.0, 2**53 / 1e9, closed_low=False, words="above 0, at most 104 days"),  # beyond, a float cannot tell 1 ns
    fixed=True,
    of_loop=True,
)
MODE: Final = Parameter(
    "mode",
    "realtime",
    "lockstep: the plant waits for each answer; realtime: a steady timer",
    choices=("lockstep", "realtime"),
    fixed=True,
    of_loop=True,
)
SPEED: Final = Parameter(
    "speed",
    1.0,
    "realtime: simulated seconds per wall-clock second",
    within=Range(1e-3, 1e3),
    fixed=True,
    of_loop=True,
)
JOINT_NAMES: Final = Parameter(
    "joint_names",
    [""],
    "name of each lane in the signals; with other elements beside them, these are picked; none: all, in order",
    fixed=True,
    of_loop=True,
)
LOSSLESS: Final = Parameter(
    "lossless",
    False,
    "lockstep: the plant never runs ahead of what the recorder has got; give it to both",
    fixed=True,
    of_loop=True,
)
AUTOSTART: Final = Parameter(
    "autostart",
    True,
    "activate at once; false: wait for a supervisor's transitions",
    fixed=True,
    of_loop=True,
)
RELIABILITY: Final = Parameter(
    "reliability",
    "reliable",
    "of what is taken: best_effort hears publishers that send so, too, and asks for no lost message again",
    choices=("reliable", "best_effort"),
    fixed=True,
    of_loop=True,
)
TIMING: Final = (
    Parameter(
        "deadline",
        0.0,
        "realtime: time from one published signal to the next, as it promises; 0: no promise",
        "s",
        TIMEOUT,
        fixed=True,
        of_loop=True,
    ),
    Parameter(
        "lease",
        1.0,
        "lease of the liveliness that the published signal promises; 0: no promise",
        "s",
        TIMEOUT,
        fixed=True,
        of_loop=True,
    ),
    Parameter(
        "request_deadline",
        False,
        "realtime: take signals only from publishers that promise this deadline and lease",
        fixed=True,
        of_loop=True,
    ),
    RELIABILITY,
    Parameter(
        "priority",
        0,
        "priority of SCHED_FIFO; 0: normal scheduling",
        within=Range(0, 99),
        fixed=True,
        of_loop=True,
    ),
    Parameter(
        "cpu",
        -1,
        "number of the processor to stay on; -1: any",
        within=Range(-1, 2**31 - 1),
        fixed=True,
        of_loop=True,
    ),
)

# The controller

GAINS: Final = table(
    Parameter("type", "tdof_npid2", "control law", choices=CONTROLLER_TYPES),
    Parameter("kp", 1.0, "proportional gain K_p", "effort per output unit", GAIN, per_lane=True),
    Parameter("ki", 0.0, "integral gain K_i", "effort per output unit and s", GAIN, per_lane=True),
    Parameter("kd", 0.0, "derivative gain K_d", "effort per output unit, times s", GAIN, per_lane=True),
    Parameter(
        "alpha",
        0.0,
        "setpoint weight on the proportional action (6); tdof_npid1 and tdof_npid2",
        within=GAIN,
        per_lane=True,
    ),
    Parameter("beta", 0.0, "setpoint weight on the derivative action (6); tdof_npid2", within=GAIN, per_lane=True),
    Parameter(
        "sigma",
        1.0,
        "width of the nonlinear gain k(e) (4): the largest change of the setpoint; all types but pid need it given",
        "the output's unit",
        SIGMA,
        per_lane=True,
    ),
    Parameter("n", 10.0, "derivative filter N (1b); usually 5 to 30", within=ABOVE_0_FINITE),
    Parameter("effort_min", -math.inf, "lower limit of the effort", "the effort's unit", per_lane=True, of_loop=True),
    Parameter("effort_max", math.inf, "upper limit of the effort", "the effort's unit", per_lane=True, of_loop=True),
    Parameter("anti_windup", "conditional", "what the integral action does at a limit", choices=ANTI_WINDUP),
    Parameter(
        "tracking_time",
        0.0,
        "of back_calculation; 0: sqrt(kd/ki), or kp/ki without derivative action",
        "s",
        FROM_0,
    ),
    Parameter("integral_min", -math.inf, "lower limit of the integral action", "the effort's unit"),
    Parameter("integral_max", math.inf, "upper limit of the integral action", "the effort's unit"),
    Parameter(
        "full_unwinding",
        False,
        "integrate the whole error, k(e) = 1, where that makes the integral action smaller; false: the paper's law",
    ),
)
OPTIONS: Final = table(
    Parameter("manual", False, "true: the effort is manual_effort; back to false without a jump"),
    Parameter(
        "manual_effort",
        0.0,
        "effort in manual mode; also set by the topic manual_effort",
        "the effort's unit",
        FINITE,
        per_lane=True,
    ),
    Parameter("setpoint_min", -math.inf, "lower limit of the setpoint", "the output's unit"),
    Parameter("setpoint_max", math.inf, "upper limit of the setpoint", "the output's unit"),
    Parameter("setpoint_rate", math.inf, "the setpoint moves no faster; inf: no ramp", "output units per s", ABOVE_0),
    Parameter("effort_rate", math.inf, "the effort moves no faster; inf: no limit", "effort per s", ABOVE_0),
    Parameter("dead_band", 0.0, "error that counts as none", "the output's unit", FROM_0),
    Parameter("filter_time", 0.0, "time constant of the output's first-order filter; 0: none", "s", FROM_0),
    Parameter(
        "angle", False, "true: setpoint and output are angles in rad, the error is the shorter way round", of_loop=True
    ),
    Parameter("bumpless", True, "true: changes of gains and type do not move the effort at once"),
)


def _safe_ranges(output: str, effort: str, *, fixed: bool = False) -> list[Parameter]:
    """The ranges that end what is tried on a loop; what happens then, of each."""
    return [
        Parameter(
            f"safe_range.{signal}",
            [-math.inf, math.inf],
            text,
            f"the {signal}'s unit",
            fixed=fixed,
            length=2,
            is_interval=True,
        )
        for signal, text in (("output", output), ("effort", effort))
    ]


EXPERIMENT: Final = table(
    Parameter("experiment", "", "name of the experiment that has the loop; empty: none, and all is as before"),
    Parameter(
        "experiment_setpoint",
        math.inf,
        "setpoint that the experiment gives; inf: the operator's",
        "the output's unit",
        Range(-LARGEST_SIGNAL),
    ),
    Parameter(
        "experiment_effort",
        math.inf,
        "effort that the experiment gives by hand; inf: the mode of before",
        "the effort's unit",
        Range(-1e300),
    ),
    Parameter(
        "experiment_lease",
        2.0,
        "wall time after which an experiment ends if none of its parameters is set again",
        "s",
        Range(0.1, 3600.0),
    ),
    Parameter(
        "experiment_duration", 3600.0, "an experiment ends after so much of the loop's time", "s", Range(0.0, 1e9)
    ),
    *_safe_ranges("an experiment ends when the output leaves it", "an experiment ends before the effort leaves it"),
)
CONTROLLER: Final = table(
    SAMPLE_PERIOD,
    *GAINS.values(),
    *OPTIONS.values(),
    *EXPERIMENT.values(),
    Parameter("setpoint", 0.0, "until one arrives on the topic", "the output's unit", SIGNAL, per_lane=True),
    Parameter("hold_output", False, "true: when activated, the setpoint is the first output, until another is given"),
    Parameter(
        "output_timeout",
        0.5,
        "wall time without output until it is reported; then no jump; 0: never",
        "s",
        TIMEOUT,
    ),
    Parameter("save_i_term", True, "keep the integral action while inactive"),
    JOINT_NAMES,
    Parameter(
        "output_from",
        "",
        "TOPIC TYPE FIELD [SCALE [OFFSET]] to take the output from; then published on output, too; empty: output",
        fixed=True,
        per_lane=True,
    ),
    Parameter(
        "setpoint_from",
        "",
        "TOPIC TYPE FIELD [SCALE [OFFSET]] to take the setpoint from; empty: setpoint",
        fixed=True,
        per_lane=True,
    ),
    Parameter(
        "effort_to",
        "",
        "TOPIC TYPE FIELD [SCALE [OFFSET]] to publish the effort in, besides control_effort; empty: nowhere else",
        fixed=True,
        per_lane=True,
    ),
    *TIMING,
    AUTOSTART,
)

# The plant and its models; the equations are the paper's


def _time_constant(default: float, description: str) -> Parameter:
    return Parameter("time_constant", default, description, "s", ABOVE_0_FINITE, per_lane=True)


def _dead_time(default: float) -> Parameter:
    return Parameter("dead_time", default, "dead time, any number", "s", Range(0.0, 1e9), fixed=True, per_lane=True)


_GAIN: Final = Parameter(
    "gain", 1.0, "gain K of the transfer function", "output per effort unit", FINITE, per_lane=True
)
OFFSETS: Final = table(  # a linear model's operating point
    Parameter(
        "output_offset",
        0.0,
        "output at the operating point of the model",
        "the output's unit",
        FINITE,
        fixed=True,
        per_lane=True,
    ),
    Parameter(
        "effort_offset", 0.0, "effort that holds it there", "the effort's unit", FINITE, fixed=True, per_lane=True
    ),
)
MODELS: Final[dict[str, dict[str, Parameter]]] = {
    "first_order": table(  # (11)
        _GAIN,
        _time_constant(5.0, "time constant T"),
        _dead_time(0.5),
        *OFFSETS.values(),
    ),
    "second_order": table(  # (12)
        _GAIN,
        _time_constant(2.0, "both time constants T"),
        _dead_time(1.0),
        *OFFSETS.values(),
    ),
    "third_order": table(  # (13)
        _GAIN,
        _time_constant(1.0, "all three time constants T"),
        Parameter(
            "zero_time_constant", 1.0, "c of the zero in the right half-plane, 1 - c s", "s", FINITE, per_lane=True
        ),
        _dead_time(0.0),
        *OFFSETS.values(),
    ),
    "transfer_function": table(
        Parameter("numerator", [1.0], "coefficients, the highest power of s first", "", FINITE, fixed=True),
        Parameter("denominator", [1.0, 1.0], "coefficients, likewise; of higher degree", "", FINITE, fixed=True),
        _dead_time(0.0),
        *OFFSETS.values(),
    ),
    "sprott": table(  # (14)-(16)
        Parameter("a", 0.6, "a of the circuit", within=FINITE, per_lane=True),
        Parameter("b", 1.2, "b of the circuit", within=FINITE, per_lane=True),
        Parameter("c", 2.0, "c of the circuit", within=FINITE, per_lane=True),
        Parameter("initial_state", [0.0, 0.0, 0.0], "x1, x2, x3 at time 0", within=FINITE, length=3, fixed=True),
    ),
}
SUBSTEPS: Final = Parameter(
    "substeps",
    1.0,
    "Runge-Kutta steps per sample; more where the plant is faster than the sample period",
    within=Range(1.0, closed_high=False),
    is_whole=True,
    fixed=True,
)
NOISE: Final = table(  # of what is measured
    Parameter(
        "noise", 0.0, "standard deviation of the noise in the output", "the output's unit", Range(0.0, 1e50), fixed=True
    ),
    Parameter(
        "quantum", 0.0, "the output comes in multiples of it, after the noise; 0: as it is", "the output's unit",
        Range(0.0, 1e50), fixed=True,
    ),
    Parameter(
        "noise_seed", 0, "the same seed and the same plan have the same noise", within=Range(0, 2**31 - 1), fixed=True
    ),
)  # fmt: skip
PLANT: Final = table(
    SAMPLE_PERIOD,
    MODE,
    Parameter(
        "model",
        "first_order",
        f"of the plant: {', '.join(MODELS)}, or package.module:Class; its parameters come to these",
        fixed=True,
    ),
    Parameter(
        "lanes",
        1,
        "plants in one message, independent of each other; taken over at the next reset",
        within=Range(1, 100_000),
        of_loop=True,
    ),
    Parameter("effort_min", -math.inf, "lower limit of the actuator", "the effort's unit", of_loop=True),
    Parameter("effort_max", math.inf, "upper limit of the actuator", "the effort's unit", of_loop=True),
    *NOISE.values(),
    Parameter("output_unit", "", "unit of the output, for axes and tables", fixed=True, of_loop=True),
    Parameter("effort_unit", "", "unit of the effort, likewise", fixed=True, of_loop=True),
    Parameter(
        "start",
        math.inf,
        "output at which plant/reset begins, at rest; inf: as the model begins; a plan's start stands above it",
        "the output's unit",
    ),
    Parameter(
        "reply_timeout",
        0.5,
        "lockstep: wall time until an unanswered output is repeated",
        "s",
        Range(0.01, 3600.0),
        fixed=True,
    ),
    Parameter(
        "retries", 20, "lockstep: how often an output is repeated before the plant stops", within=Range(0, 10**9)
    ),
    Parameter(
        "publish_clock",
        True,
        "publish the loop's time on /clock: in lockstep, and in realtime at a speed other than 1",
        fixed=True,
    ),
    SPEED,
    Parameter(
        "effort_timeout",
        0.5,
        "realtime: wall time without control_effort until the fallback; 0: never",
        "s",
        TIMEOUT,
    ),
    Parameter(
        "fallback",
        "effort",
        "realtime: after effort_timeout, effort: take fallback_effort; hold: keep the last",
        choices=("effort", "hold"),
    ),
    Parameter(
        "fallback_effort", 0.0, "realtime: effort without a controller", "the effort's unit", Range(-1e300, 1e300)
    ),
    Parameter(
        "return_time", 0.5, "realtime: time in which the plant goes over to efforts that come again", "s", TIMEOUT
    ),
    JOINT_NAMES,
    LOSSLESS,
    *TIMING,
    AUTOSTART,
)

# The other nodes

PLAN: Final = Parameter(  # of each episode: plan.<episode>
    "plan.", ["0 setpoint 1", "10 end"], "lines of an episode, each TIME SIGNAL WHAT, the last one TIME end"
)
SCENARIO: Final = table(
    SAMPLE_PERIOD,
    MODE,
    SPEED,
    Parameter("play", True, "play all episodes at the start; else at scenario/play", fixed=True),
    Parameter("episodes", ["setpoint"], "names of the episodes, in the order in which they are played"),
    AUTOSTART,
)
TUNED_GAINS: Final = ("kp", "ki", "kd", "alpha", "beta", "sigma")
BOUNDS: Final = table(
    *(
        Parameter(
            f"bounds.{gain}",
            None,
            f"bounds of the search for {gain}",
            GAINS[gain].unit,
            FINITE,
            fixed=True,
            length=2,
            is_interval=True,
            example=[0.0, 1.0],
            otherwise="the case's",
        )
        for gain in TUNED_GAINS
    )
)
WEIGHT: Final = Parameter(
    "weight", 1.0, "w of the objective IAE_SP + w·IAE_DIS (10)", within=Range(0.0, 1e100), fixed=True
)
TUNER: Final = table(
    Parameter("case", "", "case to tune: p1-c0.5, …, or its parameter file; must be given", fixed=True),
    Parameter(
        "type",
        None,
        "controller type to tune",
        choices=CONTROLLER_TYPES,
        fixed=True,
        example="tdof_npid2",
        otherwise="the case's",
    ),
    Parameter(
        "free", "", "what to tune besides the type's gains: sigma, or nothing", choices=("", "sigma"), fixed=True
    ),
    WEIGHT,
    *BOUNDS.values(),
    Parameter("algorithm", "hga", "of the search", choices=("hga", "cmaes", "de"), fixed=True),
    Parameter("seed", 0, "the same seed gives the same result", within=WHOLE_64, fixed=True),
    Parameter("population", 40, "candidates, and lanes, of a generation", within=Range(2, 100_000), fixed=True),
    Parameter("generations", 60, "of a whole population each", within=Range(1, 2**31 - 1), fixed=True),
    Parameter(
        "polish",
        None,
        "hga: candidates in a step of its polish; 0: none",
        within=Range(0, 100_000),
        fixed=True,
        example=6,
        otherwise="population",
    ),
    Parameter(
        "start",
        "case",
        "what the search begins with beside random gains: case, the case's own; cold, nothing",
        choices=("case", "cold"),
        fixed=True,
    ),
    Parameter("until_converged", True, "end before the budget is spent, once the search has converged", fixed=True),
    Parameter("ms", 0.0, "largest M_s that the loop may have; 0: any", within=FROM_0, fixed=True),
    Parameter("mt", 0.0, "largest M_t that the loop may have; 0: any", within=FROM_0, fixed=True),
    Parameter("gain_margin", 0.0, "least factor on the gains; 0: any", within=FROM_0, fixed=True),
    Parameter("phase_margin", 0.0, "least phase margin; 0: any", "degrees", FROM_0, fixed=True),
    Parameter("delay_margin", 0.0, "least additional dead time; 0: any", "s", FROM_0, fixed=True),
    Parameter("loops", ["."], "namespaces of the loops; . is the tuner's own, * every one on the graph", fixed=True),
    Parameter("loop_timeout", 60.0, "time without any loop until the tuner gives up", "s", PATIENCE, fixed=True),
    Parameter("answer_timeout", 5.0, "time until a silent loop counts as lost", "s", PATIENCE, fixed=True),
    Parameter("checkpoint", "", "file, saved after each generation; empty: none", fixed=True),
    Parameter("resume", True, "go on from the checkpoint if it is there", fixed=True),
    Parameter("result", "", "ROS parameter file to write the optimum to; empty: none", fixed=True),
    Parameter("stay", False, "stay on the graph when done, instead of ending", fixed=True),
    Parameter(
        "episode",
        "reset",
        "how a candidate is tested: reset, by the case's episodes; alternate, by a step back and forth",
        choices=("reset", "alternate"),
        fixed=True,
    ),
    Parameter("levels", [0.0, 1.0], "alternate: the two setpoints", "the output's unit", FINITE, fixed=True, length=2),
    *_safe_ranges(
        "alternate: a trial ends when the output leaves it",
        "alternate: a trial ends when the effort leaves it",
        fixed=True,
    ),
    Parameter(
        "settle_band",
        0.02,
        "alternate: fraction of the step within which the output counts as there",
        within=Range(0.0, 1.0, closed_low=False, closed_high=False),
        fixed=True,
    ),
    Parameter("settle_time", 1.0, "alternate: time within settle_band to count as settled", "s", PATIENCE, fixed=True),
    Parameter("time_limit", 60.0, "alternate: time in which the output must settle", "s", PATIENCE, fixed=True),
    AUTOSTART,
)
RECORDER: Final = table(
    Parameter(
        "bag",
        None,
        "folder of the bag; must not exist; not to be changed while recording",
        example="bags/run",
        otherwise="bags/<date>-<time>",
    ),
    Parameter("compression", "zstd", "of the chunks", choices=("zstd", "lz4", "none"), fixed=True),
    Parameter("max_bytes", 0, "a new file begins at this size; 0: never", "bytes", WHOLE_64, fixed=True),
    Parameter("max_duration", 0.0, "a new file begins after this time; 0: never", "s", Range(0.0), fixed=True),
    Parameter(
        "topics",
        ["*", "/parameter_events", "/rosout", "/diagnostics", "/clock"],
        "patterns (* ? [...]) of the topics to record; those without a slash at the start are of this namespace, "
        "without other loops below it",
        fixed=True,
    ),
    Parameter("exclude", [""], "patterns of topics to leave out", fixed=True),
    RELIABILITY,
    LOSSLESS,
    AUTOSTART,
)
REPLAY: Final = table(
    Parameter("bag", "", "the bag to publish again; must be given", fixed=True),
    Parameter("rate", 1.0, "times the recorded speed", within=Range(1e-6), fixed=True),
    Parameter("start", 0.0, "how much of the recording to leave out", "s", Range(0.0), fixed=True),
    Parameter("loop", False, "begin again at the end", fixed=True),
    Parameter("clock", False, "publish /clock, as recorded, else the time of recording", fixed=True),
    Parameter("compare", False, "compare a live controller's efforts with the recorded", fixed=True),
    Parameter("output", "", "compare: the topic of the outputs, where it is not called so", fixed=True),
    Parameter("setpoint", "", "compare: the topic of the setpoints, where it is not called so", fixed=True),
    Parameter("effort", "", "compare: the topic of the recorded efforts, where it is not control_effort", fixed=True),
    AUTOSTART,
)

NODES: Final[dict[str, dict[str, Parameter]]] = {
    "plant": PLANT,
    "controller": CONTROLLER,
    "scenario": SCENARIO,
    "tuner": TUNER,
    "recorder": RECORDER,
    "replay": REPLAY,
}
OF_ROS: Final = ("use_sim_time", "start_type_description_service", "qos_overrides.")  # every node has them


def misspelt(given: Iterable[str], known: Table) -> list[str]:
    """What to warn of: names that a file gives to a node that does not know them.

    Args:
        known: the node's parameters, with those of its plant's model.
    """
    of_loop = {name for its in NODES.values() for name, one in its.items() if one.of_loop}
    return unknown_parameters(given, known, {*of_loop, *OF_ROS, PLAN.name})


def sample_period_in_ns(value: Any) -> int:
    """A sample period in s as a whole number of nanoseconds.

    Raises:
        ParameterError: out of the parameter's range, or no whole number of nanoseconds.
    """
    period: float = SAMPLE_PERIOD.checked(value)
    period_ns = round(period * 1e9)
    if period_ns < 1 or abs(period_ns - period * 1e9) > 1e-3:
        raise ParameterError(f"sample_period is {period!r} s: it must be a whole number of nanoseconds")
    return period_ns
