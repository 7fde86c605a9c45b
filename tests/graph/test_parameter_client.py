"""What a client sends of a parameter, and what it refuses to send."""

from __future__ import annotations

import datetime
from types import SimpleNamespace
from typing import Any

import pytest


def sent(value: Any) -> Any:
    """What a node is asked to set its parameter `kp` to, as Python has it."""
    from rclpy.parameter import parameter_value_to_python

    from tdof_npid_ros.graph.runtime.parameter_client import RemoteNode

    requests: list[Any] = []

    def ask(request: Any) -> Any:
        requests.append(request)
        return SimpleNamespace(add_done_callback=lambda _: None)

    client = SimpleNamespace(srv_name="set", service_is_ready=lambda: True, call_async=ask)
    remote = RemoteNode(SimpleNamespace(create_client=lambda *_: client), "/controller")  # type: ignore[arg-type]
    remote.ask_to_set({"kp": value})
    remote.ask_to_set_each({"kp": value})
    together, each = (request.parameters[0].value for request in requests)
    assert together == each
    found = parameter_value_to_python(together)
    return list(found) if hasattr(found, "__len__") and not isinstance(found, str) else found


@pytest.mark.parametrize("value", [[5, 0.0], [0.5, 4], (1, 2.0, 3)])
def test_a_list_with_whole_numbers_among_others_is_one_of_floats(value: Any) -> None:
    found = sent(value)
    assert found == list(value) and {type(one) for one in found} == {float}


@pytest.mark.parametrize("value", [5, 5.0, True, "pid", [1, 2], [1.0, 2.0], ["a"], [True]])
def test_what_is_of_one_kind_is_sent_as_it_is(value: Any) -> None:
    found = sent(value)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    "value",
    [{"a": 1}, datetime.date(2024, 1, 1), [[1.0]], [1.0, "a"], [None], 2**63, [0, 2**63], [0.5, 10**400], "\udcff"],
)
def test_what_cannot_be_a_parameter_is_refused_by_its_name(value: Any) -> None:
    from tdof_npid_ros.graph.runtime.parameter_client import RefusedError

    with pytest.raises(RefusedError, match=r"^kp is .*: it must be true or false, a number") as refused:
        sent(value)
    assert "\n" not in str(refused.value)
