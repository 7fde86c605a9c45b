"""The controller: answers each output with a control effort."""

from __future__ import annotations

import math
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.fields import FieldReader, FieldWriter, parse_fields
from tdof_npid_ros.control.gains import TUNED, Gains, Lanes, gains_from_mapping
from tdof_npid_ros.control.guard import RESTORED
from tdof_npid_ros.control.joints import SHOWN_NAMES, Joints
from tdof_npid_ros.control.law import TERMS
from tdof_npid_ros.control.options import ControllerOptions, options_from_mapping
from tdof_npid_ros.control.session import FAR_IN_SIGMA, OFF_RATE, OUT_OF_STEP, STUCK, Answer, Outcome, Session
from tdof_npid_ros.control.stall import Stall, StallWatch
from tdof_npid_ros.graph.runtime.loop_end import LoopEnd, patience_ns
from tdof_npid_ros.graph.runtime.messages import lane_names, plan_from_message
from tdof_npid_ros.graph.runtime.node import ERROR, OK, STEADY, WARN, shortened
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS, SENSOR_QOS, SIGNAL_QOS
from tdof_npid_ros.graph.runtime.run import run_node
from tdof_npid_ros.interfaces import message_class
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameters import CONTROLLER, EXPERIMENT, GAINS, LARGEST_SIGNAL, OPTIONS, sample_period_in_ns
from tdof_npid_ros.wire import AnswerLabel, Sample, SignalWriter

if TYPE_CHECKING:
    from tdof_npid_ros.case import Case

SILENCE_LOOKS = 0.05  # s between two looks whether output has stopped
DRIVEN_OFF = "driven off: the integral action hardly sees so large an error; see k_of_error and integral_rate"


class ControllerNode(LoopEnd):
    """Takes `output`, `setpoint` and `scenario_plan`; publishes `control_effort` and `controller_state`."""

    def __init__(self) -> None:
        super().__init__("controller")
        given = self.declare_all(CONTROLLER)
        self.gives_sigma = "sigma" in self._parameter_overrides  # the change that is made now, by itself
        self.sigma_given_in = "" if self.gives_sigma else None  # an experiment; "": for good; None: it is a guess
        if not self.gives_sigma:
            _check_sigma(given["type"], sys.argv)
        self.quiet_parameters.add("manual_effort")
        self.controller = Controller(
            gains_from_mapping(given), sample_period_in_ns(given["sample_period"]), options_from_mapping(given)
        )
        self.controller.warm_up()
        self.joints = Joints(given["joint_names"])
        self.session = Session(self.controller, self.joints)
        self.session.end_experiment = self._end_experiment
        if given["experiment"]:
            raise ValueError("experiment must be empty at the start: set it once the loop runs")
        self.stall_watch = StallWatch()
        self._take_fields(given)
        self.commanded = False  # the topic gives the setpoint, since the activation
        self.checked(given)
        self.changed({name: given[name] for name in ("setpoint", "output_timeout")})
        self.accept_changes()

    def _take_fields(self, given: dict[str, Any]) -> None:
        """Where output and setpoint come from and the effort goes to, besides the loop's own topics.

        Raises:
            ValueError: a field cannot be read or written; the message names the parameter.
        """
        try:
            name = "output_from"
            self.output_from = self._reader(given[name], "output")
            name = "setpoint_from"
            self.setpoint_from = self._reader(given[name], "setpoint")
            name = "effort_to"
            fields = parse_fields(given[name])
            self.effort_to = FieldWriter(fields, lambda kind: message_class(kind)()) if fields else None
            for topic in self.effort_to.messages if self.effort_to else ():
                self._check_is_another(topic, "control_effort")
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def _reader(self, texts: str | list[str], own: str) -> FieldReader | None:
        fields = parse_fields(texts)
        if not fields:
            return None
        reader = FieldReader(fields, whole=own == "output")
        for topic in reader.types:
            self._check_is_another(topic, own)
        for field in fields:
            field.path.check(message_class(field.path.type)())
        return reader

    def _check_is_another(self, topic: str, own: str) -> None:
        if self.resolve_topic_name(topic) == self.resolve_topic_name(own):
            raise ValueError(f"{topic} is the controller's own topic {own}: remap that, or leave the parameter out")

    def activate(self) -> None:
        """Create topics, services and timers."""
        self.prepare_for_realtime()
        self.session.begin()
        self.stall_watch.forget()
        self.is_driven_off = False
        self.why_refused = ""  # the latest output, if that was
        self.commanded = False
        self.session.holds_output = bool(self.values_of(["hold_output"])["hold_output"])
        self.effort = SignalWriter()
        self.effort_label: AnswerLabel | None = None
        self.terms = SignalWriter()
        self.terms_for = 0
        qos = self.promised_qos()
        self.effort_publisher = self.publisher_of(JointState, "control_effort", qos, self._on_effort_matched)
        self.state_publisher = self.publisher_of(JointState, "controller_state", SIGNAL_QOS)
        self.subscribe(JointTrajectory, "scenario_plan", self._on_plan, LATCHED_QOS)
        if self.setpoint_from is not None:
            self.subscribe_fields(self.setpoint_from, self._on_setpoint, self.requested_qos(10))
        else:
            self.subscribe_signal("setpoint", self._on_setpoint, self.requested_qos(10))
        self.subscribe_signal("manual_effort", self._on_manual_effort, self.requested_qos(1))
        self.effort_to_publishers = {
            topic: self.publisher_of(message_class(kind), topic, SIGNAL_QOS)
            for topic, (kind, _) in (self.effort_to.messages.items() if self.effort_to else ())
        }
        if self.output_from is not None:
            self.output_from.forget()
            self.output = SignalWriter()
            self.output_head: tuple[str, list[str]] = ("", [])
            self.output_publisher = self.publisher_of(JointState, "output", SIGNAL_QOS)
            self.subscribe_fields(self.output_from, self._on_output_from, SENSOR_QOS, sole=True)
        else:
            self.subscribe_signal("output", self._on_output, self.requested_qos(as_promised=True), sole=True)
        self.create_timer(SILENCE_LOOKS, self._look_for_silence, clock=STEADY)

    def deactivate(self) -> None:
        """Keep what outlasts an inactive time."""
        if self.session.guard.name:
            self._end_experiment("the controller was deactivated")
        saves = self.values_of(["save_i_term"])["save_i_term"]
        self.session.saved_integral = self.session.integral if saves else None

    # What arrives

    def _on_plan(self, message: JointTrajectory) -> None:
        try:
            plan = plan_from_message(message)
        except ValueError as error:
            self.refuse("rejected", "scenario_plan refused", f": {error}")
            return
        self.session.plan = plan
        if self.session.waiting is not None:
            self._on_output(self.session.waiting)

    def _on_setpoint(self, sample: Sample) -> None:
        if not len(sample.position) and len(sample.effort):
            self.refuse("rejected", "setpoint refused: it came in effort, publish it in position")
            return
        try:
            r = self.joints.merged(sample.name, sample.position, self.session.lanes_setpoint, LARGEST_SIGNAL)
        except ValueError as error:
            self.refuse("rejected", "setpoint refused", f": it {error}")
            return
        self.commanded = True
        if self.session.guard.name:
            self._end_experiment("an operator has given a setpoint")
        self.session.set_setpoint(r)
        if self.session.is_setpoint_far:
            self.warn_once(
                f"the setpoint is more than {FAR_IN_SIGMA:g} sigma from the output (sigma is "
                f"{self.controller.gains.sigma}): such an error is hardly integrated, the output may stop short; "
                "set sigma to the largest change of the setpoint"
            )

    def _on_manual_effort(self, sample: Sample) -> None:
        if not len(sample.effort) and len(sample.position):
            self.refuse("rejected", "manual_effort refused: it came in position, publish it in effort")
            return
        try:
            values = self.joints.selected(sample.name, sample.effort)
        except ValueError as error:
            self.refuse("rejected", "manual_effort refused", f": it {error}")
            return
        effort = values.tolist()
        parameter = Parameter("manual_effort", value=effort if len(effort) > 1 else effort[0] if effort else math.nan)
        if not self.set_parameters([parameter])[0].successful:
            self.counts["rejected"] += 1

    def _on_output(self, output: Sample) -> None:
        outcome = self.session.take(output, self.silence_ns)
        if outcome.answer is not None:
            self.effort_publisher.publish(self._message(outcome.answer))
            if self.effort_to is not None:
                self._publish_effort_to(self.effort_to, outcome.answer)
        self._account_for(outcome)  # the plant waits for the answer, so all else comes after it

    def _on_output_from(self, sample: Sample) -> None:
        """Publish what is taken as `output`, so that recorder and `verify` have what was answered, and answer it."""
        lanes = len(sample.position)
        names = list(sample.name) or (self.joints.names if len(self.joints.names) == lanes else lane_names(lanes))
        if self.output_head != (sample.frame_id, names):
            self.output_head = sample.frame_id, names
            self.output.label(*self.output_head)
        self.output_publisher.publish(self.output.write(sample.stamp_ns, position=sample.position))
        self._on_output(sample)

    def _publish_effort_to(self, effort_to: FieldWriter, answer: Answer) -> None:
        try:
            effort_to.write(answer.stamp_ns, answer.effort)
        except ValueError as error:
            self.refuse("rejected", "effort not published in effort_to", f": {error}")
            return
        for topic, (_, message) in effort_to.messages.items():
            self.effort_to_publishers[topic].publish(message)

    def _message(self, answer: Answer) -> bytes:
        if answer.label is not self.effort_label:
            self.effort_label = answer.label
            self.effort.label(str(answer.label), self.joints.names or lane_names(self.controller.lanes))
        # The first answer within a running loop bears the integral action that it began with, for `verify`.
        return self.effort.write(
            answer.stamp_ns, position=answer.setpoint, velocity=answer.began_with, effort=answer.effort
        )

    def _account_for(self, outcome: Outcome) -> None:
        decision, answer, why, detail, after_silence = outcome
        if after_silence:
            self.get_logger().info("output comes again: going on")
        if why:
            if answer is None:
                self.why_refused = why + detail
            self.refuse("rejected" if answer is None else "out_of_step", why, detail)
        if decision == "late":
            self.counts["late"] += 1
        elif decision == "same":
            self.counts["repeated"] += 1
        elif answer is not None:
            self.why_refused = ""
            self.counts["steps"] += 1
            if self.controller.saturated:
                self.counts["saturated"] += 1
            if self.state_publisher.get_subscription_count():
                self._publish_terms(answer.stamp_ns)

    def _on_effort_matched(self, status: Any) -> None:
        """A reader of `control_effort` has come. A plant in lockstep may be waiting for what it could not hear yet."""
        session = self.session
        if status.current_count_change > 0 and session.answer is not None and not session.is_live:
            self.effort_publisher.publish(self._message(session.answer))

    def _look_for_silence(self) -> None:
        guard = self.session.guard
        if guard.name and (breach := guard.overdue(time.monotonic_ns(), self.session.silent)):
            self._end_experiment(breach)
        if self.session.look_for_silence(self.silence_ns):
            self.counts["silences"] += 1
            silence = f"no output for {self.session.timeout_ns / 1e9:g} s: the integral action waits. "
            self.get_logger().error(STUCK if self.session.is_stuck else f"{silence}Look after the plant")

    def _end_experiment(self, why: str) -> None:
        """Restore all that was before the experiment, at once; as a change of parameters, like any."""
        self.session.guard.note(why)
        self.set_parameters_atomically([Parameter("experiment", value="")])

    # What goes out

    def _publish_terms(self, stamp: int) -> None:
        lanes = self.controller.lanes
        if self.terms_for != lanes:
            self.terms_for = lanes
            names = [term if lanes == 1 else f"{term}/{lane}" for term in TERMS for lane in range(lanes)]
            self.terms.label("", names)
        self.state_publisher.publish(self.terms.write(stamp, position=self.controller.terms))

    # Parameters and state

    def summary(self) -> str:
        """The law, its gains and its rate; and what it waits for."""
        gains = self.controller.gains
        numbers = ", ".join(f"{name} {_short(getattr(gains, name))}" for name in (*TUNED[gains.type], "sigma"))
        joints = f" for {', '.join(self.joints.names[:SHOWN_NAMES])}" if self.joints.names else ""
        rate = 1e9 / self.controller.sample_period_ns
        outputs = map(self.resolve_topic_name, self.output_from.types if self.output_from else ("output",))
        return f"{gains.type}{joints}, {numbers}, {rate:g} Hz, waiting for {', '.join(outputs)}"

    def completed(self, changes: dict[str, Any]) -> dict[str, Any]:
        """With what an experiment sets or restores together with them."""
        self.gives_sigma = "sigma" in changes
        if not self.session.guard.name and not changes.get("experiment"):
            return changes
        return self.session.guard.completed(changes, self.values_of(RESTORED))

    def checked(self, changes: dict[str, Any]) -> None:
        """Refuse changes that do not make a valid whole."""
        gains, _ = self._configured(changes)
        self.session.check_experiment(changes, {**self.values_of(list(EXPERIMENT)), **changes})
        if self._sigma_given_in(changes) is None:
            _check_sigma(gains.type)
        if "setpoint" in changes and self.commanded and not self._is_setpoint_of_now(changes["setpoint"]):
            raise ValueError(
                f"the topic {self.resolve_topic_name('setpoint')} gives the setpoint, now "
                f"{shortened(self.session.lanes_setpoint.tolist())}: publish there, or deactivate and activate the "
                "controller to go by the parameter"
            )
        setpoint = np.atleast_1d(changes["setpoint"]) if "setpoint" in changes else self.session.setpoint
        if len(setpoint) not in (1, gains.lanes):
            raise ValueError(
                f"the setpoint has {len(setpoint)} values, but the gains are for {gains.lanes} lanes: give one, or "
                "one per lane"
            )

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over accepted changes."""
        self.sigma_given_in = self._sigma_given_in(changes)
        if changes.keys() & (GAINS.keys() | OPTIONS.keys()):
            self.controller.change(*self._configured(changes))
        if "setpoint" in changes and self.commanded:
            self.get_logger().info("the parameter setpoint does nothing: the topic gives the setpoint, and it stays")
        elif "setpoint" in changes:
            self.session.set_setpoint(np.atleast_1d(changes["setpoint"]))
        if "output_timeout" in changes:
            self.session.timeout_ns = patience_ns(changes["output_timeout"], self.controller.sample_period_ns)
        if "experiment" in changes or self.session.guard.name:
            self._take_experiment(changes)

    def _sigma_given_in(self, changes: dict[str, Any]) -> str | None:
        """As the attribute will be. What an experiment's end restores is not given by that."""
        experiment = changes.get("experiment", self.session.guard.name)
        if self.gives_sigma and self.sigma_given_in != "":
            return str(experiment)
        return self.sigma_given_in if self.sigma_given_in in ("", experiment) else None

    def _take_experiment(self, changes: dict[str, Any]) -> None:
        guard, had = self.session.guard, self.session.guard.name
        settings, now_ns = self.values_of(list(EXPERIMENT)), time.monotonic_ns()
        if guard.take(changes, settings, self.controller.integral, now_ns):
            self.session.go_back()
        if had and not guard.name:
            self.get_logger().warning(one_line(f"experiment {had} has ended ({guard.why}); all else is as before"))

    def _is_setpoint_of_now(self, value: Any) -> bool:
        """Whether a value is that of the parameter as it stands, of a dump for one, or the setpoint as commanded."""
        new, of_lanes = np.atleast_1d(value), self.session.lanes_setpoint
        before = np.atleast_1d(self.values_of(["setpoint"])["setpoint"])
        return np.array_equal(new, before) or bool(len(new) in (1, len(of_lanes)) and (new == of_lanes).all())

    def _configured(self, changes: dict[str, Any]) -> tuple[Gains, ControllerOptions]:
        """Gains and options with some parameters changed; ValueError if they are not valid."""
        # Out of the parameters as they are set, as `verify` finds them in a bag.
        now = {**self.values_of([*GAINS, *OPTIONS, "joint_names"]), **changes}
        gains, options = gains_from_mapping(now), options_from_mapping(now)
        options.check_lanes(gains)
        if self.joints.names and gains.lanes != len(self.joints.names):
            raise ValueError(
                f"the gains are for {gains.lanes} lanes, but joint_names has {len(self.joints.names)} names: give one "
                "value, or one per joint"
            )
        if self.effort_to is not None and not self.effort_to.fits(gains.lanes):
            raise ValueError(f"effort_to has no field for each of {gains.lanes} lanes: give one per lane")
        if gains.lanes != self.controller.lanes and self._answers_live_outputs:
            raise ValueError(
                f"the gains are for {gains.lanes} lanes, but the loop that runs has {self.controller.lanes}: "
                "deactivate the controller first"
            )
        return gains, options

    @property
    def _answers_live_outputs(self) -> bool:
        """Whether it is in a loop in realtime, whose number of lanes is not ours to change."""
        return self.active and self.session.is_live and not self.session.silent

    def _look_for_stall(self) -> Stall | None:
        """Whether the loop has been driven off; said once, with the time to expect where a file tells the plant.

        In lockstep, where a tuner tries many gains, only the first time.
        """
        stall = self.stall_watch.look(self.controller)
        is_new = stall is not None and not self.is_driven_off
        self.is_driven_off = stall is not None or (self.is_driven_off and not self.session.is_live)
        if stall is not None and is_new:  # in a thread: the plant's file takes its time
            threading.Thread(target=self._tell_of_stall, args=(stall, self.controller.gains), daemon=True).start()
        return stall

    def _tell_of_stall(self, stall: Stall, gains: Gains) -> None:
        from tdof_npid_ros.stability.creep import time_to_expect  # takes its time, and is rarely needed

        expected = next(
            (time for _, case in _cases_of(sys.argv) if (time := time_to_expect(case, gains, stall.lane, stall.error))),
            None,
        )
        lasts = f"; with the plant of the file that takes about {expected:.2g} s" if expected else ""
        remedy = "set full_unwinding" if stall.unwinds and not gains.full_unwinding else "set a larger sigma"
        self.get_logger().warning(f"{stall}{lasts}. To bring it back, {remedy}, or move the setpoint to the output")

    def state(self) -> tuple[int, str, dict[str, object]]:
        """For the diagnostics."""
        facts: dict[str, object] = {
            "type": self.controller.gains.type,
            "lanes": self.controller.lanes,
            "parameters": self.controller.digest,
        }
        session = self.session
        if session.waiting is not None:
            return WARN, "an output waits for its plan on scenario_plan: start the scenario", facts
        if session.stamp_ns is None and self.why_refused:
            return ERROR, one_line(self.why_refused), facts
        if session.stamp_ns is None and self.output_from is not None:
            awaited = ", ".join(self.output_from.awaited)
            return WARN, f"nothing on {awaited} yet, where output_from takes the output from", facts
        if session.stamp_ns is None:
            return WARN, "no output yet: start the plant, or remap output to your robot's joint_states", facts
        facts["time_s"] = session.stamp_ns / 1e9
        if session.is_stuck:
            return ERROR, STUCK, facts
        if session.silent:
            stopped = "output has stopped: look after the plant; the effort is as it was"
            return ERROR, one_line(self.why_refused) or stopped, facts
        if session.is_out_of_step:
            return ERROR, OFF_RATE if session.is_live else OUT_OF_STEP, facts
        if session.guard.name:
            return OK, one_line(f"experiment {session.guard.name} has the loop"), facts
        if (stall := self._look_for_stall()) is not None:
            facts |= {"k_of_error": stall.scale, "integral_rate": stall.rate, "error_in_sigma": stall.in_sigma}
            if session.is_live:  # else a plan's end ends it
                return ERROR, DRIVEN_OFF, facts
        if self.controller.options.manual:
            return OK, "in manual mode: set manual to false for the law", facts
        return OK, "running", facts


def _short(gain: Lanes) -> str:
    """A gain for the log: the number, or the first ones of the lanes."""
    if not isinstance(gain, tuple):
        return f"{gain:g}"
    shown = " ".join(f"{one:g}" for one in gain[:SHOWN_NAMES])
    return f"[{shown}]" if len(gain) <= SHOWN_NAMES else f"[{shown} …]"


def _check_sigma(type_: str, arguments: Sequence[str] = ()) -> None:
    """Refuse a type that needs sigma where none is given: 1 of the output's unit would be a guess."""
    if type_ != "pid":
        raise ValueError(
            f"type {type_} needs sigma, which is not given: set it to the largest change of the setpoint, in the "
            f"output's unit{_of_files(arguments)}; or take type pid"
        )


def _of_files(arguments: Sequence[str]) -> str:
    """What the parameter files among a node's arguments say of the setpoint's largest change, for a message."""
    return next((f" (in {path}: {step:g})" for path, case in _cases_of(arguments) if (step := case.largest_step)), "")


def _cases_of(arguments: Sequence[str]) -> Iterator[tuple[str, Case]]:
    """The parameter files among a node's arguments that are cases, with a plant."""
    for option, path in pairwise(arguments):
        if option == "--params-file":
            from tdof_npid_ros.case import load_case  # with all plants, which a controller rarely needs

            with suppress(ValueError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield path, load_case(path)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run_node(ControllerNode, sys.argv if args is None else args)
