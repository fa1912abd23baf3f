"""The program `ciassd`: every sub-command is a thin call of public functions.

Exit codes: 0 good, 1 failed check, 2 bad usage or input (one sentence on stderr says what and the remedy).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from ciassd_jax.cli.data import Data, Submit
from ciassd_jax.cli.evaluate import Evaluate
from ciassd_jax.cli.inference import Convert, Demo, Info, Predict
from ciassd_jax.cli.messages import UsageError
from ciassd_jax.cli.train import Train
from ciassd_jax.cli.view import View
from ciassd_jax.formats.errors import InputError

Command = (
    Annotated[Predict, tyro.conf.subcommand("predict")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[tyro.conf.OmitSubcommandPrefixes[Evaluate], tyro.conf.subcommand("eval")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Submit, tyro.conf.subcommand("submit")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    command = tyro.cli(Command, prog="ciassd", args=arguments, description="LiDAR 3D object detection in JAX.")
    try:
        code = command.run()
        sys.stdout.flush()
        return code
    except (InputError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has seen enough; nothing more can be said there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
