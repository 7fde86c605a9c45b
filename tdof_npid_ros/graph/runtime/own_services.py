"""The services that rclpy makes by itself for every node: no request to one of them ends the node.

Their callbacks raise for what a request may hold: a parameter's type that there is not, a transition that the present
state does not have. An exception in a callback would end the process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically

from tdof_npid_ros.one_line import one_line

Refuse: TypeAlias = Callable[[str, str, str], None]
Answer: TypeAlias = Callable[[Any, Any], Any]


def guard_services(services: Iterable[Any], refuse: Refuse) -> None:
    """Let each of these services refuse a request that its callback raises for.

    Args:
        refuse: called with a count's name, a cause and a detail.
    """
    for service in services:
        guarded = _one_by_one if service.srv_type is SetParameters else _guarded
        service.callback = guarded(service.callback, service.srv_type, service.srv_name, refuse)


def _guarded(answer: Answer, kind: Any, name: str, refuse: Refuse) -> Answer:
    def guarded(request: Any, response: Any) -> Any:
        try:
            return answer(request, response)
        except Exception as error:  # whatever it is, it is the request's fault
            reason = one_line(error) or type(error).__name__
            refuse("refused_requests", f"a request to {name} refused", f": {reason}")
            return _refusal(kind, reason)

    return guarded


def _one_by_one(
    answer: Callable[[Any, Any], Any], kind: Any, name: str, refuse: Callable[[str, str, str], None]
) -> Any:
    """Parameters that are to be set one by one are also refused one by one."""
    guarded = _guarded(answer, SetParametersAtomically, name, refuse)

    def each(request: Any, response: Any) -> Any:
        for parameter in request.parameters:
            one = guarded(kind.Request(parameters=[parameter]), kind.Response())
            response.results += one.results if isinstance(one, kind.Response) else [one.result]
        return response

    return each


def _refusal(kind: Any, reason: str) -> Any:
    """What a service answers to a request that it refuses."""
    response = kind.Response()
    if kind is SetParametersAtomically:
        response.result = SetParametersResult(successful=False, reason=reason)
    elif kind is ChangeState:
        response.success = False
    return response
