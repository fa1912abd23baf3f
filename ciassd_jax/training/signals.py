"""Signals that ask a program to end, deferred so that it can save first."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Signals(list[int]):
    """The signals that were received, in order."""

    _raise = False

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Let a signal, also one received before, raise KeyboardInterrupt at once: there is nothing to save."""
        if self:
            raise KeyboardInterrupt
        self._raise = True
        try:
            yield
        finally:
            self._raise = False

    def receive(self, number: int) -> None:
        self.append(number)
        if self._raise:
            raise KeyboardInterrupt


@contextmanager
def deferred_signals() -> Iterator[Signals]:
    """Yield a list to which the first SIGTERM or SIGINT is appended; a second signal gets the previous handler.

    An ignored signal, such as SIGINT in a background job, stays ignored. Outside the main thread nothing is handled.
    """
    received = Signals()
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGTERM, signal.SIGINT)}
    before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def defer(number: int, _: object) -> None:
        restore()
        received.receive(number)

    for number in before:
        signal.signal(number, defer)
    try:
        yield received
    finally:
        restore()
