"""Precision and time of computations, and parallel calls on threads."""

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rotflex_jax.joints import paper
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import cores, double_precision, on_threads, working_precision


@pytest.mark.parametrize("context", [double_precision, lambda: working_precision(np.ones(1))])
def test_numbers_are_computed_at_once_and_precisely_inside_of_another_program(context) -> None:
    def outer(x):
        with context():
            found = np.asarray(jnp.sqrt(jnp.asarray(2.0)))  # of an array that is still to come if traced
        assert found == np.sqrt(2.0)
        return jnp.asarray(x) + 1

    assert jax.jit(outer)(1.0) == 2.0
    assert jax.jit(outer)(1.0).dtype == np.float32


def test_a_model_runs_inside_of_another_program() -> None:
    u = np.sin(np.arange(200) / 10)
    recording = Recording(u=u, y=simulate(paper(), u, 0.01), Ts=0.01)
    model = Model(paper())
    runs = []
    jax.jit(lambda x: runs.append(model.simulate(recording)) or x)(1.0)
    np.testing.assert_array_equal(runs[0], model.simulate(recording))


def test_results_come_in_the_order_of_the_jobs():
    assert on_threads(lambda x: x**2, range(50)) == [x**2 for x in range(50)]
    assert on_threads(lambda x: x, []) == []


def test_calls_from_within_calls_end_though_all_threads_are_busy():
    """Each outer call waits for its inner ones, which therefore must not need a thread of their own."""
    found = []

    def outer(k):
        return sum(on_threads(lambda x: k * x, range(10)))

    def several():
        found.extend(on_threads(outer, range(4 * cores())))

    # On a separate thread, so that the test fails and does not hang if the threads wait for each other.
    caller = threading.Thread(target=several, daemon=True)
    caller.start()
    caller.join(timeout=30)
    assert found == [45 * k for k in range(4 * cores())]


def test_an_error_is_raised_once_what_has_begun_has_ended():
    begun, ended = [], []

    def run(k):
        begun.append(k)
        if k == 0:
            raise ZeroDivisionError("first")
        ended.append(k)

    with pytest.raises(ZeroDivisionError, match="first"):
        on_threads(run, range(100))
    assert sorted(ended) == sorted(k for k in begun if k)


def test_what_has_begun_stops_at_its_next_call_from_within() -> None:
    """A long fit does not run to its end after the user has stopped the search."""
    begun, steps = threading.Event(), []

    def run(k):
        if k == 0:
            begun.wait(30)
            raise KeyboardInterrupt
        for _ in range(20_000):
            steps.append(k)
            begun.set()
            on_threads(time.sleep, [0.001])
        return k

    if cores() == 1:
        pytest.skip("one core: nothing runs beside the call that fails")
    with pytest.raises(KeyboardInterrupt):
        on_threads(run, [0, 1])
    assert 0 < len(steps) < 20_000
    assert on_threads(lambda x: x, [1, 2]) == [1, 2]  # the threads are free again


def test_threads_take_numpys_settings_for_errors_from_the_caller():
    zeros = [np.zeros(1)] * 3
    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        on_threads(lambda x: 1.0 / x, zeros)
    with np.errstate(divide="ignore"):
        assert all(np.isinf(x[0]) for x in on_threads(lambda x: 1.0 / x, zeros))
