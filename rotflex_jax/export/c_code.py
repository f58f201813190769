"""A fitted model as C code for a controller: one header, C99, no dynamic memory, double precision.

The code is generated from the same functions that the simulator runs, with all constants of the model
evaluated beforehand. Effects that a user defines are therefore included automatically.
"""

import re
from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.checks import positive, shown
from rotflex_jax.errors import InputError
from rotflex_jax.export.expression import OPERATIONS, Expression, Operand, ordered
from rotflex_jax.export.program import SampleProgram, sample_program
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.linear import state_names
from rotflex_jax.mechanism.mechanism import check_input_alone
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import specifications
from rotflex_jax.text.numbers import one_line

# Length [characters] above which an expression gets a variable of its own even if it is used once.
_LONGEST_EXPRESSION = 90


def to_c(model: Mechanism | Model, Ts: float, prefix: str = "rotflex") -> str:
    """C code (C99) of a model's free run, one sample a call.

        rotflex_state s;  double y[ROTFLEX_OUTPUTS];
        rotflex_init(&s);
        for (;;) rotflex_step(&s, u, y);    /* y at the start of the sample over which u is held */

    `rotflex_read(&s, y)` gives the outputs without a step.

    The outputs agree with `Model.simulate` to rounding. The code is valid for the sampling period `Ts` only,
    since its matrix exponential is evaluated beforehand.

    Args:
        model: Mechanism with its parameter values, or a Model.
        Ts: Sampling period of the controller [s].
        prefix: Prefix of the names in the code.

    Returns:
        The text of a header that contains everything; functions are `static`.

    Raises:
        InputError: C code cannot express an effect, which the message names; the sampling period or the
            prefix is invalid.
    """
    model, Ts = Model.of(model), positive(Ts, "Ts", example="0.002")
    check_input_alone(model.mechanism, "C code")
    if not (isinstance(prefix, str) and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix)):
        raise InputError(
            f"The prefix {shown(prefix)} begins no name in C; give letters, digits and underscores."
        )
    return "\n".join(_lines(model, Ts, prefix, sample_program(model, Ts))) + "\n"


def _number(value: Operand) -> str:
    if isinstance(value, bool):
        return "1" if value else "0"
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(float(value))
    return f"({text})" if value < 0 else text


class _Printer:
    """Writes C statements for expressions, each expression once."""

    def __init__(self, leaf: Callable[[Expression], str], roots: list[Operand]) -> None:
        self.leaf, self.text, self.count = leaf, {}, 0
        self.uses: dict[Expression, int] = {}
        for e in ordered(roots):
            for a in e.args:
                if isinstance(a, Expression):
                    self.uses[a] = self.uses.get(a, 0) + 1
        for r in roots:
            if isinstance(r, Expression):
                self.uses[r] = self.uses.get(r, 0) + 1

    def statements(self, roots: list[Operand]) -> Iterator[str]:
        """Statements that must precede the use of the expressions `roots`."""
        for e in ordered(roots):
            if e in self.text:
                continue
            if e.op not in OPERATIONS:
                self.text[e] = self.leaf(e)
                continue
            text = OPERATIONS[e.op].text.format(*(self(a) for a in e.args))
            if self.uses.get(e, 0) > 1 or len(text) > _LONGEST_EXPRESSION:
                name = f"t{self.count}"
                self.count += 1
                kind = "int" if e.truth else "double"
                yield f"    const {kind} {name} = {_bare(text)};"
                text = name
            self.text[e] = text

    def __call__(self, value: Operand) -> str:
        return self.text[value] if isinstance(value, Expression) else _number(value)


def _bare(text: str) -> str:
    """The expression without brackets around the whole."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1]


def _lines(model: Model, Ts: float, prefix: str, code: SampleProgram) -> Iterator[str]:
    mechanism, name = model.mechanism, prefix.upper()
    names, substeps = state_names(mechanism), model.solver.substeps
    firsts, pasts, counted = _sequence_states(code)
    start = rest_state(mechanism.structure, np.float64)
    yield from _heading(mechanism, model, Ts)
    yield f"#ifndef {name}_MODEL_H\n#define {name}_MODEL_H\n\n#include <math.h>\n"
    yield f"#define {name}_STATES {len(names)}"
    yield f"#define {name}_OUTPUTS {len(mechanism.channels)}"
    yield f"#define {name}_TS {_number(Ts)} /* sampling period [s] */\n"
    yield "typedef struct {"
    yield f"    double x[{len(names)}]; /* {in_c_comment(', '.join(names))} */"
    yield "    int started; /* whether there has been a command */"
    if counted:
        yield "    double count; /* samples so far */"
    if firsts:
        yield f"    double first[{len(firsts)}]; /* of the first command */"
    for i, e in enumerate(pasts):
        yield f"    double past{i}[{e.args[1]}]; /* the last commands, the oldest at place{i} */"
        yield f"    int place{i};"
    if code.sequence_states:
        yield f"    double carry[{len(code.sequence_states)}]; /* states of the actuation */"
    yield f"}} {prefix}_state;\n"
    yield "/* Rest. The first positions and speeds may be written to s->x afterwards. */"
    yield f"static void {prefix}_init({prefix}_state *s)\n{{"
    x = ", ".join(map(_number, start))
    yield f"    static const {prefix}_state rest = {{.x = {{{x}}}, .started = 0}};"
    yield "    *s = rest;\n}\n"
    yield "/* y: what the sensors read now. */"
    outputs = f"double y[{len(mechanism.channels)}]"
    yield f"static void {prefix}_read(const {prefix}_state *s, {outputs})\n{{"
    yield from _reading(code)
    yield "}\n"
    unit = in_c_comment(mechanism.units.input)
    yield f"/* y: what the sensors read now. u: command that is held from now over one sample [{unit}]. */"
    yield f"static void {prefix}_step({prefix}_state *s, double u, {outputs})\n{{"
    yield f"    {prefix}_read(s, y);"
    yield from _driving(code, firsts, pasts)
    if counted:
        yield "    s->count += 1;"
    yield from _moving(code, substeps)
    yield f"}}\n\n#endif /* {name}_MODEL_H */"


def _heading(mechanism: Mechanism, model: Model, Ts: float) -> Iterator[str]:
    yield "/* Generated by rotflex_jax from a fitted model; all its constants are evaluated."
    yield f" * Sampling period {Ts:g} s, {type(model.solver).__name__} step."
    yield " *"
    gates = model.gates or (1.0,) * len(mechanism.effects)
    for effect, gate in zip(mechanism.effects, gates, strict=True):
        off = "" if gate else " (switched off)"
        yield " * " + in_c_comment(f"{effect.title} at {effect.at}{off}: {effect.equation}")
        declared = specifications(effect)
        for n, v in effect.values.items():
            unit = mechanism.unit_of(effect, declared[n].unit)
            yield " *     " + in_c_comment(f"{n} = {v:.10g} {unit}".rstrip())
    yield " */"


def in_c_comment(text: str) -> str:
    """A text on one line that cannot end a comment in C; names may come from a file."""
    return one_line(text).replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")


def _sequence_states(code: SampleProgram) -> tuple[list[Expression], list[Expression], bool]:
    """States that the actuation needs: first commands, delayed commands, whether samples are counted."""
    roots = [code.voltage, *(m.start for m in code.sequence_states), *(m.next for m in code.sequence_states)]
    below = list(ordered(roots))
    found = {op: [e for e in below if e.op == op] for op in ("first", "past", "count")}
    return found["first"], found["past"], bool(found["count"])


def _reading(code: SampleProgram) -> Iterator[str]:
    printer = _Printer(lambda e: f"s->x[{e.args[0]}]", code.outputs)
    lines = list(printer.statements(code.outputs))
    yield from lines
    yield from (f"    y[{i}] = {_bare(printer(y))};" for i, y in enumerate(code.outputs))


def _driving(code: SampleProgram, firsts: list[Expression], pasts: list[Expression]) -> Iterator[str]:
    """Statements for the voltage `v` from the command, and for the next states of the actuation."""
    roots = [code.voltage, *(m.next for m in code.sequence_states)]
    starts = [m.start for m in code.sequence_states]

    def leaf(e: Expression) -> str:
        if e.op == "first":
            return f"s->first[{firsts.index(e)}]"
        if e.op == "past":
            return f"late{pasts.index(e)}"
        return {"carry": f"s->carry[{(*e.args, 0)[0]}]", "count": "s->count"}.get(e.op, e.op)

    printer = _Printer(leaf, [*roots, *starts])
    yield "    double v;\n    {"
    waiting = list(enumerate(starts))
    for e in ordered([*starts, *roots]):
        # A state is initialised before any expression that contains it.
        while waiting and e.op == "carry" and waiting[0][0] <= e.args[0]:
            i, start = waiting.pop(0)
            yield from (f"    {line}" for line in printer.statements([start]))
            yield f"        if (!s->started) s->carry[{i}] = {_bare(printer(start))};"
        yield from (f"    {line}" for line in printer.statements([e]))
        if e.op in ("first", "past"):
            base = printer(e.args[0])
        if e.op == "first":
            yield f"        if (!s->started) {leaf(e)} = {_bare(base)};"
        if e.op == "past":
            i, d = pasts.index(e), e.args[1]
            early = _bare(base) if len(e.args) == 2 else _number(e.args[2])
            yield f"        if (!s->started) for (int k = 0; k < {d}; k++) s->past{i}[k] = {early};"
            yield f"        const double late{i} = s->past{i}[s->place{i}];"
            yield f"        s->past{i}[s->place{i}] = {_bare(base)};"
            yield f"        s->place{i} = (s->place{i} + 1) % {d};"
    yield f"        v = {_bare(printer(code.voltage))};"
    states = enumerate(code.sequence_states)
    news = [f"        const double new{i} = {_bare(printer(m.next))};" for i, m in states]
    yield from news
    yield from (f"        s->carry[{i}] = new{i};" for i in range(len(news)))
    yield "        s->started = 1;\n    }"


def _moving(code: SampleProgram, substeps: int) -> Iterator[str]:
    printer = _Printer(lambda e: "v" if e.op == "v" else f"s->x[{e.args[0]}]", code.state)
    indent = "    " if substeps == 1 else "        "
    yield "    {" if substeps == 1 else f"    for (int step = 0; step < {substeps}; step++) {{"
    yield from (f"    {line}" for line in printer.statements(code.state))
    news = list(enumerate(code.state))
    yield from (f"        const double x{i} = {_bare(printer(x))};" for i, x in news)
    yield from (f"        s->x[{i}] = x{i};" for i, _ in news)
    yield indent[4:] + "    }"
