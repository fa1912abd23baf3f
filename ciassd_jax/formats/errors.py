"""What a file that cannot be used raises, and what one that can be used in part warns of."""

from __future__ import annotations

import os

Pathlike = str | os.PathLike[str]


class InputError(ValueError):
    """A file cannot be used; the message is one sentence that names it and the remedy."""


class FormatWarning(UserWarning):
    """A file was read, but lacks something; the message names it and what stands in for it."""


class DroppedWarning(UserWarning):
    """Part of the input was not used; the message says how much and why."""


def read_bytes(path: Pathlike, limit: int = -1) -> bytes:
    """Read a file, or its first `limit` bytes.

    Raises InputError if there is no such file, or it is a directory or unreadable.
    """
    try:
        with open(path, "rb") as stream:
            return stream.read(limit)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path.") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a directory; name a file inside it.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from error
