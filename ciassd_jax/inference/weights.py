"""Weights files: the authors' published checkpoints in, our own safetensors in and out.

Our file holds the variables as `params/...` and `batch_stats/...` and, in its metadata, the config and the class
names: nothing else is needed to predict. A released file has the authors' torch names (SPEC section 12).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import safetensors
import safetensors.numpy

from ciassd_jax.config import Config, HeadConfig
from ciassd_jax.config.presets import car_released
from ciassd_jax.formats.errors import InputError
from ciassd_jax.formats.torch_file import read_torch_file
from ciassd_jax.formats.writing import replacing
from ciassd_jax.model.network import init_variables
from ciassd_jax.types import Variables

Tensors = Mapping[str, np.ndarray]
FORMAT = "ciassd_jax weights 1"

_SPARSE_LAYERS = [
    *("stage0_0", "stage0_1"),
    *("stage1_down", "stage1_0", "stage1_1"),
    *("stage2_down", "stage2_0", "stage2_1", "stage2_2"),
    *("stage3_down", "stage3_0", "stage3_1", "stage3_2"),
    "out",
]
# Our layer, the released convolution and its BatchNorm, below `neck`.
_NECK_LAYERS = {
    "spatial_0": ("bottom_up_block_0.1", "bottom_up_block_0.2"),
    "spatial_1": ("bottom_up_block_0.4", "bottom_up_block_0.5"),
    "spatial_2": ("bottom_up_block_0.7", "bottom_up_block_0.8"),
    "semantic_0": ("bottom_up_block_1.0", "bottom_up_block_1.1"),
    "semantic_1": ("bottom_up_block_1.3", "bottom_up_block_1.4"),
    "semantic_2": ("bottom_up_block_1.6", "bottom_up_block_1.7"),
    "spatial_lateral": ("trans_0.0", "trans_0.1"),
    "semantic_lateral": ("trans_1.0", "trans_1.1"),
    "upsample_to_spatial": ("deconv_block_0.0", "deconv_block_0.1"),
    "upsample_semantic": ("deconv_block_1.0", "deconv_block_1.1"),
    "spatial_out": ("conv_0.0", "conv_0.1"),
    "semantic_out": ("conv_1.0", "conv_1.1"),
    "spatial_attention": ("w_0.0", "w_0.1"),
    "semantic_attention": ("w_1.0", "w_1.1"),
}
_HEAD_BRANCHES = {"box": "conv_box", "class": "conv_cls", "direction": "conv_dir", "iou": "conv_iou"}
_NORM = {
    "weight": ("params", "scale"),
    "bias": ("params", "bias"),
    "running_mean": ("batch_stats", "mean"),
    "running_var": ("batch_stats", "var"),
}
# Axes that bring a sparse kernel to (kD, kH, kW, in, out), by the name of the layout.
_SPARSE_LAYOUTS = {
    "spconv 1": (0, 1, 2, 3, 4),
    "spconv 2": (1, 2, 3, 4, 0),
    "spconv 2.0 native": (0, 1, 2, 4, 3),
}
_CONVOLUTION = (2, 3, 1, 0)
_TRANSPOSED_CONVOLUTION = (2, 3, 0, 1)


BUNDLED = Path(__file__).parents[1] / "bundled"


class TensorReport(NamedTuple):
    """What became of one tensor: mapped, transposed, counter (not needed), missing, unexpected, shape differs."""

    source: str
    target: str
    shape: tuple[int, ...]
    status: str


class Weights(NamedTuple):
    """Variables with the config that they belong to, and a report for each tensor of the file."""

    variables: Variables
    config: Config
    report: list[TensorReport]


def load_weights(path: str | os.PathLike[str]) -> Weights:
    """Read our own `.safetensors`, or a released `.pth`.

    Raises InputError (one sentence with the remedy) for anything that does not fit exactly.
    """
    if Path(path).suffix != ".safetensors":
        return _released(read_torch_file(path), path)
    tensors, metadata = _read_safetensors(path)
    if "config" not in metadata:
        raise InputError(
            f"{path} has no config in its metadata; make a file of ours with "
            f"`ciassd convert {path} OUT.safetensors` and use that."
        )
    try:
        config = Config.from_json(metadata["config"])
    except ValueError as error:
        raise InputError(f"{path} was written for another version of the package: {error}") from error
    return _ours(tensors, config, path)


def load_released_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a released model from `.pth`, or from `.safetensors` with the released names; other files are refused."""
    if Path(path).suffix != ".safetensors":
        return _released(read_torch_file(path), path)
    tensors, metadata = _read_safetensors(path)
    if "config" in metadata:
        raise InputError(f"{path} is already a file of ours; give it to `--weights` as it is.")
    return _released(tensors, path)


def save_weights(
    path: str | os.PathLike[str], variables: Variables, config: Config, *, half_kernels: bool = False
) -> None:
    """Write our own file, whole or not at all: the variables, and the config and class names as metadata.

    Everything is float32, but for the kernels in float16 with `half_kernels`, which halves the file; what normalises
    stays. Raises InputError for a kernel that is too large for float16.
    """
    flat = {_name(keys): np.asarray(leaf) for keys, leaf in _leaves(variables)}
    if half_kernels:
        largest = float(np.finfo(np.float16).max)
        for name in [name for name in flat if name.endswith("/kernel")]:
            if not np.abs(flat[name]).max() <= largest:
                raise InputError(f"{name} exceeds {largest:.0f}, the largest float16; write the file in float32.")
            flat[name] = flat[name].astype(np.float16)
    metadata = {"format": FORMAT, "config": config.to_json(), "class_names": json.dumps(config.class_names)}
    with replacing(path) as temporary:
        temporary.write_bytes(safetensors.numpy.save(flat, metadata=metadata))


def find_weights(path_or_name: str | os.PathLike[str]) -> Path:
    """A path as it is; the file of bundled weights for a name without suffix or folder."""
    path = Path(path_or_name)
    if path.suffix or len(path.parts) > 1:
        return path
    bundled = sorted(p.stem for p in BUNDLED.glob("*.safetensors"))
    if path.name not in bundled:
        have = f"bundled are {', '.join(bundled)}" if bundled else "none are bundled yet"
        raise InputError(f"{path.name!r} names no bundled weights ({have}); give the path of a weights file.")
    return BUNDLED / f"{path.name}.safetensors"


def check_fits(weights: Weights, config: Config, path: str | os.PathLike[str]) -> None:
    """Raise InputError unless the weights have exactly the parameters of `config`."""
    mine = {_name(keys): np.shape(leaf) for keys, leaf in _leaves(weights.variables)}
    wanted = _expected_shapes(config)
    wrong = sorted(name for name in mine.keys() | wanted.keys() if mine.get(name) != wanted.get(name))
    if wrong:
        name = wrong[0]
        raise InputError(
            f"{path} holds weights for another config: {name} is {mine.get(name, 'absent')} in the file and "
            f"{wanted.get(name, 'absent')} in the config ({len(wrong)} tensors differ); leave out --preset to use "
            "the config of the file."
        )


def _read_safetensors(path: str | os.PathLike[str]) -> tuple[Tensors, dict[str, str]]:
    if not Path(path).is_file():
        raise InputError(f"{path} is no file; check the path.")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(f"{path} is no complete safetensors file ({error}); fetch or write it again.") from error


def _ours(tensors: Tensors, config: Config, path: str | os.PathLike[str]) -> Weights:
    report = [TensorReport(name, name, value.shape, "mapped") for name, value in tensors.items()]
    return _assemble(dict(tensors), report, config, path)


def _released(content: Mapping[str, Any], path: str | os.PathLike[str]) -> Weights:
    """Map the released names; the IoU head is the one that the file has."""
    state = content.get("state_dict", content)
    if not isinstance(state, Mapping):
        raise InputError(f"{path} holds no dictionary of tensors; save the model's state_dict.")
    tensors = {str(k).removeprefix("module."): v for k, v in state.items() if isinstance(v, np.ndarray)}
    if "backbone.middle_conv.0.weight" not in tensors:
        raise InputError(
            f"{path} has no backbone.middle_conv.0.weight, so it is no released CIA-SSD model; "
            "give the authors' checkpoint, or a file that `ciassd convert` wrote."
        )
    layout = _sparse_layout(tensors, path)
    renamed, report = {}, []
    rules = _released_rules(layout)
    for source, value in tensors.items():
        if source.endswith(".num_batches_tracked"):
            report.append(TensorReport(source, "", value.shape, "counter"))
        elif source not in rules:
            report.append(TensorReport(source, "", value.shape, "unexpected"))
        else:
            target, axes = rules[source]
            moved = axes != tuple(range(len(axes))) and value.ndim == len(axes)
            renamed[target] = value.transpose(axes) if moved else value
            report.append(TensorReport(source, target, value.shape, "transposed" if moved else "mapped"))
    iou = tensors.get("bbox_head.tasks.0.conv_iou.weight")
    config = car_released()
    if iou is not None and iou.ndim == 4 and iou.shape[-1] in (1, 3):
        head = HeadConfig(
            angles=config.head.angles,
            iou_kernel=iou.shape[-1],
            iou_bias="bbox_head.tasks.0.conv_iou.bias" in tensors,
        )
        config = replace(config, head=head)
    return _assemble(renamed, report, config, path)


def _released_rules(layout: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Released name to our name and the axes that our kernel takes from it."""
    rules: dict[str, tuple[str, tuple[int, ...]]] = {}

    def norm(source: str, layer: str) -> None:
        for suffix, (collection, name) in _NORM.items():
            rules[f"{source}.{suffix}"] = (f"{collection}/{layer}/norm/{name}", ())

    for i, layer in enumerate(_SPARSE_LAYERS):
        source = f"backbone.middle_conv.{3 * i}.weight"
        rules[source] = (f"params/backbone/{layer}/kernel", _SPARSE_LAYOUTS[layout])
        norm(f"backbone.middle_conv.{3 * i + 1}", f"backbone/{layer}")
    for layer, (convolution, batch_norm) in _NECK_LAYERS.items():
        axes = _TRANSPOSED_CONVOLUTION if layer.startswith("upsample") else _CONVOLUTION
        rules[f"neck.{convolution}.weight"] = (f"params/neck/{layer}/kernel", axes)
        norm(f"neck.{batch_norm}", f"neck/{layer}")
    for branch, source in _HEAD_BRANCHES.items():
        rules[f"bbox_head.tasks.0.{source}.weight"] = (f"params/head/{branch}/kernel", _CONVOLUTION)
        rules[f"bbox_head.tasks.0.{source}.bias"] = (f"params/head/{branch}/bias", ())
    return rules


def _sparse_layout(tensors: Tensors, path: str | os.PathLike[str]) -> str:
    """Layout of the sparse kernels, from the layers whose channel numbers differ: square ones fit any."""
    asymmetric = {0: (4, 16), 6: (16, 32), 15: (32, 64)}
    found = set()
    for index, channels in asymmetric.items():
        shape = tensors.get(f"backbone.middle_conv.{index}.weight", np.empty(0)).shape
        fitting = [
            name
            for name, axes in _SPARSE_LAYOUTS.items()
            if len(shape) == 5 and tuple(shape[a] for a in axes) == (3, 3, 3, *channels)
        ]
        found.add(fitting[0] if fitting else f"unknown {shape}")
    if len(found) > 1 or not found <= _SPARSE_LAYOUTS.keys():
        raise InputError(
            f"{path} has sparse kernels of layouts {sorted(found)} where one of {list(_SPARSE_LAYOUTS)} is "
            "expected; give the checkpoint as the authors published it."
        )
    return found.pop()


def _assemble(
    named: dict[str, np.ndarray], report: list[TensorReport], config: Config, path: str | os.PathLike[str]
) -> Weights:
    """Nest the tensors as the model has them; every one must be there, of its shape, finite, and no other."""
    expected = _expected_shapes(config)
    sources = {row.target: row for row in report}
    checked = [row for row in report if row.status == "counter"]
    for target, shape in expected.items():
        row = sources.get(target, TensorReport("", target, shape, "missing"))
        if target in named and named[target].shape != shape:
            row = row._replace(status=f"shape differs, expected {shape}")
        elif target in named and not np.isfinite(named[target]).all():
            row = row._replace(status="not finite")
        checked.append(row)
    checked += [r._replace(status="unexpected") for r in report if r.status != "counter" and r.target not in expected]
    wrong = [r for r in checked if r.status not in ("mapped", "transposed", "counter")]
    if wrong:
        shown = "; ".join(f"{r.source or r.target} {r.shape}: {r.status}" for r in wrong[:3])
        raise InputError(
            f"{path} does not fit its model in {len(wrong)} of {len(checked)} tensors ({shown}); "
            "give the complete file that belongs to this config."
        )
    variables: dict[str, Any] = {}
    for target in expected:
        *parents, leaf = target.split("/")
        place = variables
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = np.ascontiguousarray(named[target], np.float32)
    return Weights(variables, config, checked)


@cache
def _expected_shapes(config: Config) -> dict[str, tuple[int, ...]]:
    shapes = jax.eval_shape(partial(init_variables, config=config), jax.random.key(0))
    return {_name(keys): leaf.shape for keys, leaf in _leaves(shapes)}


def _leaves(tree: Variables) -> list[tuple[tuple, Any]]:
    return jax.tree_util.tree_flatten_with_path(tree)[0]


def _name(keys: tuple) -> str:
    return "/".join(key.key for key in keys)
