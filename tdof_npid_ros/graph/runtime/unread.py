"""Messages that have arrived, but of which the events executor was not told.

When it takes a node over, rmw_fastrtps counts what each reader holds unread and only then arms the reader's listener. A
message that arrives in between raises no event, and would lie there until the next one. It is rare (one of some 50,000
readers), but what is latched has no next one. So what lies in the readers is taken by hand: once after the executor has
the node, and once a second for what was created later.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

MOST_AT_ONCE = 1000  # messages of one reader, so that a fast publisher does not hold the node up


def take_unread(node: Node) -> int:
    """Serve by hand what lies in a node's subscriptions and services; returns how much it was.

    In the executor's thread, for a node whose callbacks are plain functions.
    """
    return sum(map(_serve_subscription, list(node.subscriptions))) + sum(map(_serve_service, list(node.services)))


def _serve_subscription(subscription: Any) -> int:
    handle, kind, raw = subscription.handle, subscription.msg_type, subscription.raw
    served = 0
    with handle:
        while served < MOST_AT_ONCE and (taken := handle.take_message(kind, raw)) is not None:
            with_info = subscription._callback_type is subscription.CallbackType.WithMessageInfo
            subscription.callback(*(taken if with_info else taken[:1]))
            served += 1
    return served


def _serve_service(service: Any) -> int:
    handle, kind = service.handle, service.srv_type
    served = 0
    with handle:
        while served < MOST_AT_ONCE:
            request, header = handle.service_take_request(kind.Request)
            if header is None:
                break
            service.send_response(service.callback(request, kind.Response()), header)
            served += 1
    return served
