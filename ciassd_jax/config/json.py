"""Read configs from JSON: check values against the annotations, and accept the field names of earlier versions."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable
from typing import Any, Literal

# Old name to new name of the fields that earlier versions named differently, by section.
RENAMED = {
    "AugmentationConfig": {"paste": "gt_sampling"},
    "DataConfig": {"max_paste_points": "max_gt_sampling_points"},
    "ClassConfig": {"paste_up_to": "gt_sampling_up_to", "paste_min_points": "gt_sampling_min_points"},
    "DetectionConfig": {"nms_overlap": "nms_iou_threshold"},
    "ScheduleConfig": {
        "accumulate": "gradient_accumulation_steps",
        "rematerialize": "remat",
        "momentum": "b1_range",
        "second_moment": "b2",
        "start_divisor": "div_factor",
        "end_divisor": "final_div_factor",
    },
}


def rebuild(kind: Any, data: Any, where: str) -> Any:
    """Build a value of the annotated type from parsed JSON.

    `where` is the path of the value, for messages. A missing field has its default, and a field may have the name of an
    earlier version. Raises ValueError, naming the field, for an unknown field and for a value of another type.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _rebuild_dataclass(kind, data, where)
    if origin is tuple:
        if not isinstance(data, list):
            raise ValueError(f"{where}: expected a list, not {data!r}.")
        kinds = [arguments[0]] * len(data) if arguments[-1] is Ellipsis else list(arguments)
        if len(kinds) != len(data):
            raise ValueError(f"{where}: expected {len(kinds)} values, not {len(data)}.")
        return tuple(rebuild(k, item, f"{where}[{i}]") for i, (k, item) in enumerate(zip(kinds, data, strict=True)))
    if origin is Literal:
        # True == 1 == 1.0, so compare the types too.
        if not any(type(data) is type(argument) and data == argument for argument in arguments):
            raise ValueError(f"{where}: {data!r} is not one of {list(arguments)}.")
        return data
    if kind is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    if origin is types.UnionType:
        if data is None and type(None) in arguments:
            return None
        return rebuild(next(one for one in arguments if one is not type(None)), data, where)
    if type(data) is not kind:
        raise ValueError(f"{where}: expected {kind.__name__}, not {data!r}.")
    return data


def _rebuild_dataclass(kind: Any, data: Any, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    if not isinstance(data, dict):
        raise ValueError(f"{where}: expected the fields {sorted(hints)}, not {data!r}.")
    renamed = RENAMED.get(kind.__name__, {})
    values = {}
    for given, value in data.items():
        name = renamed.get(given, given)
        if name not in hints:
            raise ValueError(f"{where}: the field '{given}' is unknown; {_nearest(given, hints)}.")
        if name in values:
            raise ValueError(f"{where}: '{given}' is the old name of '{name}'; remove one of the two.")
        values[name] = rebuild(hints[name], value, f"{where}.{given}")
    required = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]
    if missing := [name for name in required if name not in values]:
        raise ValueError(f"{where}: the field '{missing[0]}' is missing and has no default; add it.")
    return kind(**values)


def _nearest(name: str, known: Iterable[str]) -> str:
    """Return the most similar known name, or all known names."""
    close = difflib.get_close_matches(name, known, 1)
    return f"did you mean '{close[0]}'" if close else f"known are {', '.join(sorted(known))}"
