"""Ctrl-C is never lost, also where SIGINT is ignored, and waits for what must be done whole."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress

import pytest

from tdof_npid_ros.interruption import afterwards, check, heeded


@pytest.fixture(autouse=True, params=["as usual", "ignored"])
def before(request: pytest.FixtureRequest) -> Iterator[object]:
    """How SIGINT is handled before: in what a shell's script starts in the background it is ignored."""
    usual = signal.getsignal(signal.SIGINT)
    handler = signal.default_int_handler if request.param == "as usual" else signal.SIG_IGN
    signal.signal(signal.SIGINT, handler)
    yield handler
    found = signal.signal(signal.SIGINT, usual)
    assert found is handler or found == handler


def test_a_signal_interrupts_and_all_is_as_before() -> None:
    with pytest.raises(KeyboardInterrupt), heeded():
        signal.raise_signal(signal.SIGINT)
        pytest.fail("nothing was raised")
    check()


def test_one_that_is_swallowed_is_raised_again() -> None:
    class Swallows:
        def __del__(self) -> None:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), heeded():
        Swallows()
        check()
        pytest.fail("nothing was raised")


def test_it_waits_for_what_must_be_done_whole_unless_that_looks() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), heeded():
        with afterwards(), afterwards():
            signal.raise_signal(signal.SIGINT)
            done.append("whole")
        done.append("too much")
    assert done == ["whole"]
    with pytest.raises(KeyboardInterrupt), heeded(), afterwards():
        signal.raise_signal(signal.SIGINT)
        check()
        pytest.fail("nothing was raised")


def test_it_is_not_lost_when_that_fails() -> None:
    with pytest.raises(KeyboardInterrupt), heeded(), afterwards():
        signal.raise_signal(signal.SIGINT)
        raise ValueError


def test_without_heed_it_does_afterwards_what_it_would_have_done(before: object) -> None:
    done = []
    with suppress(KeyboardInterrupt):
        with afterwards():
            signal.raise_signal(signal.SIGINT)
        done.append("went on")
    assert done == (["went on"] if before is signal.SIG_IGN else [])
