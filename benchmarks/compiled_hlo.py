"""What XLA made of a program, read from the text of the compiled module: kernels, loops, branches, collectives."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from math import prod
from typing import NamedTuple

# Operations that only name, group or wait for others.
_NO_KERNEL = {
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "conditional", "call", "async-start",
    "after-all", "add-dependency", "opt-barrier", "partition-id", "replica-id",
}  # fmt: skip
_COLLECTIVES = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute", "ragged-all-to-all")
_HEADER = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\{$")
_OPERATION = re.compile(r"^\s+(?:ROOT )?%?[\w.\-]+ = (.*?) ([a-z][\w\-]*)\((.*)$")
_CALLED = re.compile(r"(?:body|condition|calls|to_apply|\w+_computations?)=(\{[^}]*\}|%[\w.\-]+)")
_ARRAY = re.compile(r"\b(?:pred|[a-z]+(\d+)\w*)\[([\d,]*)\]")


class Operation(NamedTuple):
    """One operation, the type of its result, the rest of its line, and how often a run of the program starts it.

    Bodies of counted loops count for every step, those of loops of unknown length and all branches once.
    """

    opcode: str
    type: str
    rest: str
    times: int


class Summary(NamedTuple):
    """`kernels` counts by opcode what a run starts: fused kernels, library calls, copies, sorts and so on.

    `counted_steps` is the number of steps of all loops whose length is known, `collectives` maps each kind to its
    number and the bytes of its results on one device.
    """

    kernels: dict[str, int]
    unknown_loops: int
    counted_steps: int
    conditionals: int
    collectives: dict[str, tuple[int, int]]


def summarise(text: str) -> Summary:
    """Summarise a compiled module from the text of it."""
    kernels: Counter[str] = Counter()
    number: Counter[str] = Counter()
    volume: Counter[str] = Counter()
    unknown = steps = conditionals = 0
    for operation in operations(text):
        opcode, times = operation.opcode, operation.times
        if opcode == "while":
            length = trip_count(operation)
            unknown, steps = unknown + times * (length is None), steps + times * (length or 0)
        conditionals += times * (opcode == "conditional")
        if opcode not in _NO_KERNEL and not opcode.endswith(("-done", "-update")):
            kernels[opcode.removesuffix("-start")] += times
        # What has started has its result where it is done.
        if (kind := opcode.removesuffix("-done")) in _COLLECTIVES:
            number[kind] += times
            volume[kind] += times * result_bytes(operation.type)
    collectives = {name: (count, volume[name]) for name, count in number.items()}
    return Summary(dict(kernels.most_common()), unknown, steps, conditionals, collectives)


def operations(text: str) -> Iterator[Operation]:
    """All operations that are reached from the entry, without the insides of fusions and of reductions."""
    computations, entry = _computations(text)

    def walk(name: str, times: int) -> Iterator[Operation]:
        for operation in computations[name]:
            yield operation._replace(times=times)
            if operation.opcode in ("while", "conditional", "call", "async-start"):
                repeat = trip_count(operation) or 1 if operation.opcode == "while" else 1
                for called in _called(operation):
                    yield from walk(called, times * repeat)

    return walk(entry, 1)


def trip_count(loop: Operation) -> int | None:
    """The number of steps of a loop, None if the compiler does not know it."""
    found = re.search(r'known_trip_count":\{"n":"(\d+)"', loop.rest)
    return int(found[1]) if found else None


def result_bytes(result: str) -> int:
    """Bytes of an array or a tuple of arrays of the type `result`, without padding."""
    return sum(
        int(bits or 8) // 8 * prod(int(size) for size in sizes.split(",") if size)
        for bits, sizes in _ARRAY.findall(result)
    )


def _computations(text: str) -> tuple[dict[str, list[Operation]], str]:
    computations: dict[str, list[Operation]] = {}
    entry = name = ""
    for line in text.splitlines():
        if header := _HEADER.match(line):
            name = header[2]
            computations[name], entry = [], name if header[1] else entry
        elif found := _OPERATION.match(line):
            computations[name].append(Operation(found[2], found[1], found[3], 1))
    return computations, entry


def _called(operation: Operation) -> list[str]:
    groups = _CALLED.findall(operation.rest)
    return [name.strip(" {}%") for group in groups for name in group.split(",")]
