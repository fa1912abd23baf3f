"""Dataclasses from parsed JSON, checked against their annotations."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, Literal


def rebuild(kind: Any, data: Any, where: str) -> Any:
    """A value of the annotated type from parsed JSON; ValueError names the field that is not as annotated."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        names = {f.name for f in dataclasses.fields(kind)}
        if not isinstance(data, dict) or set(data) != names:
            given = set(data) if isinstance(data, dict) else set()
            raise ValueError(
                f"{where}: expected the fields {sorted(names)}; unknown {sorted(given - names)}, "
                f"missing {sorted(names - given)}."
            )
        hints = typing.get_type_hints(kind)
        return kind(**{name: rebuild(hints[name], data[name], f"{where}.{name}") for name in data})
    if origin is tuple:
        if not isinstance(data, list):
            raise ValueError(f"{where}: expected a list, not {data!r}.")
        kinds = [arguments[0]] * len(data) if arguments[-1] is Ellipsis else list(arguments)
        if len(kinds) != len(data):
            raise ValueError(f"{where}: expected {len(kinds)} values, not {len(data)}.")
        return tuple(rebuild(k, item, f"{where}[{i}]") for i, (k, item) in enumerate(zip(kinds, data, strict=True)))
    if origin is Literal:
        # True == 1 == 1.0, but only one of them is meant.
        if not any(type(data) is type(argument) and data == argument for argument in arguments):
            raise ValueError(f"{where}: {data!r} is not one of {list(arguments)}.")
        return data
    if kind is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    if origin is types.UnionType and any(isinstance(data, a) for a in arguments):
        return data
    if type(data) is not kind:
        raise ValueError(f"{where}: expected {kind.__name__}, not {data!r}.")
    return data
