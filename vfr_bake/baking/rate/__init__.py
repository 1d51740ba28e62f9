"""Rate-distortion optimisation of the stored codes: choose the symbols that an asset stores, at a price for
each bit.

A symbol is the number of quantization steps by which a value of a pyramid's level differs from its prediction
by the next coarser level (`player.asset.pyramid`). Let the *importance* w_v of a vertex be the mean square by
which a unit of its value changes the colours of training rays, and d_v the difference between the stored and
the refined value. Symbols are chosen such that

    D + price R,    D = sum_v w_v d_v^2,    R = the bits of all symbols,

is small, level by level and vertex by vertex in the order in which they are coded. D ignores that errors of
vertices that lie on the same ray add up or cancel. So the price is chosen by the measured loss of pictures:
the highest price at which they lose no more than allowed, or the lowest one at which the asset fits into the
bytes that were asked for.

Vertices of coarser levels that are not shown serve as predictors. Their importance is the sum of that of all
finer vertices that they predict, by their shares in the prediction. The value wanted for a coarser feature is
the weighted mean of the finer ones; for a coarser density it is the value at the same place, because density
changes too fast at a surface for a mean to predict anything.
"""
