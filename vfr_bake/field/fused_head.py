"""The head's forward and backward pass on a CPU, for the few hundred rays of a step.

A ray costs 0.74 million operations forward and twice as many backward, nearly all of them in matrix products.
torch's products do these at the speed of the processor; what lies between them takes one pass here, and
autograd sees one function in place of sixty.

Letters: layer l has x_l = W_l a_(l-1) + b_l and a_l = gelu(x_l); of the second, linear layer, the part behind
the bottleneck is multiplied by the basis Y(d).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vfr_bake.kernels import activations

SPATIAL = 2
"""Layers before the directions come in; the second has no activation."""


def fused_head(features: Tensor, basis: Tensor, width: int, layers: Sequence[torch.nn.Module]) -> Tensor:
    """Colours [n, 3] of `features` [n, n_channels], float32 on a CPU, with GELU between the layers.

    `basis` [n, n_sh] is multiplied by what the second of the `layers` (`torch.nn.Linear`) predicts behind the
    bottleneck of `width`. Differentiable with respect to the features and the layers.
    """
    weights = [parameter for layer in layers for parameter in layer.parameters()]
    return _FusedHead.apply(features, basis, width, *weights)  # type: ignore[return-value]


class _FusedHead(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features: Tensor, basis: Tensor, width: int, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[::2], parameters[1::2]
        inputs, slopes = [features], []
        for number, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
            if number + 1 == SPATIAL:
                x = torch.addmm(bias, inputs[-1], weight.t())
                x[:, width:] *= basis
            else:
                x = torch.mm(inputs[-1], weight.t())
                slopes.append(torch.empty_like(x))
                activations.gelu(x.numpy(), bias.numpy(), slopes[-1].numpy())
            inputs.append(x)
        colours = torch.addmm(biases[-1], inputs[-1], weights[-1].t()).sigmoid_()
        ctx.width, ctx.n_layers = width, len(weights)
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
        basis, colours = basis[rows], colours[rows]
        grad = grads[0][rows] * colours * (1 - colours)
        for number in reversed(range(n)):
            grad_bias = torch.empty(len(weights[number]))
            if number == n - 1 or number + 1 == SPATIAL:
                torch.sum(grad, dim=0, out=grad_bias)
            else:
                activations.gelu_backward(grad.numpy(), slopes.pop().numpy(), rows.numpy(), grad_bias.numpy())
            gradients += [grad_bias, torch.mm(grad.t(), inputs[number][rows])]
            grad = torch.mm(grad, weights[number])
            if number == SPATIAL:
                grad[:, ctx.width :] *= basis
        grad_features = grads[0].new_zeros(len(grads[0]), grad.shape[1])
        grad_features[rows] = grad
        return grad_features, None, None, *reversed(gradients)
