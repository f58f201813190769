"""Compiled code is let go before a process runs out of memory maps."""

import sys

import jax
import jax.numpy as jnp
import pytest

from rotflex_jax.discover.room import make_room


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a process its maps")
def test_code_is_let_go_and_compiled_anew():
    traces = []

    @jax.jit
    def double(x):
        traces.append(x)
        return 2 * x

    double(jnp.ones(3))
    assert not make_room(10**9)
    double(jnp.ones(3))
    assert len(traces) == 1
    assert make_room(1)
    assert double(jnp.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert len(traces) == 2
