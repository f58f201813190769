"""One more sample in the inverse of a Gram matrix, carried as a square root."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.adaptive.ranges import Number
from rotflex_jax.adaptive.sums import times, tree_sum


def correct(
    S: Float[Array, "P P"], phi: Float[Array, " P"], lam: Number, gamma: Number
) -> tuple[Float[Array, "P P"], Float[Array, " P"], Float[Array, ""]]:
    """Potter's update of `P = S S'`, the inverse of `R <- lam R + gamma phi phi'`.

        v = S' phi,  a = lam / gamma + v'v,  g = S v / a,
        S <- (S - g v' / (1 + sqrt(lam / (gamma a)))) / sqrt(lam)

    P stays positive whatever the rounding, and S needs half the digits that P needs: against extended
    precision the errors of RLS come out a thousand times smaller than with a recursion for P.

    Args:
        S: square root, of any form.
        phi: regressor.
        lam: forgetting factor.
        gamma: weight of the sample.

    Returns:
        The new root, the gain `g` that corrects weights by `w + g e` with the a-priori error e, and
        `lam / a`, which is gamma times the share of e that the correction leaves.
    """
    r = lam / gamma
    v = times(phi, S)
    a = r + tree_sum(v * v)
    g = times(S, v) / a
    share = 1 / (1 + jnp.sqrt(r / a))
    return (S - (share * g)[:, None] * v[None, :]) / jnp.sqrt(lam), g, jnp.divide(lam, a)
