"""The head's forward and backward pass on a CPU, for the few hundred rays of a step.

A ray costs 0.74 million operations forward and twice as many backward, nearly all of them in matrix products.
torch computes these products at the speed of the processor. All operations between two products take one pass
here, and autograd sees one function in place of sixty.

Letters: layer l has x_l = W_l a_(l-1) + b_l and a_l = gelu(x_l). The second layer is linear; the part of its
output after the bottleneck is multiplied by the basis Y(d).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vfr_bake.kernels.head import activations
from vfr_bake.kernels.head.bfloat16 import as_array

SPATIAL = 2
"""Number of layers before the directions are used; the second has no activation."""
BLOCK = 32
"""Rows in bfloat16 are padded to a multiple of this, because oneDNN generates code for each new number of
rows, which takes longer than the product."""


def fused_head(
    features: Tensor, basis: Tensor, layers: Sequence[torch.nn.Module], products: torch.dtype
) -> Tensor:
    """Return the colours [n, 3] of `features` [n, n_channels], float32 on a CPU, with
    GELU between the layers.

    `basis` [n, n_sh] is multiplied by the outputs of the second of the `layers` (`torch.nn.Linear`) that
    follow the bottleneck. Differentiable with respect to the features and the layers.

    `products`: float32, or bfloat16 for the inputs and outputs of the layers between the first and the last,
    forward and backward; sums are in float32.
    """
    weights = [parameter for layer in layers for parameter in layer.parameters()]
    return _FusedHead.apply(features, basis, products, *weights)  # type: ignore[return-value]


class _FusedHead(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features: Tensor, basis: Tensor, products: torch.dtype, *parameters: Tensor) -> Tensor:
        biases = parameters[1::2]
        first, *between, last = parameters[::2]
        weights = [first, *(weight.to(products) for weight in between), last]
        inputs, slopes = [], []
        n_rays = len(features)
        x = torch.nn.functional.pad(features, (0, 0, 0, _left_over(n_rays, products)))
        for number, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
            inputs.append(x.to(weight.dtype))
            x = torch.mm(inputs[-1], weight.t())
            if number + 1 == SPATIAL:
                activations.times_basis(as_array(x)[:n_rays], bias.numpy(), basis.numpy())
            else:
                slopes.append(torch.empty_like(x))
                activations.gelu(as_array(x), bias.numpy(), as_array(slopes[-1]))
        inputs.append(x.to(last.dtype))
        colours = torch.addmm(biases[-1], inputs[-1], last.t())[:n_rays].sigmoid_()
        ctx.n_layers, ctx.products = len(weights), products
        ctx.save_for_backward(basis, colours, *weights, *inputs, *slopes)
        return colours

    @staticmethod
    def backward(ctx, *grads: Tensor):
        basis, colours, *saved = ctx.saved_tensors
        n = ctx.n_layers
        weights, inputs, slopes = saved[:n], saved[n : 2 * n], saved[2 * n :]
        gradients: list[Tensor] = []
        # Rays without a gradient are left out.
        rows = grads[0].any(dim=1).nonzero()[:, 0]
        n_rows, colours = len(rows), colours[rows]
        grad = grads[0][rows] * colours * (1 - colours)
        if left_over := _left_over(n_rows, ctx.products):  # pads with the last row, with a gradient of 0
            grad = torch.nn.functional.pad(grad, (0, 0, 0, left_over))
            rows = torch.cat([rows, rows[-1:].expand(left_over)])
        for number in reversed(range(n)):
            grad = grad.to(weights[number].dtype)
            grad_bias = torch.empty(len(weights[number]))
            if number == n - 1:
                torch.sum(grad, dim=0, out=grad_bias)
            elif number + 1 == SPATIAL:
                activations.times_basis_backward(
                    as_array(grad), basis.numpy(), rows.numpy(), grad_bias.numpy()
                )
            else:
                activations.gelu_backward(
                    as_array(grad), as_array(slopes.pop()), rows.numpy(), grad_bias.numpy()
                )
            grad_weight = torch.mm(grad.t(), inputs[number].index_select(0, rows))
            gradients += [grad_bias, grad_weight.float()]
            grad = torch.mm(grad, weights[number])
        grad_features = grads[0].new_zeros(len(grads[0]), grad.shape[1])
        grad_features[rows[:n_rows]] = grad[:n_rows]
        return grad_features, None, None, *reversed(gradients)


def _left_over(n_rows: int, products: torch.dtype) -> int:
    """Return the number of rows that pad `n_rows` to a multiple of BLOCK in bfloat16; 0 in float32."""
    return -n_rows % BLOCK if products == torch.bfloat16 else 0
