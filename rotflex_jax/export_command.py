"""`rotflex export`: a saved model as C code, LaTeX, text or state space."""

import json
from pathlib import Path
from typing import Annotated

import typer

from rotflex_jax import arguments as given
from rotflex_jax.errors import InputError

FORMS = ("c", "latex", "text", "statespace")


def export(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL", help="File that --save-model has written, FILE.py:NAME, or a preset."
        ),
    ],
    to: Annotated[str, typer.Option("--to", metavar="FORM", help=f"One of {', '.join(FORMS)}.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write here instead of to stdout.")
    ] = None,
    Ts: Annotated[
        float | None,
        typer.Option(
            "--Ts",
            metavar="SECONDS",
            help="Sampling period of the C code (that of the model's data unless given) "
            "or of a discrete state space (continuous unless given).",
        ),
    ] = None,
    prefix: Annotated[
        str, typer.Option(metavar="NAME", help="What the names in the C code begin with.")
    ] = "rotflex",
    effects: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="FILE.py", help="Python file that registers effects of your own."),
    ] = None,
) -> None:
    """Give a model as C code for a controller, as equations, or as state space."""
    form = given.choose(to, FORMS, "form of export")
    given.check_writable(json_file=out)
    from rotflex_jax import export as forms
    from rotflex_jax.choices import imported

    for file in effects or []:
        imported(file)
    subject, period = given.model(model), Ts
    if form == "c" and period is None and model.endswith(".json"):
        period = forms.read(model).Ts
    if form == "c" and period is None:
        raise InputError(
            f"{model} does not say how its data were sampled, but C code needs a sampling period; give --Ts."
        )
    if form == "c":
        text = forms.to_c(subject, float(period or 0), prefix)
    elif form == "statespace":
        text = json.dumps(forms.state_space(subject, period).to_dict(), indent=2) + "\n"
    else:
        text = forms.latex(subject) if form == "latex" else forms.text(subject)
    if out is None or out == given.STDOUT:
        print(text, end="")
    else:
        out.write_text(text, encoding="utf-8")
