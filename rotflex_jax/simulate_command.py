"""`rotflex simulate`: a free run of any model over a recording, next to what was measured."""

from pathlib import Path
from typing import Annotated

import typer

from rotflex_jax import arguments as given, terminal


def simulate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording to simulate.")],
    joint: given.JointName = "paper",
    add: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT@PORT", help="Add an effect: coulomb@hub or coulomb@hub:level=0.03."),
    ] = None,
    fit: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Fit the model to this recording before."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Write what was measured and simulated.")
    ] = None,
    save_model: given.ModelFile = None,
    input_column: given.InputColumn = None,
    output_columns: given.OutputColumns = None,
    degrees: given.Degrees = False,
    Ts: given.SamplingPeriod = None,
    time_column: given.TimeColumn = None,
    accept: given.Accept = None,
) -> None:
    """Simulate a recording in free run and compare with what was measured."""
    given.check_distinct([file], fit or [])
    for target in (save, save_model):
        given.check_writable(json_file=target)
    model = given.model(joint, add or ())
    columns = given.Columns(input_column, output_columns, degrees, Ts, time_column, accept, model.mechanism)
    recording = columns.load(file)
    train = [columns.load(other) for other in fit or []]
    terminal.print_findings([recording, *train])
    from rotflex_jax.fastloops import quicken

    quicken()
    import rotflex_jax as rf
    from rotflex_jax.export import Saved, save as save_to

    saved = Saved(model, Ts=recording.Ts, n_init=recording.n_init)
    if train:
        with terminal.progress("Fitting"):
            fitted = rf.fit(model, train)
        model, first = fitted.model, train[0]
        saved = Saved(model, fitted.parameters, fitted.covariance, fitted.free_names, first.Ts, first.n_init)
    y, y_hat = model.measured(recording), model.simulate(recording)
    rmse = rf.metrics.rmse(y, y_hat, recording.n_init).tolist()
    units = {name: terminal.unit_of(recording, name) for name in model.mechanism.channels}
    errors = dict(zip(units, rmse, strict=True))
    console = terminal.output()
    console.print(terminal.error_table([("RMS error of the free run", errors)], units))
    explained = zip(units, rf.metrics.fit_percent(y, y_hat, recording.n_init), strict=True)
    terminal.message(f"Fit, where 100 % is perfect: {', '.join(f'{c} {p:.1f} %' for c, p in explained)}")
    if save is not None:
        terminal.save_simulation(save, recording, dict(zip(units, y_hat.T, strict=True)))
    if save_model is not None:
        save_to(saved, save_model)
