"""Another node's parameters and services, as its clients see them.

    controller = RemoteNode(node, "/loop/controller")
    controller.set_parameters({"kp": 2.0, "ki": 0.5})            # waits; an executor spins `node` in another thread
    question = controller.ask_parameters(["kp", "ki"])           # does not wait: look at it now and then
    ...
    if question.look():
        print(question.answer)

A request or its answer may be lost: when the two sides have not found each other yet, or when the other side's executor
has not seen the request. So a question is asked again until it is answered.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import Trigger

from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.parameter import LONGEST_VALUE

ASK_AGAIN = 1.0  # s until a request is sent again
LOOK_PERIOD = 0.02  # s between two looks whether a service is there

T = TypeVar("T")
PassTime = Callable[[threading.Event, float], object]  # lets time pass until the event is set, or for so many seconds


class NoAnswerError(RuntimeError):
    """A node that does not answer; the message says for how long."""


class RefusedError(RuntimeError):
    """A node that refuses what it is asked for; the message gives its reason."""


class Question(Generic[T]):
    """A request that is sent as soon as the service is there, and again until it is answered.

    Args:
        client: of the service.
        request: for it.
        read: makes the answer of the response; raises RefusedError.
        repeats: whether it may be sent again; not what must not happen twice.

    Attributes:
        service: its full name.
        answered: set once the answer is here.
        asked_ns: when the request was sent first, in ns since the epoch; 0: not yet.
    """

    def __init__(self, client: Any, request: Any, read: Callable[[Any], T], repeats: bool = True) -> None:
        self.service = str(client.srv_name)
        self.answered = threading.Event()
        self.asked_ns = 0
        self._client, self._request, self._read = client, request, read
        self._repeats = repeats
        self._next_time = 0.0
        self._futures: list[Any] = []
        self._response: Any = None
        self._then: list[Callable[[], None]] = []
        self.look()

    def look(self) -> bool:
        """Ask if it is time to; whether the answer is here."""
        if not self.answered.is_set() and time.monotonic() >= self._next_time and self._client.service_is_ready():
            self.asked_ns = self.asked_ns or time.time_ns()
            self._next_time = time.monotonic() + ASK_AGAIN if self._repeats else math.inf
            future = self._client.call_async(self._request)
            self._futures.append(future)
            future.add_done_callback(self._take)
        return self.answered.is_set()

    @property
    def answer(self) -> T:
        """What was asked for, once it is here.

        Raises:
            RefusedError: the node refuses it.
        """
        return self._read(self._response)

    def then(self, callback: Callable[[], None]) -> None:
        """Call this, in the executor, when the answer comes, unless it is here already or the question is dropped."""
        self._then.append(callback)

    def drop(self) -> None:
        """Ask no more, and take no answer."""
        self._next_time, self._then = math.inf, []
        futures, self._futures = self._futures, []
        for future in futures:
            self._client.remove_pending_request(future)

    def _take(self, future: Any) -> None:
        if self.answered.is_set() or future not in self._futures:
            return
        self._response = future.result()
        self.answered.set()
        callbacks, self._then = self._then, []
        for callback in callbacks:
            callback()


class RemoteNode:
    """A node, as its clients see it.

    Args:
        node: through which the calls go. While one of the methods that wait does so, somebody must spin it.
        name: full name of the other node.
        timeout: s until it counts as silent.
        check: called while waiting; raises to give up.
        pass_time: how to wait; by default for an executor in another thread.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        timeout: float = 10.0,
        check: Callable[[], None] = lambda: None,
        pass_time: PassTime = threading.Event.wait,
    ) -> None:
        self.name = name
        self._node = node
        self._timeout = timeout
        self._check = check
        self._pass_time = pass_time
        self._clients: dict[str, Any] = {}

    def destroy(self) -> None:
        """Leave the graph; no executor may spin the node now."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients = {}

    # Asking without waiting

    def ask_names(self) -> Question[list[str]]:
        """The names of all its parameters."""
        client = self._client(ListParameters, "list_parameters")
        return Question(client, ListParameters.Request(), lambda response: list(response.result.names))

    def ask_values(self, names: Sequence[str]) -> Question[list[ParameterValue]]:
        """Parameters as messages, in the order of their names; none at all if the node does not have one of them."""
        client = self._client(GetParameters, "get_parameters")
        return Question(client, GetParameters.Request(names=list(names)), lambda response: list(response.values))

    def ask_parameters(self, names: Sequence[str]) -> Question[dict[str, Any]]:
        """Parameters by name; None for those that the node does not have."""

        def read(response: GetParameters.Response) -> dict[str, Any]:
            if len(response.values) != len(names):
                return dict.fromkeys(names)
            return {name: _plain(value) for name, value in zip(names, response.values, strict=True)}

        return Question(self._client(GetParameters, "get_parameters"), GetParameters.Request(names=list(names)), read)

    def ask_to_set(self, values: Mapping[str, Any]) -> Question[None]:
        """Set parameters as a whole: all, or none of them.

        Raises:
            RefusedError: no parameter can have that value.
        """

        def read(response: SetParametersAtomically.Response) -> None:
            if not response.result.successful:
                raise RefusedError(f"{self.name} refused {', '.join(values)}: {response.result.reason}")

        client = self._client(SetParametersAtomically, "set_parameters_atomically")
        return Question(client, SetParametersAtomically.Request(parameters=_messages(values)), read)

    def ask_to_set_each(self, values: Mapping[str, Any]) -> Question[dict[str, str]]:
        """Set parameters one by one; the answer gives the reasons for those that were refused, by name.

        Raises:
            RefusedError: no parameter can have that value.
        """

        def read(response: SetParameters.Response) -> dict[str, str]:
            results = zip(values, response.results, strict=False)
            return {name: result.reason for name, result in results if not result.successful}

        client = self._client(SetParameters, "set_parameters")
        return Question(client, SetParameters.Request(parameters=_messages(values)), read)

    def ask_trigger(self, service: str, repeats: bool = False) -> Question[str]:
        """Call one of its trigger services, `reset` say; the answer is the node's message."""

        def read(response: Trigger.Response) -> str:
            if not response.success:
                raise RefusedError(f"{self.name}/{service}: {response.message}")
            return str(response.message)

        return Question(self._client(Trigger, service), Trigger.Request(), read, repeats)

    def serves(self, service: str, kind: Any = Trigger) -> bool:
        """Whether one of its services is there."""
        return bool(self._client(kind, service).service_is_ready())

    # Waiting for the answer

    def wait(self, question: Question[T]) -> T:
        """The answer to a question.

        Raises:
            RefusedError: the node refuses it, with its reason.
            NoAnswerError: no answer within the timeout.
        """
        end = time.monotonic() + self._timeout
        while not question.look():
            self._check()
            if time.monotonic() > end:
                question.drop()
                raise NoAnswerError(f"{question.service} did not answer within {self._timeout:g} s")
            self._pass_time(question.answered, LOOK_PERIOD)
        return question.answer

    def parameter_names(self) -> list[str]:
        """As `ask_names`, and `wait`."""
        return self.wait(self.ask_names())

    def parameters(self, names: Sequence[str]) -> dict[str, Any]:
        """As `ask_parameters`, and `wait`."""
        return self.wait(self.ask_parameters(names))

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """As `ask_to_set`, and `wait`."""
        self.wait(self.ask_to_set(values))

    def trigger(self, service: str, repeats: bool = False) -> str:
        """As `ask_trigger`, and `wait`."""
        return self.wait(self.ask_trigger(service, repeats))

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """The response of any of its services, which may be asked twice."""
        return self.wait(Question(self._client(kind, service), request, lambda response: response))

    def _client(self, kind: Any, service: str) -> Any:
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, f"{self.name}/{service}")
        return self._clients[service]


@contextmanager
def told_as(silent: type[Exception], refused: type[Exception]) -> Iterator[None]:
    """Raise these errors in place of NoAnswerError and RefusedError."""
    try:
        yield
    except NoAnswerError as error:
        raise silent(str(error)) from error
    except RefusedError as error:
        raise refused(str(error)) from error


def _messages(values: Mapping[str, Any]) -> list[Any]:
    """Parameters as messages.

    Raises:
        RefusedError: no parameter can have that value.
    """
    return [_message(name, value) for name, value in values.items()]


def _message(name: str, value: Any) -> Any:
    """A parameter as a message; whole numbers among others in a list become floats, as a list is of one kind."""
    try:
        if isinstance(value, list | tuple) and set(map(type, value)) == {int, float}:
            value = [float(one) for one in value]
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, int):  # over what does not fit its message, the middleware ends the process
                one.to_bytes(8, "little", signed=True)
            elif isinstance(one, str):
                one.encode()
        return Parameter(name, value=value).to_parameter_msg()
    except (TypeError, ValueError, OverflowError):
        raise RefusedError(
            f"{name} is {one_line(value, LONGEST_VALUE)}: it must be true or false, a number (a whole one of 64 bits "
            "at most), text, or a list of one of these"
        ) from None


def _plain(value: ParameterValue) -> Any:
    """A parameter's value, arrays as lists."""
    found = parameter_value_to_python(value)
    return list(found) if hasattr(found, "__len__") and not isinstance(found, (str, bytes)) else found
