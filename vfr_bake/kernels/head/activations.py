"""Activations of the head's layers with slopes, and gradients back through them, in one pass each. GELU is

    gelu(x) = x P(x),    gelu'(x) = P(x) + x p(x)

where P is the normal distribution function and p its density. With t = 1 / (1 + 0.2316419 |x|), the tail 1 -
P(|x|) is p(x) times a polynomial of t, to 8e-8 (Abramowitz and Stegun 1964, 26.2.17), so that one exponential
is enough for all of these.
"""

from __future__ import annotations

import numpy as np

from vfr_bake.kernels import njit
from vfr_bake.kernels.hash_grid import FLAGS
from vfr_bake.kernels.head.bfloat16 import float_of_bits, get, put

PER_LOG = np.float32(1.4426950408889634)
HIGH, LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
"""log(2) = HIGH + LOW, where HIGH has so few digits that its integer multiples are exact."""
HALF, ONE = np.float32(0.5), np.float32(1)
E1, E2, E3, E4, E5, E6 = map(
    np.float32,
    (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1),
)
"""exp(r) = 1 + r + r^2 (E6 + r (E5 + ...)) for |r| <= log(2) / 2: the polynomial of Cephes."""
MOST = np.float32(32.0)
"""Value of x^2 / 2 at 8 standard deviations, from which on p is taken as 0. It is 5e-15 there, and operations
on numbers too small for a float32's exponent (subnormal ones) take a hundred times as long."""
SLOPE = np.float32(0.2316419)
B1, B2, B3, B4, B5 = map(np.float32, (0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429))
PEAK = np.float32(0.3989422804014327)
"""1 / sqrt(2 pi), the density at 0."""


@njit(inline="always")
def exp_of_minus(y):
    """Return exp(-y) for a float32 y >= 0, with a relative error of 1e-7, by operations that compilers
    vectorise; 0 from MOST on."""
    n = np.int32(min(y, MOST) * PER_LOG + HALF)
    r = np.float32(n) * HIGH - min(y, MOST) + np.float32(n) * LOW
    power = E1 * r + E2
    power = power * r + E3
    power = power * r + E4
    power = power * r + E5
    power = power * r + E6
    power = power * r * r + r + ONE
    power *= float_of_bits((np.int32(127) - n) << np.int32(23))
    return np.float32(0) if y >= MOST else power


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def gelu(x, bias, slopes):
    """Replace `x` [n, width] by the GELU of x + `bias` [width], and write the slopes to `slopes` [n, width].
    Both are accurate to 1e-6 in float32, and rounded in bfloat16 arrays."""
    for row in range(x.shape[0]):
        for c in range(x.shape[1]):
            value = get(x, row, c) + bias[c]
            density = PEAK * exp_of_minus(value * value * HALF)
            t = ONE / (ONE + SLOPE * abs(value))
            tail = density * (t * (B1 + t * (B2 + t * (B3 + t * (B4 + t * B5)))))
            share = ONE - tail if value >= 0 else tail
            put(x, row, c, value * share)
            put(slopes, row, c, share + value * density)


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def gelu_backward(grad, slopes, rows, grad_bias):
    """Multiply row i of `grad` [n, width] by row `rows[i]` of `slopes`, and write the sum of the rows of
    `grad` to `grad_bias` [width]."""
    grad_bias[:] = 0
    for row in range(grad.shape[0]):
        behind = rows[row]
        for c in range(grad.shape[1]):
            put(grad, row, c, get(grad, row, c) * get(slopes, behind, c))
        for c in range(grad.shape[1]):
            grad_bias[c] += get(grad, row, c)


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def times_basis(x, bias, basis):
    """Add `bias` [width] to `x` [n, width], then multiply the last columns of x by `basis` [n, n_basis], in
    place."""
    first = x.shape[1] - basis.shape[1]
    for row in range(x.shape[0]):
        for c in range(first):
            put(x, row, c, get(x, row, c) + bias[c])
        for c in range(basis.shape[1]):
            put(x, row, first + c, (get(x, row, first + c) + bias[first + c]) * basis[row, c])


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def times_basis_backward(grad, basis, rows, grad_bias):
    """Multiply the last columns of row i of `grad` [n, width] by row `rows[i]` of `basis`, and write the sum
    of the rows of `grad` to `grad_bias` [width]."""
    first = grad.shape[1] - basis.shape[1]
    grad_bias[:] = 0
    for row in range(grad.shape[0]):
        behind = rows[row]
        for c in range(first, grad.shape[1]):
            put(grad, row, c, get(grad, row, c) * basis[behind, c - first])
        for c in range(grad.shape[1]):
            grad_bias[c] += get(grad, row, c)


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def relu_backward(hidden, bias, weights, grad_out, grad_weights, grad_bias):
    """Propagate `grad_out` [n] back through out = `weights` [width] . relu(h + `bias` [width]). `hidden`
    [n, width] holds h, and is replaced by the gradient of h; the gradients of weights and bias are
    written."""
    zero = hidden.dtype.type(0)
    grad_weights[:] = 0
    grad_bias[:] = 0
    for row in range(hidden.shape[0]):
        g = grad_out[row]
        for c in range(hidden.shape[1]):
            value = hidden[row, c] + bias[c]
            grad_weights[c] += g * max(value, zero)
            back = g * weights[c] if value > 0 else zero
            hidden[row, c] = back
            grad_bias[c] += back
