"""What the loop's nodes share: parameters, diagnostics, warnings, life cycle and `main`."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from tdof_npid_ros.graph.messages import diagnostics_message

SIGNAL_QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DIAGNOSTICS_PERIOD = 1.0  # s
SPIN_TIMEOUT = 0.5  # s; the events executor needs one (without it, this build spins a core and ignores SIGINT)

OK, WARN, ERROR = (level[0] for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR))


class LoopNode(LifecycleNode):
    """A managed node of the loop.

    Subclasses declare their parameters in `__init__`, check changes in `checked` and take them over in `changed`,
    and create what they publish and subscribe in `activate`.
    """

    uses_events_executor = True

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.counts: Counter[str] = Counter()
        self._warned: set[str] = set()
        self._declaring = True
        self.autostart = bool(
            self.declare_value("autostart", True, "activate at once; false: wait for a supervisor's transitions")
        )
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(DIAGNOSTICS_PERIOD, self.publish_diagnostics)

    # What a subclass fills in

    def activate(self) -> None:
        """Create publishers, subscriptions, services and timers, and begin to work."""

    def deactivate(self) -> None:
        """Stop working and destroy what `activate` created."""

    def checked(self, changes: dict[str, Any]) -> None:
        """Check a set of parameter changes as a whole; raise ValueError, with the reason, to refuse it."""

    def changed(self, changes: dict[str, Any]) -> None:
        """Take over a set of accepted parameter changes."""

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Level, one line for an operator, and facts, for the diagnostics."""
        return OK, "", {}

    # Parameters

    def declare_value(self, name: str, default: Any, description: str, *, fixed: bool = False) -> Any:
        """Declare a parameter and return its value. Its type is checked by the node, so that 10 does for 10.0."""
        descriptor = ParameterDescriptor(description=description, read_only=fixed, dynamic_typing=True)
        return plain(self.declare_parameter(name, default, descriptor).value)

    def values_of(self, names: Sequence[str]) -> dict[str, Any]:
        """Parameters by name."""
        return {name: plain(self.get_parameter(name).value) for name in names}

    def accept_changes(self) -> None:
        """From now on, parameters may be changed from outside."""
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.add_post_set_parameters_callback(self._on_parameters_set)

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = {parameter.name: plain(parameter.value) for parameter in parameters}
        try:
            self.checked(changes)
        except (ValueError, TypeError) as error:
            self.counts["refused_parameters"] += 1
            self.get_logger().warning(f"parameters {', '.join(changes)} refused: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        self._before = {name: plain(self.get_parameter_or(name).value) for name in changes}
        return SetParametersResult(successful=True)

    def _on_parameters_set(self, parameters: list[Parameter]) -> None:
        changes = {parameter.name: plain(parameter.value) for parameter in parameters}
        for name, value in changes.items():
            self.get_logger().info(f"{name}: {self._before.get(name)} -> {value}")
        self.changed(changes)

    # Reporting

    def refuse(self, count: str, cause: str) -> None:
        """Count something that was refused, and log it the first time for each cause."""
        self.counts[count] += 1
        if cause not in self._warned:
            self._warned.add(cause)
            self.get_logger().warning(f"{cause} (further ones are only counted, as {count!r} in /diagnostics)")

    def publish_diagnostics(self) -> None:
        """Publish the node's state and counts now; it happens once a second anyway."""
        level, text, facts = self.state()
        stamp = self.get_clock().now().to_msg()
        name = self.get_fully_qualified_name()
        self._diagnostics_publisher.publish(diagnostics_message(stamp, name, level, text, {**facts, **self.counts}))

    # Life cycle

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        self.activate()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working."""
        self.deactivate()
        return super().on_deactivate(state)


def plain(value: Any) -> Any:
    """A parameter's value with arrays as lists."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, (str, bytes)) else value


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """A parameter that must be a number within low..high.

    Raises:
        ValueError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r}: it must be a number from {low:g} to {high:g}")
    return float(value)


def run_node(make_node: Callable[[], LoopNode], arguments: list[str] | None = None) -> None:
    """Run a node until a signal; exit status 0 on a signal, 2 if it cannot start, with one line that says why."""
    rclpy.init(args=arguments)
    status, node = 0, None
    try:
        node = make_node()
        if node.autostart:
            node.trigger_configure()
            node.trigger_activate()
        spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ValueError, OSError) as error:
        print(f"{sys.argv[0].rsplit('/', 1)[-1]}: {error}", file=sys.stderr)
        status = 2
    finally:
        if node is not None:
            node.deactivate()
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)


def spin(node: LoopNode) -> None:
    """Serve a node until the context is shut down."""
    executor = _fastest_executor() if node.uses_events_executor else SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok():
        executor.spin_once(timeout_sec=SPIN_TIMEOUT)


def _fastest_executor() -> Any:
    try:
        from rclpy.experimental import EventsExecutor  # in Jazzy since 2025, and two to three times as fast
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()
