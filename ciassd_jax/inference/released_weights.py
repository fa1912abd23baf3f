"""The authors' published checkpoints: the names of their tensors here, and their config.

METHOD.md lists the released names.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ciassd_jax.config import Config
from ciassd_jax.config.presets import car_released
from ciassd_jax.formats.errors import InputError

Tensors = Mapping[str, np.ndarray]
# For each tensor of a file, its name here and the order of axes that its kernel is transposed to. Tensors that are not
# needed have the name "", tensors that stay as they are no axes.
Rules = dict[str, tuple[str, tuple[int, ...]]]

_SPARSE_LAYERS = [
    *("stage0_0", "stage0_1"),
    *("stage1_down", "stage1_0", "stage1_1"),
    *("stage2_down", "stage2_0", "stage2_1", "stage2_2"),
    *("stage3_down", "stage3_0", "stage3_1", "stage3_2"),
    "out",
]
# Our layer, and the released convolution and BatchNorm below `neck`.
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
# Axes that bring a sparse kernel to (kD, kH, kW, in, out), by the version of spconv.
_SPARSE_LAYOUTS = {
    "spconv 1": (0, 1, 2, 3, 4),
    "spconv 2": (1, 2, 3, 4, 0),
    "spconv 2.0 native": (0, 1, 2, 4, 3),
}
_CONVOLUTION = (2, 3, 1, 0)
_TRANSPOSED_CONVOLUTION = (2, 3, 0, 1)


def released_tensors(content: Mapping[str, Any], path: str | os.PathLike[str]) -> Tensors:
    """Return the tensors of a released file by name; raise InputError for another model."""
    state = content.get("state_dict", content)
    if not isinstance(state, Mapping):
        raise InputError(f"{path} does not hold a dictionary of tensors; save the model's state_dict.")
    tensors = {str(k).removeprefix("module."): v for k, v in state.items() if isinstance(v, np.ndarray)}
    if "backbone.middle_conv.0.weight" not in tensors:
        raise InputError(
            f"{path} has no backbone.middle_conv.0.weight, so it is not a released CIA-SSD model; "
            "give the authors' checkpoint, or a weights file of this package."
        )
    return tensors


def released_config(tensors: Tensors) -> Config:
    """Return `car_released()` with the IoU branch that the file has."""
    config = car_released()
    kernel = tensors.get("bbox_head.tasks.0.conv_iou.weight")
    if kernel is None or kernel.ndim != 4 or kernel.shape[-1] not in (1, 3):
        return config
    bias = "bbox_head.tasks.0.conv_iou.bias" in tensors
    return replace(config, head=replace(config.head, iou_kernel=kernel.shape[-1], iou_bias=bias))


def released_rules(tensors: Tensors, path: str | os.PathLike[str]) -> Rules:
    """Return our name of every released tensor, and the axes that its kernel is transposed to."""
    sparse_axes = _SPARSE_LAYOUTS[_sparse_layout(tensors, path)]
    rules: Rules = {}

    def add_norm(source: str, layer: str) -> None:
        rules[f"{source}.num_batches_tracked"] = ("", ())
        for suffix, (collection, name) in _NORM.items():
            rules[f"{source}.{suffix}"] = (f"{collection}/{layer}/norm/{name}", ())

    for i, layer in enumerate(_SPARSE_LAYERS):
        rules[f"backbone.middle_conv.{3 * i}.weight"] = (f"params/backbone/{layer}/kernel", sparse_axes)
        add_norm(f"backbone.middle_conv.{3 * i + 1}", f"backbone/{layer}")
    for layer, (convolution, batch_norm) in _NECK_LAYERS.items():
        axes = _TRANSPOSED_CONVOLUTION if layer.startswith("upsample") else _CONVOLUTION
        rules[f"neck.{convolution}.weight"] = (f"params/neck/{layer}/kernel", axes)
        add_norm(f"neck.{batch_norm}", f"neck/{layer}")
    for branch, source in _HEAD_BRANCHES.items():
        rules[f"bbox_head.tasks.0.{source}.weight"] = (f"params/head/{branch}/kernel", _CONVOLUTION)
        rules[f"bbox_head.tasks.0.{source}.bias"] = (f"params/head/{branch}/bias", ())
    return rules


def _sparse_layout(tensors: Tensors, path: str | os.PathLike[str]) -> str:
    """Return the layout of the sparse kernels. Only layers that change the number of channels tell it."""
    changing = {0: (4, 16), 6: (16, 32), 15: (32, 64)}
    found = set()
    for index, channels in changing.items():
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
