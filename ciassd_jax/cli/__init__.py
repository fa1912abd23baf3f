"""The program `ciassd`: every command is a thin call of public functions.

Exit codes: 0 success, 1 failed check, 2 bad usage or input (one sentence on stderr gives the reason and the remedy).
"""

from __future__ import annotations

import errno
import gc
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Annotated, Any

import tyro

from ciassd_jax.cli.bench import Bench
from ciassd_jax.cli.config_options import Replaced, print_fields, take_fields
from ciassd_jax.cli.convert import Convert
from ciassd_jax.cli.data_check import Check
from ciassd_jax.cli.data_prepare import Prepare
from ciassd_jax.cli.data_suggest import Suggest
from ciassd_jax.cli.data_synth import Synth
from ciassd_jax.cli.demo import Demo
from ciassd_jax.cli.doctor import Doctor
from ciassd_jax.cli.eval import Evaluate
from ciassd_jax.cli.export import Export
from ciassd_jax.cli.info import Info
from ciassd_jax.cli.messages import UsageError, describe, discard, option_of, silenced
from ciassd_jax.cli.names import check_names
from ciassd_jax.cli.plot import Plot
from ciassd_jax.cli.predict import Predict
from ciassd_jax.cli.submit import Submit
from ciassd_jax.cli.train import Train
from ciassd_jax.cli.view import View
from ciassd_jax.formats.errors import InputError
from ciassd_jax.inference.machine import has_device


@dataclass(frozen=True)
class Data:
    """Check, describe by a config, prepare or simulate a data set."""

    action: Annotated[
        Annotated[Check, tyro.conf.subcommand("check", prefix_name=False)]
        | Annotated[Suggest, tyro.conf.subcommand("suggest", prefix_name=False)]
        | Annotated[Prepare, tyro.conf.subcommand("prepare", prefix_name=False)]
        | Annotated[Synth, tyro.conf.subcommand("synth", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        return self.action.run()


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Predict, tyro.conf.subcommand("predict")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Plot, tyro.conf.subcommand("plot")]
    | Annotated[tyro.conf.OmitSubcommandPrefixes[Evaluate], tyro.conf.subcommand("eval")]
    | Annotated[Submit, tyro.conf.subcommand("submit")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code."""
    with silenced("absl", "asyncio"):
        code = _run(sys.argv[1:] if arguments is None else arguments)
        if code:
            # What a failed checkpoint left behind complains when it is collected.
            gc.collect()
        return code


def _run(arguments: Sequence[str]) -> int:
    try:
        check_names(arguments, Command)
        code = _print_versions() if "--version" in arguments else _parse(arguments).run()
        print(end="", flush=True)
        return code
    except (InputError, UsageError) as error:
        print(f"error: {describe(error)}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        discard(sys.stdout)
        return 0
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        discard(sys.stdout)
        print("error: A disk that is written to is full; free some space and run again.", file=sys.stderr)
        return 2
    except (RuntimeError, AssertionError):
        if has_device():
            raise
        print("error: JAX finds no device; set JAX_PLATFORMS=cpu, or see `ciassd doctor`.", file=sys.stderr)
        return 2


def _print_versions() -> int:
    print(f"ciassd_jax {version('ciassd_jax')}, JAX {version('jax')}, Python {platform.python_version()}")
    return 0


def _parse(arguments: Sequence[str]) -> Command:
    if "--help-config" in arguments:
        print_fields(arguments)
    replaced, others = take_fields(arguments)
    command = tyro.cli(
        Command,
        prog="ciassd",
        args=others,
        description="LiDAR 3D object detection in JAX. --version prints the versions of the package, JAX and Python.",
        config=(tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName),
    )
    return command if replaced is None else _with_fields(command, replaced)


def _with_fields(command: Any, replaced: Replaced) -> Any:
    """Return the command with the config whose fields were replaced; raise UsageError if it uses no config."""
    if isinstance(command, Data):
        return replace(command, action=_with_fields(command.action, replaced))
    if not hasattr(command, "config_options"):
        raise UsageError(f"This command has no config; leave out {option_of(replaced.names[0])}.")
    return replace(command, config_options=replace(command.config_options, replaced=replaced))
