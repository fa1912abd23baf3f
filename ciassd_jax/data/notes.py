"""Warnings of frames, as arrays that travel with their scenes from the thread or process that reads them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

from ciassd_jax.formats.errors import FormatWarning, warn_of_file

# Bytes per scene. What does not fit comes with another frame that has the problem, or with the same one later.
_LENGTH = 1024
_END, _BETWEEN = "\n", "\0"


def encode_warnings(found: Iterable[FormatWarning]) -> UInt8[np.ndarray, " bytes"]:
    """Return warnings as bytes of fixed length."""
    text = "".join(f"{one.kind}{_BETWEEN}{one}{_END}" for one in found)
    return np.frombuffer(text.encode()[:_LENGTH].ljust(_LENGTH, _END.encode()), np.uint8)


def give_new(notes: UInt8[np.ndarray, "B bytes"], told: set[str], *, stacklevel: int = 3) -> None:
    """Give the first warning of each kind that is not yet in `told`, and add the kind."""
    for line in notes.tobytes().decode(errors="replace").split(_END):
        kind, _, text = line.partition(_BETWEEN)
        if text and kind not in told:
            told.add(kind)
            warn_of_file(text, stacklevel=stacklevel + 1)
