"""Times of jax-sysid and sysidentpy: `python elsewhere.py RECORDING.npz` prints them as JSON.

Runs in a separate environment without this project, since jax-sysid needs an older JAX. jax-sysid fits the
logarithms of the parameters of the joint without motor current, with one Runge-Kutta step per sample.
sysidentpy selects regressors of a Volterra series.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def jax_sysid(kept: Any) -> dict[str, float]:
    """Seconds of a fit from the given start, and half the sum of squared errors in units of the noise."""
    import jax
    import jax.numpy as jnp
    from jax_sysid.models import Model

    jax.config.update("jax_enable_x64", True)
    start, moved, Ts = kept["start"], kept["moved"], float(kept["Ts"])
    scale = 0.01 * np.std(kept["y"], axis=0)

    def flow(x: Any, v: Any, p: Any) -> Any:
        spring = p[2] * x[1] + p[7] * x[1] ** 3 + p[6] * x[3]
        faster = (p[3] * v - (p[4] + p[5]) * x[2] - p[8] * jnp.tanh(x[2] / p[9]) + spring) / p[0]
        return jnp.stack([x[2], x[3], faster, -spring / p[1] - faster])

    def step(x: Any, u: Any, params: Any) -> Any:
        p = jnp.asarray(start).at[moved].set(jnp.exp(params[0]))
        k = flow(x, u[0], p)
        a = flow(x + Ts / 2 * k, u[0], p)
        b = flow(x + Ts / 2 * a, u[0], p)
        return x + Ts / 6 * (k + 2 * a + 2 * b + flow(x + Ts * b, u[0], p))

    # Outputs are scaled so that both channels have the same weight as in the other fits.
    model = Model(4, 2, 1, state_fcn=step, output_fcn=lambda x, u, params: x[:2] / scale)
    model.loss(
        rho_x0=0.0,
        rho_th=0.0,
        train_x0=False,
        output_loss=lambda found, y: jnp.sum((found - y) ** 2) / 2 / len(y),
    )
    model.optimization(adam_epochs=0, lbfgs_epochs=1000, lbfgs_tol=1e-14, iprint=-1)

    def fit() -> float:
        model.init(params=[np.log(start[moved])], x0=np.zeros(4))
        model.fit(kept["y"] / scale, kept["u"])
        y_hat = np.asarray(model.predict(np.zeros(4), kept["u"])[0])
        return float(np.sum((y_hat - kept["y"] / scale) ** 2) / 2)

    seconds, cost = _timed(fit)
    return {"jax-sysid, a fit, compiled anew each time, seconds": seconds, "jax-sysid, cost from rest": cost}


def sysidentpy(kept: Any) -> dict[str, float]:
    """Seconds to select ten regressors, and the root mean square error that remains [rad]."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    u, y = kept["u"].reshape(-1, 1), kept["y"][:, 1].reshape(-1, 1)

    def choose() -> Any:
        # The input is shifted by a sample, since the package starts at lag 1 and rotflex_jax here at lag 0.
        late = np.vstack([u[1:], u[-1:]])
        model = FROLS(
            order_selection=False,
            n_terms=10,
            xlag=20,
            ylag=1,
            estimator=LeastSquares(),
            basis_function=Polynomial(degree=2),
            model_type="NFIR",
        )
        model.fit(X=late, y=y)
        return model, late

    seconds, (model, late) = _timed(choose)
    y_hat = model.predict(X=late, y=y)
    return {
        "sysidentpy, ten of 231 regressors, seconds": seconds,
        "sysidentpy, error of the ten [rad]": float(np.sqrt(np.mean((y_hat - y)[20:] ** 2))),
    }


def _timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Least wall-clock time of three runs [s], and the result."""
    times, found = [], None
    for _ in range(3):
        began = time.perf_counter()
        found = run()
        times.append(time.perf_counter() - began)
    return min(times), found


if __name__ == "__main__":
    recording = np.load(sys.argv[1])
    print(json.dumps({**jax_sysid(recording), **sysidentpy(recording)}))
