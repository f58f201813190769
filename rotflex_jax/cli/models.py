"""`rotflex simulate` and `rotflex export`: a model's free run, and a saved model for use elsewhere."""

import json
from pathlib import Path

import typer

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.recordings import Columns, reads_files
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name
from rotflex_jax.text.files import write_file


@reads_files
def simulate(
    file: given.OneFile,
    joints: given.JointNames = None,
    add: given.AddedEffects = None,
    fit: given.FittedBefore = None,
    save: given.SimulationFile = None,
    save_model: given.ModelFile = None,
    report: given.SimulationReport = None,
    *,
    columns: Columns,
) -> None:
    """Simulate a recording in free run and compare with what was measured."""
    given.check_distinct([file], fit or [])
    given.check_writable(save, save_model, folder=report, read=[file, *(fit or [])])
    model = by_name.model(given.one_model(joints), add or ())
    model, columns = columns.of(model)
    recording = columns.load(file)
    train = [columns.load(other) for other in fit or []]
    terminal.print_findings([recording, *train])
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    import rotflex_jax as rf
    from rotflex_jax.export import Saved, save as save_to

    saved = Saved(model, Ts=recording.Ts, n_init=recording.n_init)
    fitted = None
    if train:
        with terminal.progress("Fitting") as step:

            def tell(line: str) -> None:
                if " steps, " not in line:  # without a terminal, each would be a line of its own
                    step(line)

            fitted = rf.fit(model, train, progress=tell)
        model, first = fitted.model, train[0]
        saved = Saved(model, fitted.parameters, fitted.covariance, fitted.free_names, first.Ts, first.n_init)
        terminal.print_remarks(fitted)
    y, y_hat = model.measured(recording), model.simulate(recording)
    rmse = rf.metrics.rmse(y, y_hat, recording.n_init).tolist()
    units = {name: recording.unit(name) for name in model.mechanism.channels}
    errors = dict(zip(units, rmse, strict=True))
    console = terminal.output()
    console.print(terminal.error_table([("RMS error of the free run", errors)], units))
    explained = zip(units, rf.metrics.fit_percent(y, y_hat, recording.n_init), strict=True)
    terminal.message(f"Fit, where 100 % is perfect: {', '.join(f'{c} {p:.1f} %' for c, p in explained)}")
    if save is not None:
        terminal.save_simulation(save, recording, dict(zip(units, y_hat.T, strict=True)))
    if save_model is not None:
        save_to(saved, save_model)
    if report is not None:
        from rotflex_jax.report.simulation import tested, write_simulation

        with terminal.progress("Writing the report"):
            page = write_simulation(tested(recording, model, y_hat, fitted), report)
        terminal.message(f"Report: {page}")


# Option of `rotflex export` -> forms of export that use it.
USED_IN = {
    "Ts": ("c", "statespace", "controller", *given.SIMULATORS),
    "prefix": ("c", "controller"),
    "port": ("controller",),
    "length": ("bam",),
    "actuator": ("bam",),
}


def export(
    context: typer.Context,
    model: given.ExportedModel,
    to: given.ExportForm,
    out: given.ExportFile = None,
    Ts: given.ExportPeriod = None,
    prefix: given.Prefix = None,
    effects: given.OwnEffects = None,
    port: given.ControlledPort = "hub",
    length: given.PendulumLength = 0.1,
    actuator: given.ServoName = "xl330",
) -> None:
    """Give a model as C code, as equations, as state space or for a simulator, or a controller of it in C."""
    form = by_name.choose(to, given.EXPORT_FORMS, "form of export")
    for option, forms_with in USED_IN.items():
        if given.was_given(context, option) and form not in forms_with:
            raise InputError(f"--{option} was given, but {form} has no use of it; leave it out.")
    given.check_writable(or_stdout=out, read=[Path(model.partition(":")[0])])
    if form == "fmu" and out in (None, given.STDOUT):
        raise InputError("An FMU is an archive, which is not shown as text; give --out FILE.fmu.")
    from rotflex_jax import export as forms
    from rotflex_jax.joints.by_name import imported

    for file in effects or []:
        imported(file)
    subject, period = by_name.model(model), Ts
    if prefix is None:
        prefix = "control" if form == "controller" else "rotflex"
    sampled = form in ("c", "controller", *given.SIMULATORS)
    if sampled and period is None and model.endswith(".json"):
        period = forms.read(model).Ts
    stepped = {"c": "C code", "controller": "a controller", "fmu": "an FMU"}
    if form in stepped and period is None:
        raise InputError(
            f"{model} does not say how its data were sampled, but {stepped[form]} needs a sampling period; "
            "give --Ts."
        )
    text: str | bytes
    if form in given.SIMULATORS:
        from rotflex_jax.runtime.xla import enable_fast_start

        enable_fast_start()
        period = 0.002 if period is None else float(period)
        name = Path(model.partition(":")[0]).stem
        if form == "bam":
            exported = forms.to_bam(subject, period, actuator, length)
        else:
            exported = {"mjcf": forms.to_mjcf, "urdf": forms.to_urdf, "fmu": forms.to_fmu}[form](
                subject, period, name
            )
        text = exported.content
        terminal.message(str(exported.certificate), error=out in (None, given.STDOUT))
    elif form == "c":
        text = forms.to_c(subject, float(period or 0), prefix)
    elif form == "controller":
        from rotflex_jax.control import controller, controller_to_c

        text = controller_to_c(controller(subject, float(period or 0), port=port), prefix=prefix)
    elif form == "statespace":
        text = json.dumps(forms.state_space(subject, period).to_dict(), indent=2) + "\n"
    else:
        text = forms.latex(subject) if form == "latex" else forms.text(subject)
    if out is None or out == given.STDOUT:
        print(text if isinstance(text, str) else "", end="")
    else:
        write_file(out, text)
