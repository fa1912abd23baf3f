"""Reading ahead: the order, how far, and what the reading raises and warns of."""

import threading
from collections.abc import Iterator

import pytest

from ciassd_jax.data.ahead import read_ahead
from ciassd_jax.formats.errors import FormatWarning, InputError, collected_warnings, warn_of_file


def test_values_come_in_order_and_no_more_items_are_taken_than_read_ahead() -> None:
    taken, read = [], []
    is_read = [threading.Event() for _ in range(8)]

    def items() -> Iterator[int]:
        for index in range(8):
            taken.append(index)
            yield index

    def square(index: int) -> int:
        read.append(threading.current_thread().name)
        is_read[index].set()
        return index**2

    values = []
    for index, take in enumerate(read_ahead(square, items(), 2)):
        # The next two are read while the caller is busy.
        assert all(event.wait(timeout=10) for event in is_read[: index + 3])
        assert len(taken) == min(index + 3, 8)
        values.append(take())
    assert values == [index**2 for index in range(8)]
    assert set(read) == {"reader_0"}
    assert list(read_ahead(square, [], 3)) == []


def test_warnings_and_errors_of_the_reading_reach_the_caller_with_their_item() -> None:
    def read(name: str) -> str:
        warn_of_file(f"{name} has 1 fault", name)
        if name == "b":
            raise InputError("b cannot be read; copy it again.")
        return name.upper()

    reading = read_ahead(read, "abc", 3)
    with pytest.warns(FormatWarning, match="^a has 1 fault$") as caught:
        assert next(reading)() == "A"
    assert len(caught) == 1
    with pytest.raises(InputError, match="b cannot be read"):
        next(reading)()
    with collected_warnings() as found:
        assert next(reading)() == "C"
    assert [(str(one), one.source, one.kind) for one in found] == [("c has 1 fault", "c", " has  fault")]
    assert next(reading, None) is None


def test_a_reader_that_is_left_reads_no_further() -> None:
    read, go_on = [], threading.Event()

    def wait(index: int) -> None:
        read.append(index)
        assert go_on.wait(timeout=10)

    reading = read_ahead(wait, range(9), 5)
    next(reading)
    reading.close()
    go_on.set()
    for thread in threading.enumerate():
        if thread.name.startswith("reader"):
            thread.join(timeout=10)
    assert read == [0]
