"""Commands and options that do not exist, answered with those that do."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Sequence
from difflib import get_close_matches
from typing import Any, get_args, get_type_hints

import tyro

from ciassd_jax.cli.messages import UsageError

_EVERYWHERE = {"--", "--help", "--help-config"}
_FIELD = "--config.SECTION.FIELD VALUE replaces a field of the config, and --help-config lists them"
# Options of earlier versions, of OpenPCDet, of mmdetection3d and of the released CIA-SSD code. Of several answers a
# command gives the first whose options it has.
_ELSEWHERE = {
    "--accumulate": ("--gradient-accumulation-steps",),
    "--rematerialize": ("--remat",),
    "--no-rematerialize": ("--no-remat",),
    "--most": ("--frames",),
    "--lr": ("--learning-rate",),
    "--autoscale-lr --auto-scale-lr": ("set the rate for the batch size with --learning-rate",),
    "--cfg-file --cfg": ("choose a config with --preset NAME or --config FILE",),
    "--set --cfg-options --options": (_FIELD,),
    "--ckpt --checkpoint --load-from --pretrained-model": ("start from weights with --init-from FILE", "--weights"),
    "--resume --resume-from --auto-resume": ("the same command with the same --workdir resumes",),
    "--work-dir --ckpt-dir": ("--workdir", "--out"),
    "--extra-tag": ("a run is named by its folder, --workdir",),
    "--data-path --data-root": ("--data",),
    "--fix-random-seed --deterministic": ("runs are reproducible as they are, and --seed chooses another one",),
    "--amp --fp16": ("use --dtype bfloat16",),
    "--sync-bn": ("batch statistics are pooled over all devices without an option",),
    "--no-validate": ("use --validate none",),
    "--eval-all": ("--all",),
    "--ckpt-save-interval": ("--save-every",),
    "--max-ckpt-save-num": ("--keep",),
    "--gpus --gpu-ids --device": ("JAX uses the GPUs that CUDA_VISIBLE_DEVICES lists, and JAX_PLATFORMS=cpu none",),
    "--launcher --local-rank --tcp-port": (
        "processes that train together have --coordinator, --num-processes and --process-index",
        "one process is enough",
    ),
    "--save-to-file --txt-result": ("--out",),
    "--show --show-dir": ("`ciassd view` shows frames with their detections",),
}
_ANSWERS = {name: answers for names, answers in _ELSEWHERE.items() for name in names.split()}


def check_names(arguments: Sequence[str], program: Any) -> None:
    """Raise UsageError for a command or an option that `program`, a union of subcommands for tyro, does not have."""
    path: list[str] = ["ciassd"]
    options, commands, required = _EVERYWHERE | {"--version"}, subcommands(program), True
    for argument in arguments:
        if argument in commands:
            path, kind = [*path, argument], commands[argument]
            own, commands = options_of(kind), subcommands(kind)
            options, required = options | own, not own and bool(commands)
        elif argument.startswith("--"):
            _check_option(argument.partition("=")[0], options, path)
        elif required and argument != "-h":
            raise UsageError(f"{argument} is no command; {_nearest(argument, commands, path)}")
    _check_frames(arguments)


def _check_option(given: str, options: Collection[str], path: Sequence[str]) -> None:
    option = given.replace("_", "-")
    if option in options or option.startswith(("--config.", "--tyro-")):
        return
    answers = (_FIELD,) if "." in option else _ANSWERS.get(option, ())
    fitting = [answer for answer in answers if set(re.findall(r"--[a-z-]+", answer)) <= set(options)]
    if not fitting:
        answer = _nearest(option, () if answers else options, path)
    else:
        answer = f"did you mean {fitting[0]}?" if fitting[0] in options else f"{fitting[0]}."
    raise UsageError(f"{given} is no option of {' '.join(path[1:]) or 'ciassd'}; {answer}")


def subcommands(union: Any) -> dict[str, Any]:
    """Return the subcommands of a union, or of the field of a dataclass that is such a union, by name."""
    if dataclasses.is_dataclass(union):
        hints = get_type_hints(union, include_extras=True).values()
        return {name: kind for hint in hints for name, kind in subcommands(_bare(hint)).items()}
    named: Any = type(tyro.conf.subcommand())
    return {
        mark.name: _bare(member)
        for member in get_args(union)
        for mark in getattr(member, "__metadata__", ())
        if isinstance(mark, named)
    }


def options_of(kind: Any) -> set[str]:
    """Return the options that tyro makes of a dataclass; nested dataclasses have no prefixes, as in all commands."""
    options: set[str] = set()
    for name, hint in get_type_hints(kind, include_extras=True).items():
        marks, bare = getattr(hint, "__metadata__", ()), _bare(hint)
        if dataclasses.is_dataclass(bare):
            options |= options_of(bare)
        elif not (tyro.conf.Positional in marks or tyro.conf.Fixed in marks or subcommands(bare)):
            given = next((mark.name for mark in marks if getattr(mark, "name", None)), name).replace("_", "-")
            options |= {f"--{given}"} | ({f"--no-{given}"} if bool in (bare, *get_args(bare)) else set())
    return options


def _bare(hint: Any) -> Any:
    """Return a type without its annotations."""
    return hint.__origin__ if hasattr(hint, "__metadata__") else hint


def _nearest(word: str, known: Collection[str], path: Sequence[str]) -> str:
    """A question with the nearest name, or where to find them all."""
    bare = {name.strip("-"): name for name in sorted(known)}
    near = get_close_matches(word.strip("-"), bare, n=1)
    return f"did you mean {bare[near[0]]}?" if near else f"`{' '.join(path)} --help` lists what there is."


def _check_frames(arguments: Sequence[str]) -> None:
    """Raise UsageError for names after the option of `view` that took them in earlier versions."""
    after = arguments[arguments.index("--frames") + 1 :][:1] if "--frames" in arguments else []
    if arguments[:1] == ["view"] and any(re.match(r"0\d|\D", value) for value in after):
        raise UsageError("--frames is a number of frames; name frames with --names.")
