"""Sparse 3D convolution in plain PyTorch, forward and backward, over spconv's pair tables.

spconv's own convolution has no backward pass on a CPU.
"""

from typing import NamedTuple

import torch
from peer_torch import SPARSE_LAYERS, SPARSE_SHAPE
from spconv.core import ConvAlgo
from spconv.pytorch import ops
from torch import nn


class Pairs(NamedTuple):
    """Input and output rows of each kernel offset; offset `center` maps every row to itself."""

    inputs: list[torch.Tensor]
    outputs: list[torch.Tensor]
    num_outputs: int
    center: int | None


class SparseConvolution(torch.autograd.Function):
    """Gather, multiply and add for each offset, into one buffer; plain autograd would fill 27."""

    @staticmethod
    def forward(ctx, features: torch.Tensor, kernel: torch.Tensor, pairs: Pairs) -> torch.Tensor:
        ctx.save_for_backward(features, kernel)
        ctx.pairs = pairs
        if pairs.center is None:
            result = features.new_zeros(pairs.num_outputs, kernel.shape[2])
        else:
            result = features @ kernel[pairs.center]
        for k, (i, o) in enumerate(zip(pairs.inputs, pairs.outputs, strict=True)):
            if k != pairs.center and len(i):
                result.index_add_(0, o, features.index_select(0, i) @ kernel[k])
        return result

    @staticmethod
    def backward(ctx, gradient: torch.Tensor):
        (features, kernel), pairs = ctx.saved_tensors, ctx.pairs
        to_kernel, to_features = torch.zeros_like(kernel), None
        if pairs.center is not None:
            torch.mm(features.T, gradient, out=to_kernel[pairs.center])
        if ctx.needs_input_grad[0]:
            center = pairs.center
            to_features = torch.zeros_like(features) if center is None else gradient @ kernel[center].T
        for k, (i, o) in enumerate(zip(pairs.inputs, pairs.outputs, strict=True)):
            if k != pairs.center and len(i):
                part = gradient.index_select(0, o)
                torch.mm(features.index_select(0, i).T, part, out=to_kernel[k])
                if to_features is not None:
                    to_features.index_add_(0, i, part @ kernel[k].T)
        return to_features, to_kernel, None


class Kernel(nn.Module):
    """The weight (offsets, in, out) of a sparse convolution, initialised as in spconv 1."""

    def __init__(self, cin: int, cout: int, offsets: int) -> None:
        super().__init__()
        bound = 1 / (offsets // 3 * cin * cout) ** 0.5
        self.weight = nn.Parameter(torch.empty(offsets, cin, cout).uniform_(-bound, bound))


def pair_tables(coordinates: torch.Tensor, batch: int) -> tuple[list[Pairs], torch.Tensor]:
    """Return the pairs of each sparse layer (shared within a resolution) and the coordinates of the last sites."""
    shape, tables, made = SPARSE_SHAPE, [], {}
    for _, _, *rest in SPARSE_LAYERS:
        submanifold = len(rest) == 1
        if submanifold and rest[0] in made:
            tables.append(made[rest[0]])
            continue
        kernel, stride, padding = (
            list(each) if isinstance(each, tuple) else [each] * 3 for each in ((3, 1, 1) if submanifold else rest)
        )
        sites, pairs, number = ops.get_indice_pairs(
            coordinates, batch, shape, ConvAlgo.Native, kernel, stride, padding, [1] * 3, [0] * 3, subm=submanifold
        )
        # 64 bits: index_add_ takes four times as long with 32.
        inputs, outputs = ([row[:n].long() for row, n in zip(side, number.tolist(), strict=True)] for side in pairs)
        center = len(inputs) // 2 if submanifold else None
        if center is not None:  # spconv omits the mirrored half
            inputs, outputs = inputs[:center] + inputs[center:], outputs[:center] + outputs[center:]
            inputs[center + 1 :], outputs[center + 1 :] = outputs[:center][::-1], inputs[:center][::-1]
            made[rest[0]] = Pairs(inputs, outputs, len(sites), center)
        else:
            shape = ops.get_conv_output_size(shape, kernel, stride, padding, [1] * 3)
        tables.append(Pairs(inputs, outputs, len(sites), center))
        coordinates = sites
    return tables, coordinates
