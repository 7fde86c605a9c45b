"""What the loop's nodes share: parameters, diagnostics, warnings and life cycle."""

from __future__ import annotations

import copy
import functools
import inspect
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tdof_npid_ros.bag import schema
from tdof_npid_ros.bag.cdr import decode, decode_with
from tdof_npid_ros.bag.definition import parse
from tdof_npid_ros.bag.errors import BagError
from tdof_npid_ros.control.fields import FieldReader
from tdof_npid_ros.graph.runtime.endpoints import Endpoints
from tdof_npid_ros.graph.runtime.messages import diagnostics_message
from tdof_npid_ros.graph.runtime.own_services import guard_services
from tdof_npid_ros.graph.runtime.realtime import collect_garbage
from tdof_npid_ros.graph.runtime.unread import take_unread
from tdof_npid_ros.interfaces import message_class
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter import Parameter, Table, infinity_as_float
from tdof_npid_ros.parameter_file import ParameterFileError, is_for, sections_of
from tdof_npid_ros.parameters import AUTOSTART, misspelt
from tdof_npid_ros.wire import Sample, SignalReader

DIAGNOSTICS_PERIOD = 1.0  # s
WAIT_UNTIL_TOLD = 5.0  # s
SHOWN_VALUES = 8  # of an array, in a log
STEADY = Clock(clock_type=ClockType.STEADY_TIME)

OK, WARN, ERROR = (level[0] for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR))


class LoopNode(LifecycleNode):  # type: ignore[misc]  # rclpy has no type hints
    """A managed node of the loop.

    Subclasses declare their parameters in `__init__`, check changes in `checked` and take them over in `changed`,
    and create what they publish and subscribe in `activate`. What `activate` has created is destroyed on deactivation.
    """

    uses_events_executor = True

    def __init__(self, name: str) -> None:
        self._activating = False
        self._activation = 0  # how often it has been activated
        self.leftovers: list[Callable[[], None]] = []  # how to destroy what ended activations have left
        self._parameters_known: dict[str, Parameter] = {}
        super().__init__(name)
        self.counts: Counter[str] = Counter()
        self.quiet_parameters: set[str] = set()  # changes of them are not logged: they come from a topic
        self.active = False
        self.in_simulated_time = False  # `use_sim_time`
        self.activation_error: Exception | None = None
        self._why_inactive = "inactive: waits for its activation"
        self.endpoints = Endpoints(self, self.refuse)
        guard_services(self.services, self.refuse)
        self._warned: set[str] = set()
        self._waits_for, self._waits_since_ns = "", 0
        for warning in for_another_name(sys.argv, name, self.get_fully_qualified_name()):
            self.get_logger().warning(one_line(warning))
        self.autostart = bool(self.declare(AUTOSTART))
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(DIAGNOSTICS_PERIOD, self._on_diagnostics_timer, clock=STEADY)

    # What a subclass fills in

    def activate(self) -> None:
        """Create publishers, subscriptions, services and timers, and begin to work."""

    def deactivate(self) -> None:
        """Stop working, before what `activate` created is destroyed."""

    def finished(self, status: int) -> int:
        """What is to be told at the end, while the process may still take its time; returns its exit status.

        After this, it ends within seconds, wherever it is.
        """
        return status

    def completed(self, changes: dict[str, Any]) -> dict[str, Any]:
        """A set of parameter changes, not checked yet, with what is to be set together with them."""
        return changes

    def checked(self, changes: dict[str, Any]) -> None:
        """Check a set of parameter changes as a whole; raise ValueError, with the reason, to refuse it."""

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over a set of accepted parameter changes."""

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Level, one line for an operator, and facts, for the diagnostics."""
        return OK, "", {}

    def summary(self) -> str:
        """What the node will do, in a few words, for the line in its log that says that it is ready."""
        return ""

    def destroy_node(self) -> None:
        """As `Node.destroy_node`, and leave the DDS domain.

        rclpy forgets a managed node's state machine, which would keep the node in the domain until the process has
        ended.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    # Time

    @property
    def silence_ns(self) -> int | None:
        """Time by which silence counts, ns: of a clock that is never set; or simulated time, which may stand still.

        None: simulated time has not begun.
        """
        return (self.get_clock().now().nanoseconds or None) if self.in_simulated_time else time.monotonic_ns()

    # Topics

    def publisher_of(
        self, message_type: Any, topic: str, qos: QoSProfile, matched: Callable[[Any], None] | None = None
    ) -> Any:
        """A publisher that reports missed deadlines and profiles that do not fit."""
        events = self.endpoints.publisher_events(topic, matched and self._while_active(matched))
        return self.create_publisher(message_type, topic, qos, event_callbacks=events)

    def subscribe(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[..., None],
        qos: QoSProfile,
        sole: bool = False,
        raw: bool = False,
    ) -> None:
        """A subscription that reports profiles that do not fit and, if one publisher is expected, a second one."""
        events = self.endpoints.subscription_events(topic, sole)
        self.create_subscription(message_type, topic, callback, qos, event_callbacks=events, raw=raw)

    def subscribe_signal(
        self, topic: str, callback: Callable[[Sample], None], qos: QoSProfile, sole: bool = False
    ) -> None:
        """As `subscribe`, to a signal."""
        reader = SignalReader()

        def on_data(data: bytes) -> None:
            try:
                sample = reader.read(data)
            except ValueError as error:
                self.refuse("rejected", f"unreadable {topic} refused", f": {error}")
            else:
                callback(sample)

        self.subscribe(JointState, topic, on_data, qos, sole, raw=True)

    def subscribe_fields(
        self, fields: FieldReader, callback: Callable[[Sample], None], qos: QoSProfile, sole: bool = False
    ) -> None:
        """As `subscribe_signal`, to fields of topics of any installed type.

        Raises:
            ValueError: the type is not installed, or has no such field.
        """
        for topic, kind in fields.types.items():
            on_data = self._reads_fields(fields, topic, kind, callback)
            self.subscribe(message_class(kind), topic, on_data, qos, sole, raw=True)

    def _reads_fields(
        self, fields: FieldReader, topic: str, kind: str, callback: Callable[[Sample], None]
    ) -> Callable[..., None]:
        definition = parse(kind, schema.definition(kind))

        def on_data(*taken: Any) -> None:
            data, info = taken if len(taken) == 2 else taken[0]  # the events executor passes both as one
            try:
                sample = fields.read(topic, decode_with(definition, data), info["source_timestamp"])
            except (ValueError, BagError) as error:
                self.refuse("rejected", f"{topic} refused", f": {error}")
            else:
                if sample is not None:
                    callback(sample)

        on_data.__signature__ = _WITH_INFO  # type: ignore[attr-defined]  # by it rclpy knows that info is asked for
        return on_data

    # What `activate` creates is done with after a transition, yet an executor may hold calls of it that were due
    # before.

    def create_subscription(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[..., Any],
        *args: Any,
        raw: bool = False,
        **kw: Any,
    ) -> Any:
        """As `Node.create_subscription`; one made in `activate` is silent once the node is inactive.

        Of a message whose bytes are wrong, nothing is made: the middleware would first make room for as many messages
        within it as the bytes say, gigabytes for a few bytes.
        """
        on_data = callback if raw else self._of_bytes(message_type, topic, callback)
        return super().create_subscription(
            message_type, topic, self._while_active(on_data), *args, raw=raw or on_data is not callback, **kw
        )

    def _of_bytes(self, message_type: Any, topic: str, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """A callback for a type's serialized messages; the callback itself where no message can hold many others."""
        type_name = f"{message_type.__module__.partition('.')[0]}/msg/{message_type.__name__}"
        definition = schema.definition(type_name)
        if not parse(type_name, definition).has_sequence_of_messages:
            return callback

        def on_data(data: bytes) -> None:
            try:
                decode(type_name, definition, data)
                message = deserialize_message(data, message_type)
            except Exception as error:  # of ours or of the middleware's
                self.refuse("rejected", f"unreadable {topic} refused", f": {error}")
            else:
                callback(message)

        return on_data

    def create_timer(self, period: float, callback: Callable[..., Any], *args: Any, **kw: Any) -> Any:
        """As `Node.create_timer`; one made in `activate` is silent once the node is inactive."""
        return super().create_timer(period, self._while_active(callback), *args, **kw)

    def create_service(self, service_type: Any, name: str, callback: Callable[..., Any], *args: Any, **kw: Any) -> Any:
        """As `Node.create_service`; one made in `activate` answers with nothing done once the node is inactive."""
        return super().create_service(service_type, name, self._while_active(callback), *args, **kw)

    def _while_active(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        if not self._activating:
            return callback

        activation = self._activation

        @functools.wraps(callback)  # rclpy looks at the signature
        def guarded(*args: Any) -> Any:
            if self.active and self._activation == activation:
                return callback(*args)
            return args and args[-1]  # for a service: its response, as it was

        return guarded

    # Parameters

    def declare_all(self, parameters: Table, **defaults: Any) -> dict[str, Any]:
        """Declare parameters and return their values, by name; those that are declared already are passed over.

        Args:
            defaults: in place of the parameters' own, where those depend on something else.

        Raises:
            ParameterError: a value is of the wrong kind, out of its range, or none of the choices.
        """
        for name, parameter in parameters.items():
            if name not in self._parameters_known:
                self.declare(parameter, defaults.get(name))
        return self.values_of(list(parameters))

    def declare(self, parameter: Parameter, default: Any = None) -> Any:
        """Declare a parameter and return its value. Its type is checked by the node, so that 10 does for 10.0.

        Args:
            default: in place of the parameter's own.

        Raises:
            ParameterError: its value is of the wrong kind, out of its range, or none of the choices.
        """
        name = parameter.name
        self._parameters_known[name] = parameter
        descriptor = ParameterDescriptor(
            description=f"{parameter.description} ({parameter.unit})" if parameter.unit else parameter.description,
            additional_constraints=parameter.constraints,
            read_only=parameter.fixed,
            dynamic_typing=True,
        )
        self.declare_parameter(name, parameter.default if default is None else default, descriptor)
        return self.values_of([name])[name]

    def describe_parameter(self, name: str) -> ParameterDescriptor:
        """As `Node.describe_parameter`, and with the range of the table, for sliders.

        rclpy does not get the range itself: it would refuse by it before `checked`, without a count and with less of a
        reason.
        """
        descriptor = copy.copy(super().describe_parameter(name))
        parameter = self._parameters_known.get(name)
        if parameter is not None and parameter.is_slider:
            low, high = parameter.within.low, parameter.within.high
            if parameter.kind is int:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
            else:
                descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        return descriptor

    def values_of(self, names: Sequence[str]) -> dict[str, Any]:
        """Declared parameters by name, as their table takes them."""
        values = {name: plain(self.get_parameter(name).value) for name in names}
        # ROS passes an empty list as nothing.
        return {
            name: [] if value is None and self._parameters_known[name].is_list else self._taken(name, value)
            for name, value in values.items()
        }

    def _taken(self, name: str, value: Any) -> Any:
        """A parameter's value as its table takes it; one of ROS's own as it is."""
        known = self._parameters_known.get(name)
        return known.checked(value) if known else value

    def accept_changes(self) -> None:
        """From now on, parameters may be changed from outside; all are declared."""
        self._warn_of_unknown_parameters()
        self.add_pre_set_parameters_callback(self._as_declared)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.add_post_set_parameters_callback(self._on_parameters_set)

    def _warn_of_unknown_parameters(self) -> None:
        """ROS passes over what a parameter file gives a node that does not know it, a misspelt gain for one."""
        given = (name for name in self._parameter_overrides if not self.has_parameter(name))
        for warning in misspelt(given, self._parameters_known):
            self.get_logger().warning(warning)

    def _as_declared(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Whole numbers, and the word inf, for parameters that are floats: what `ros2 param set` and `load` send.

        And what belongs to the changes: see `completed`.
        """
        declared = [
            RosParameter(parameter.name, value=as_float(plain(parameter.value)))
            if (its := self._parameters_known.get(parameter.name)) and its.kind is float
            else parameter
            for parameter in parameters
        ]
        changes = {parameter.name: plain(parameter.value) for parameter in declared}
        added = self.completed(changes)
        return [*declared, *(RosParameter(name, value=added[name]) for name in added if name not in changes)]

    def _on_set_parameters(self, parameters: list[RosParameter]) -> SetParametersResult:
        changes = {parameter.name: plain(parameter.value) for parameter in parameters}
        try:
            self.checked({name: self._taken(name, value) for name, value in changes.items()})
        except (ValueError, TypeError, ArithmeticError) as error:
            cause = f"parameters {', '.join(changes)} refused"
            if changes.keys() <= self.quiet_parameters:
                self.refuse("refused_parameters", cause, f": {error}")
            else:
                self.counts["refused_parameters"] += 1
                self.get_logger().warning(one_line(f"{cause}: {error}"))
            return SetParametersResult(successful=False, reason=one_line(error))
        self._before = {name: plain(self.get_parameter_or(name).value) for name in changes}
        return SetParametersResult(successful=True)

    def _on_parameters_set(self, parameters: list[RosParameter]) -> None:
        changes = {parameter.name: plain(parameter.value) for parameter in parameters}
        for name, value in changes.items():
            before = self._before.get(name)
            if name not in self.quiet_parameters and value != before:
                self.get_logger().info(one_line(f"{name}: {shortened(before)} -> {shortened(value)}"))
        self.changed({name: self._taken(name, value) for name, value in changes.items()})

    # Reporting

    def warn_once(self, text: str) -> None:
        """Log a warning; the same text only once."""
        if text not in self._warned:
            self._warned.add(text)
            self.get_logger().warning(one_line(text))

    def refuse(self, count: str, cause: str, detail: str = "", times: int = 1) -> None:
        """Count something that was refused; the first time for each cause, log it with its detail."""
        self.counts[count] += times
        if cause not in self._warned:
            self._warned.add(cause)
            self.get_logger().warning(
                f"{one_line(cause + detail)} (further ones are only counted, as {count!r} in /diagnostics)"
            )

    def publish_diagnostics(self) -> None:
        """Publish the node's state and counts now; it happens once a second anyway."""
        level, text, facts = self.state() if self.active else (WARN, self._why_inactive, {})
        self._tell_of_waiting(text if self.active and level == WARN else "")
        if self.endpoints.conflicts:
            level, text = max(level, WARN), "; ".join([text, *self.endpoints.conflicts])
        stamp = self.get_clock().now().to_msg()
        name = self.get_fully_qualified_name()
        self._diagnostics_publisher.publish(diagnostics_message(stamp, name, level, text, {**facts, **self.counts}))

    def _tell_of_waiting(self, text: str) -> None:
        """Log once what the node has been waiting for for some seconds, or what is not as it should be."""
        now = STEADY.now().nanoseconds
        if text != self._waits_for:
            self._waits_for, self._waits_since_ns = text, now
        elif text and now - self._waits_since_ns >= WAIT_UNTIL_TOLD * 1e9:
            self.warn_once(f"{text} (so for {WAIT_UNTIL_TOLD:g} s)")

    def _on_diagnostics_timer(self) -> None:
        if self.uses_events_executor:
            take_unread(self)
        self.in_simulated_time = self.get_clock().ros_time_is_active
        self.endpoints.look()
        self.publish_diagnostics()
        collect_garbage()

    # Life cycle

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        self._lasting = [id(entity) for _, entity in self._entities()]
        self._activating = True
        self._activation += 1
        self.in_simulated_time = self.get_clock().ros_time_is_active
        try:
            self.activate()
        except Exception as error:  # rclpy would only go to an error state, without a word
            self.activation_error = error
            self.get_logger().error(f"not activated: {error}")
            self._leave_what_activate_created()
            return TransitionCallbackReturn.FAILURE
        finally:
            self._activating = False
        self.active = True
        self.get_logger().info(one_line(f"ready: {self.summary() or self.state()[1]}"))
        self.publish_diagnostics()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working."""
        self._stop_working()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working for good, also without having been deactivated."""
        self._why_inactive = "shut down for good: end the process, and start it again"
        self._stop_working()
        return super().on_shutdown(state)

    def _stop_working(self) -> None:
        if self.active:
            self.active = False
            self.deactivate()
            self._leave_what_activate_created()
        self.publish_diagnostics()

    def _entities(self) -> list[tuple[Callable[[Any], bool], Any]]:
        return [
            *((self.destroy_publisher, publisher) for publisher in self.publishers),
            *((self.destroy_subscription, subscription) for subscription in self.subscriptions),
            *((self.destroy_service, service) for service in self.services),
            *((self.destroy_client, client) for client in self.clients),
            *((self.destroy_timer, timer) for timer in self.timers),
        ]

    def _leave_what_activate_created(self) -> None:
        """Take it out of the node, so that the executor lets go of it, and leave it to `spin` to destroy it.

        See `_destroy_leftovers`.
        """
        for take_out_and_destroy, entity in self._entities():
            if id(entity) not in self._lasting:
                self.leftovers.append(entity.destroy)
                entity.destroy = _do_nothing
                take_out_and_destroy(entity)
        self.endpoints.forget()


_WITH_INFO = inspect.signature(lambda message, info: None)


def _do_nothing() -> None:
    pass


def plain(value: Any) -> Any:
    """A parameter's value with arrays as lists."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, (str, bytes)) else value


def shortened(value: Any) -> str:
    """A parameter's value for the log: of a long array its beginning."""
    if not isinstance(value, list) or len(value) <= SHOWN_VALUES:
        return str(value)
    return f"[{', '.join(map(repr, value[:SHOWN_VALUES]))}, … {len(value)} values]"


def for_another_name(arguments: Sequence[str], program: str, node: str) -> list[str]:
    """What to warn of: parameters on a command line for the program's own name, of a node that is called otherwise.

    ROS passes over what is for another node, so the node would go by its defaults.

    Args:
        arguments: the command line.
        program: the node's name unless it is given another.
        node: its full name.
    """
    own = node.rpartition("/")[2]
    warned = []
    for option, value in pairwise(arguments):
        if option == "--params-file":
            try:
                sections = sections_of(Path(value))
            except ParameterFileError:
                continue  # ROS has read it in its own way
        elif option in ("-p", "--param") and ":" in value.partition(":=")[0]:
            sections = [value.partition(":")[0]]
        else:
            continue
        meant = [section for section in sections if section.rpartition("/")[2] in (program, own)]
        if meant and not any(is_for(section, node) for section in meant):
            warned.append(
                f"{value} gives this node, {node}, nothing: it is for {', '.join(meant)}; write /**/{own} instead"
            )
    return warned


def as_float(value: Any) -> Any:
    """A whole number, or a word for infinity, as a float, alone or in a list; anything else as it is."""
    value = infinity_as_float(value)
    if isinstance(value, list):
        return [as_float(one) for one in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
