"""What the program prints on stderr: one sentence for an error, one line for a warning, a progress bar."""

from __future__ import annotations

import dataclasses
import logging
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO, TypeVar, get_args, get_type_hints

from ciassd_jax.config import Config
from ciassd_jax.formats.errors import DroppedWarning, FormatWarning

Item = TypeVar("Item")
# How the library's messages name what the program has an option or a command for.
_OPTIONS = {
    "as `image_size` (width, height)": "with --image-size WIDTH HEIGHT",
    "as `columns`": "with --columns",
    "as `intensity_scale`": "with --intensity-scale",
    "as `z_shift`": "with --z-shift",
    "as `classes`": "with --classes",
    "leave out `calib`": "leave out --calib",
    "use the config of the file": "leave out --preset and --config to use the config of the file",
    "`partial`": "`ciassd train --init-from FILE --partial`",
    "`overwrite`": "--overwrite",
    "intervals.log": "--log-every",
    "intervals.save": "--save-every",
    "intervals.evaluate": "--evaluate-every",
    "intervals.keep": "--keep",
    "`write_synthetic`": "`ciassd data synth`",
}


def _field_patterns(kind: Any) -> Iterator[str]:
    """Yield a pattern for each field of a config, as messages name it: "grid.max_voxels", "classes[0].name"."""
    for name, hint in get_type_hints(kind).items():
        section = next((one for one in (hint, *get_args(hint)) if dataclasses.is_dataclass(one)), None)
        if section is None:
            yield name
        else:
            place = name if section is hint else rf"{name}\[\d+\]"
            yield from (rf"{place}\.{field}" for field in _field_patterns(section))


_FIELD = re.compile(rf"(?<![\w./-])(?:{'|'.join(one for one in _field_patterns(Config) if '.' in one)})\b")


class UsageError(ValueError):
    """An option cannot be used; the message is one sentence with the remedy."""


@contextmanager
def values_from_options() -> Iterator[None]:
    """Turn a ValueError into a UsageError: the refused values are those of the options."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def describe(message: Exception | Warning | str) -> str:
    """Return a message of the library in terms of the program: its options for arguments and fields of the config."""
    text = str(message)
    for argument, option in _OPTIONS.items():
        text = text.replace(argument, option)
    return _FIELD.sub(lambda found: f"{found[0]} ({option_of(found[0])})", text)


def option_of(field: str) -> str:
    """Return the option that replaces a field of the config, such as "grid.voxel_size" or "classes[0].name"."""
    return "--config." + re.sub(r"\[(\d+)\]", r".\1", field).replace("_", "-")


def tell(text: str, stream: TextIO | None = None) -> None:
    """Print a line at once and above any progress bar, by default on stdout; work goes on if nobody reads it."""
    from tqdm.auto import tqdm

    try:
        tqdm.write(text, file=stream)
        print(end="", file=stream, flush=True)
    except BrokenPipeError:
        discard(stream or sys.stdout)


def discard(stream: TextIO) -> None:
    """Write to nowhere from now on: the reader of the stream, such as `head`, or `tee` after Ctrl-C, has closed it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextmanager
def silenced(*loggers: str) -> Iterator[None]:
    """Keep libraries from logging pages of traces where the package reports the failure in one sentence."""
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in loggers}
    for logger in levels:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextmanager
def warnings_as_lines(source: Path | str) -> Iterator[None]:
    """Print the package's own warnings as one line that names the input; leave all others as they are.

    Of warnings that differ only in file and numbers, the first is printed and the others are counted at the end.
    """
    kinds: dict[str, list[str]] = {}

    def show(message, category, *rest, **more):  # type: ignore[no-untyped-def]
        if not issubclass(category, DroppedWarning | FormatWarning):
            before(message, category, *rest, **more)
            return
        names_input = issubclass(category, FormatWarning) or message.source
        text = describe(message if names_input else f"{source}: {message}")
        alike = kinds.setdefault(message.kind, [])
        alike.append(text)
        if len(alike) == 1:
            tell(f"warning: {text}", sys.stderr)

    before = warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always", DroppedWarning)
        warnings.simplefilter("always", FormatWarning)
        warnings.showwarning = show
        try:
            yield
        finally:
            for first, *others in kinds.values():
                if others and set(others) != {first}:
                    more = "1 more warning" if len(others) == 1 else f"{len(others)} more warnings"
                    tell(f"warning: {more} like this: {first}", sys.stderr)


def frames_with_bar(items: Sequence[Item]) -> Iterable[Item]:
    """Return the items with a progress bar, which only a terminal shows."""
    from tqdm.auto import tqdm

    return tqdm(items, unit="frame", leave=False, disable=None)
