"""The page's server: on this machine alone, behind a token in the address."""

from __future__ import annotations

import logging
import secrets
import socket
from collections.abc import Callable
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server

ADDRESS = "127.0.0.1"


class LiveServer:
    """Serves one page to browsers on this machine that know its address.

    Args:
        page: fills a browser's document.
        port: to serve at; 0: a free one.

    Attributes:
        url: of the page, with its token: whoever knows it may steer the loop.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, page: Callable[[Document], object], port: int = 0) -> None:
        logging.getLogger("bokeh").setLevel(logging.ERROR)  # a browser that is closed is nothing to tell of
        token = secrets.token_urlsafe(16)
        port = _bindable(port)
        self._server: Any = Server(
            {"/": Application(FunctionHandler(lambda document: page(document) and None))},
            address=ADDRESS,
            port=port,
            prefix=f"/{token}",  # of everything, scripts too: without the token there is nothing here
            allow_websocket_origin=[f"{ADDRESS}:{port}"],
            check_unused_sessions_milliseconds=2000,
            unused_session_lifetime_milliseconds=10_000,
        )
        self.url = f"http://{ADDRESS}:{self._server.port}/{token}/"

    def run(self, until: Callable[[], bool]) -> None:
        """Serve until the condition holds, looked at several times a second, or Ctrl-C.

        Raises:
            Whatever the condition raises.
        """
        failures: list[BaseException] = []

        def look() -> None:
            try:
                done = until()
            except BaseException as error:
                failures.append(error)
                done = True
            if done:
                self._server.io_loop.stop()

        self._server.start()
        looking = _periodic(look)
        looking.start()
        try:
            self._server.io_loop.start()
        finally:
            looking.stop()
            self._server.stop()
        if failures:
            raise failures[0]


def _bindable(port: int) -> int:
    """The port, or a free one for 0.

    Raises:
        OSError: it is taken, or not ours to take.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((ADDRESS, port))
        except (OSError, OverflowError) as error:
            raise OSError(f"port {port} cannot be had ({error}): choose another --port, or none") from error
        return int(probe.getsockname()[1])


def _periodic(callback: Callable[[], None]) -> Any:
    from tornado.ioloop import PeriodicCallback

    return PeriodicCallback(callback, 200)
