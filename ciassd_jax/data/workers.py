"""Detection of worker processes that die."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from typing import Any

# Seconds between two checks of the workers, and to wait for what a dead one had ready.
_INTERVAL, _PATIENCE = 0.1, 2.0
_DIED = "Worker process was terminated"


class WorkerError(RuntimeError):
    """A worker process died; the message is one sentence with the usual causes."""


class Watched(Iterator[Any]):
    """Grain's iterator, made before its workers start; raises WorkerError for a worker that died.

    Grain reports dead workers, but waits forever for one that was killed while it wrote. Therefore a thread waits for
    Grain, while this object checks the workers.
    """

    def __init__(self, batches: Any) -> None:
        self._batches, self._answers = batches, SimpleQueue[tuple[Any, BaseException | None]]()
        self._others: set[Any] = set(multiprocessing.active_children())
        self._workers: set[Any] = set()

    def __next__(self) -> Any:
        # A daemon, because the program may end while Grain still waits.
        threading.Thread(target=self._take, daemon=True).start()
        value, error = self._answer()
        if isinstance(error, RuntimeError) and str(error).startswith(_DIED):
            raise _died(str(error).partition("exit code ")[2].partition(".")[0]) from None
        if error is not None:
            raise error
        return value

    def close(self) -> None:
        """End the workers."""
        if self._batches is not None:
            self._batches.close()

    def _take(self) -> None:
        try:
            self._answers.put((next(self._batches), None))
        except BaseException as error:
            # Raised by `__next__`.
            self._answers.put((None, error))

    def _answer(self) -> tuple[Any, BaseException | None]:
        dead = None
        while dead is None:
            try:
                return self._answers.get(timeout=_INTERVAL)
            except Empty:
                dead = self._dead()
            finally:
                self._workers |= set(multiprocessing.active_children()) - self._others
        try:
            return self._answers.get(timeout=_PATIENCE)
        except Empty:
            for worker in self._workers:
                worker.kill()
                worker.join(_PATIENCE)
            # Closing it would wait forever too.
            self._batches = None
            raise _died(dead) from None

    def _dead(self) -> int | None:
        """Return the exit code of a worker that failed, or None."""
        return next((worker.exitcode for worker in self._workers if worker.exitcode), None)


def _died(code: int | str) -> WorkerError:
    return WorkerError(
        f"A worker of the loader died (exit code {code}): memory may have run out, so use fewer workers or a smaller "
        "batch, or the script lacks `if __name__ == '__main__':`; then resume from the last checkpoint."
    )
