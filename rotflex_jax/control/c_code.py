"""A controller as C code: one header, C99, no dynamic memory, double precision."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from rotflex_jax.checks import instance, shown
from rotflex_jax.control.design import Controller
from rotflex_jax.errors import InputError
from rotflex_jax.export.c_code import in_c_comment


def controller_to_c(
    controller: Controller,
    reference: Float[ArrayLike, " N"] | Sequence[float] | None = None,
    prefix: str = "control",
) -> str:
    """C code (C99) of a controller, one sample a call.

        control_state s;  control_init(&s);
        for (;;) u = control_step(&s, y, y_plan, u_plan);    /* y read now, u held until the next sample */

    `y_plan` and `u_plan` are outputs and voltage of the planned motion. With a `reference`, the code also
    contains them as tables `control_y_plan` and `control_u_plan`, with one row for each sample.

    Args:
        controller: From `controller`.
        reference: Reference whose planned motion is included in the code; None for no tables.
        prefix: Prefix of the names in the code.

    Returns:
        The text of a header that contains everything; functions are `static`.

    Raises:
        InputError: The prefix is no valid start of a name in C, or the reference is no signal.
    """
    if not (isinstance(prefix, str) and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix)):
        raise InputError(
            f"The prefix {shown(prefix)} begins no name in C; give letters, digits and underscores."
        )
    instance(controller, Controller, "controller", "make one with rotflex_jax.controller")
    c, big = controller, prefix.upper()
    m, channels = len(c.B), len(c.C)
    mechanism = c.model.mechanism
    sensors = [
        f"{in_c_comment(name)} [{in_c_comment(quantity.unit(mechanism.units))}]"
        for name, quantity in zip(mechanism.channels, mechanism.quantities, strict=True)
    ]
    lines = [
        f"/* Controller of {in_c_comment(c.port)}, made by rotflex_jax; every {c.Ts!r} s.",
        f"   y: {', '.join(sensors)};"
        f" u: {c.input_name} [{in_c_comment(mechanism.units.input)}], at most {c.limit!r}.",
        f"   states: {', '.join(in_c_comment(name) for name in c.states)}. */",
        f"#ifndef {big}_H",
        f"#define {big}_H",
        f"#define {big}_STATES {m}",
        f"#define {big}_OUTPUTS {channels}",
        f"#define {big}_TS {c.Ts!r}",
        "",
        _array(f"{prefix}_A[{big}_STATES][{big}_STATES]", c.A),
        _array(f"{prefix}_B[{big}_STATES]", c.B),
        _array(f"{prefix}_C[{big}_OUTPUTS][{big}_STATES]", c.C),
        _array(f"{prefix}_K[{big}_STATES]", c.K),
        _array(f"{prefix}_L[{big}_STATES][{big}_OUTPUTS]", c.L),
        "",
        "typedef struct {",
        f"    double e[{big}_STATES];     /* deviation from the plan, expected at this sample */",
        f"    double seen[{big}_STATES];  /* the same, corrected by what was read; last: load torque */",
        f"}} {prefix}_state;",
        "",
        f"static void {prefix}_init({prefix}_state *s)",
        "{",
        "    int i;",
        f"    for (i = 0; i < {big}_STATES; i++) s->e[i] = s->seen[i] = 0.0;",
        "}",
        "",
        f"static double {prefix}_step({prefix}_state *s, const double *y, const double *y_plan,",
        f"    {' ' * len(prefix)}double u_plan)",
        "{",
        f"    double innovation[{big}_OUTPUTS], u = u_plan, du;",
        "    int i, j;",
        f"    for (i = 0; i < {big}_OUTPUTS; i++) {{",
        "        innovation[i] = y[i] - y_plan[i];",
        f"        for (j = 0; j < {big}_STATES; j++) innovation[i] -= {prefix}_C[i][j] * s->e[j];",
        "    }",
        f"    for (i = 0; i < {big}_STATES; i++) {{",
        "        s->seen[i] = s->e[i];",
        f"        for (j = 0; j < {big}_OUTPUTS; j++) s->seen[i] += {prefix}_L[i][j] * innovation[j];",
        f"        u -= {prefix}_K[i] * s->seen[i];",
        "    }",
        f"    u = u > {c.limit!r} ? {c.limit!r} : u < -{c.limit!r} ? -{c.limit!r} : u;",
        "    du = u - u_plan;  /* what was really given: the observer does not wind up */",
        f"    for (i = 0; i < {big}_STATES; i++) {{",
        f"        s->e[i] = {prefix}_B[i] * du;",
        f"        for (j = 0; j < {big}_STATES; j++) s->e[i] += {prefix}_A[i][j] * s->seen[j];",
        "    }",
        "    return u;",
        "}",
    ]
    if reference is not None:
        motion = c.plan(reference)
        lines += [
            "",
            f"#define {big}_SAMPLES {len(motion.voltage)}",
            _array(f"{prefix}_y_plan[{big}_SAMPLES][{big}_OUTPUTS]", motion.outputs),
            _array(f"{prefix}_u_plan[{big}_SAMPLES]", motion.voltage),
        ]
    return "\n".join([*lines, "#endif", ""])


def _array(declared: str, values: np.ndarray) -> str:
    """Definition of a constant array in C, with enough digits to represent the numbers exactly."""
    rows = [", ".join(repr(float(v)) for v in row) for row in np.atleast_2d(values)]
    inside = rows[0] if values.ndim == 1 else ",\n    ".join(f"{{{row}}}" for row in rows)
    return f"static const double {declared} = {{\n    {inside}\n}};"
