"""Reading ahead: a thread reads the next frames while the device works on the current ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import islice
from typing import TypeVar

from ciassd_jax.formats.errors import FormatWarning, collected_warnings, warn_of_file

Item = TypeVar("Item")
Value = TypeVar("Value")


def read_ahead(read: Callable[[Item], Value], items: Iterable[Item], ahead: int) -> Iterator[Callable[[], Value]]:
    """Yield for each item, in order, a function that returns `read(item)`; a thread reads `ahead` items in advance.

    The function gives the warnings of `warn_of_file` and raises the error of the reading, as `read` itself would.
    """

    def collect(item: Item) -> tuple[Value, list[FormatWarning]]:
        with collected_warnings() as found:
            return read(item), found

    remaining, pool = iter(items), ThreadPoolExecutor(1, "reader")
    pending: deque[Future[tuple[Value, list[FormatWarning]]]] = deque()
    try:
        while True:
            pending.extend(pool.submit(collect, item) for item in islice(remaining, ahead + 1 - len(pending)))
            if not pending:
                return
            yield partial(_take, pending.popleft())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _take(future: Future[tuple[Value, list[FormatWarning]]]) -> Value:
    value, found = future.result()
    for one in found:
        warn_of_file(str(one), one.source, stacklevel=4)
    return value
