"""The config that a command uses: a preset's, a file's or that of weights, with fields replaced by options.

`--config.SECTION.FIELD VALUE` replaces any field. These options are parsed before the others, because their defaults
and the number of classes and stages are those of the chosen config.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from ciassd_jax.cli.messages import UsageError, option_of, values_from_options
from ciassd_jax.cli.options import File, Unset
from ciassd_jax.config import Config
from ciassd_jax.config.presets import PRESETS
from ciassd_jax.inference.scoring import find_trained
from ciassd_jax.inference.weights import Weights, load_weights, read_config

if TYPE_CHECKING:
    Preset = str
else:
    Preset = tyro.extras.literal_type_from_choices(PRESETS)


class Replaced(NamedTuple):
    """A config in which options of the form --config.SECTION.FIELD replaced the fields `names`, "section.field"."""

    config: Config
    names: tuple[str, ...]


@dataclass(frozen=True)
class ConfigOptions:
    """The options that choose a config."""

    preset: Unset[Preset] = None
    """Use the config of this preset. With weights, the parameters must fit."""
    config: File[Unset[Path]] = None
    """Or that of a file: a config.json or weights. --config.SECTION.FIELD VALUE replaces a field (--help-config)."""
    intensity_scale: Unset[float] = None
    """The intensity in the clouds that the network reads as 1, such as 255. Training keeps it with the weights."""
    z_shift: Unset[float] = None
    """Metres that the network adds to z, if the sensor stands at another height. Training keeps it too."""
    replaced: tyro.conf.Suppress[tyro.conf.Fixed[Replaced | None]] = None

    def resolve(
        self,
        own: Config | None = None,
        short: Mapping[str, Any] | None = None,
        usual: Mapping[str, Any] | None = None,
    ) -> Config:
        """Return the chosen config, by default `own` or else the paper's, with fields replaced by options.

        `short` are the command's own options as "section.field" to value; those that are None were not given. `usual`
        are values that the command prefers to the config's, and any option to them.
        """
        config, names = self.replaced or (self.chosen(own), ())
        options = {"input.intensity_scale": self.intensity_scale, "input.z_shift": self.z_shift, **(short or {})}
        given = {name: value for name, value in options.items() if value is not None}
        for name in given.keys() & set(names):
            raise UsageError(f"{option_of(name)} sets a field that another option sets too; give one of the two.")
        preferred = {name: value for name, value in (usual or {}).items() if name not in names}
        with values_from_options():
            for name, value in (preferred | given).items():
                config = _replace_field(config, name, value)
        return config

    def chosen(self, own: Config | None = None) -> Config:
        """Return the config before single fields are replaced."""
        if self.preset is not None and self.config is not None:
            raise UsageError("--preset and --config both choose a config; give one of them.")
        if self.preset is not None:
            return PRESETS[self.preset]()
        if self.config is not None:
            return read_config(self.config)
        return own or Config()

    def load(self, path: Path, short: Mapping[str, Any] | None = None) -> Weights:
        """Load weights from a file or by the name of bundled ones, with the chosen config, by default their own."""
        weights = load_weights(path)
        config = self.resolve(weights.config, short)
        return weights if config == weights.config else load_weights(path, config)


def _replace_field(config: Config, name: str, value: Any) -> Config:
    """Return the config with the field "section.field" or "field" replaced."""
    section, _, last = name.rpartition(".")
    if not section:
        return dataclasses.replace(config, **{name: value})
    part = dataclasses.replace(getattr(config, section), **{last: value})
    return dataclasses.replace(config, **{section: part})


@dataclass(frozen=True)
class _Fields:
    """Every field of a config as an option."""

    config: Config


@dataclass(frozen=True)
class _Source:
    """The options that name a config."""

    config_options: Annotated[ConfigOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=ConfigOptions)
    weights: Unset[Path] = None
    init_from: Unset[Path] = None
    workdir: Unset[Path] = None


def take_fields(arguments: Sequence[str]) -> tuple[Replaced | None, list[str]]:
    """Parse the options --config.SECTION.FIELD; return the config with these fields, and the other arguments."""
    options = [_spelled(argument) for argument in arguments if argument.startswith("--")]
    chosen = [option for option in options if option.startswith("--config") or option == "--preset"]
    if repeated := next((option for option in chosen if chosen.count(option) > 1), None):
        raise UsageError(f"{repeated} is given twice; give it once.")
    names = [option.removeprefix("--config.") for option in chosen if option.startswith("--config.")]
    if not names:
        return None, list(arguments)
    fields, others = tyro.cli(
        _Fields,
        prog="ciassd",
        default=_Fields(_source(arguments)),
        args=list(arguments),
        return_unknown_args=True,
        add_help=False,
    )
    unknown = next((argument for argument in others if argument.startswith("--config.")), None)
    if unknown:
        field, _, last = unknown.partition("=")[0].rpartition(".")
        remedy = f"give all values of {field}, or see" if last.isdecimal() else "see"
        raise UsageError(f"{unknown} is no field of this config; {remedy} the list of --help-config.")
    paths = [name for one in fields.config.classes for name in one.similar if Path(name).exists()]
    if paths and any(name.endswith(".similar") for name in names):
        raise UsageError(f"{paths[0]} was taken for a similar class; give the path before the options.")
    return Replaced(fields.config, tuple(name.replace("-", "_") for name in names)), others


def _spelled(argument: str) -> str:
    """Return an option without its value, in one spelling whether it sets a switch or unsets it."""
    return re.sub(r"\.no-(?=[^.]*$)", ".", argument.partition("=")[0].replace("_", "-"))


def print_fields(arguments: Sequence[str]) -> None:
    """Print every field of the chosen config with its value, as help."""
    tyro.cli(_Fields, prog="ciassd", default=_Fields(_source(arguments)), args=["--help"])


def _source(arguments: Sequence[str]) -> Config:
    """Return the config that the arguments of a command name."""
    named = tyro.cli(_Source, args=list(arguments), return_unknown_args=True, add_help=False)[0]
    weights = named.weights or named.init_from
    if arguments[0] == "eval" and named.workdir is not None:
        weights = find_trained(named.workdir)
    if arguments[0] in ("demo", "bench") and weights is None:
        weights = Path("car_lite")
    return named.config_options.chosen(read_config(weights) if weights else None)
