"""Options of earlier versions, answered with their new names."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ciassd_jax.cli.messages import UsageError

# By command: old option to new option.
_OPTIONS = {
    "train": {
        "--accumulate": "--gradient-accumulation-steps",
        "--rematerialize": "--remat",
        "--no-rematerialize": "--no-remat",
    },
    "view": {"--most": "--frames"},
}


def check_names(arguments: Sequence[str]) -> None:
    """Raise UsageError for an option that had another name, or another meaning, in an earlier version."""
    command, *others = arguments or [""]
    for index, argument in enumerate(others):
        option = argument.partition("=")[0].replace("_", "-")
        if new := _OPTIONS.get(command, {}).get(option):
            raise UsageError(f"{option} is now {new}; use the new name.")
        if (command, option) == ("view", "--frames") and any(re.match(r"0\d|\D", v) for v in others[index + 1 :][:1]):
            raise UsageError("--frames is now a number of frames; name frames with --names.")
