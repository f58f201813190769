"""Recordings as the commands read them: columns, units and sensors that the options name."""

import dataclasses
import functools
import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rotflex_jax.cli import terminal
from rotflex_jax.cli.arguments import (
    Accept,
    ArmAbsolute,
    Counts,
    Degrees,
    InputColumn,
    Intersample,
    OutputColumns,
    OwnEffects,
    Resample,
    SamplingPeriod,
    Signals,
    Substeps,
    TimeColumn,
    TimeUnit,
)
from rotflex_jax.errors import InputError
from rotflex_jax.joints.by_name import imported

if TYPE_CHECKING:
    from rotflex_jax.data.tables import Table
    from rotflex_jax.models.model import Model
    from rotflex_jax.recording import Recording

# Joints that can have one sensor alone.
ONE_SENSOR = ("paper", "quanser_2002", "quanser_2010")

# Smallest number of substeps for a smooth input.
SMOOTH_SUBSTEPS = 4


@dataclasses.dataclass(frozen=True)
class Columns:
    """How to read a recording: the options that all commands with files share, see `reads_files`."""

    input: InputColumn = None
    outputs: OutputColumns = None
    signals: Signals = None
    degrees: Degrees = False
    Ts: SamplingPeriod = None
    time: TimeColumn = None
    accept: Accept = None
    counts: Counts = None
    arm_absolute: ArmAbsolute = False
    time_unit: TimeUnit = None
    resample: Resample = None
    intersample: Intersample = "held"
    substeps: Substeps = None
    mechanism: Any = None  # its channels and signals are read if the options name none

    def __post_init__(self) -> None:
        if self.Ts is not None and self.time is not None:
            raise InputError(
                "--Ts and --time were both given, but the sampling period comes either from a "
                "column or from a number; give one of the two."
            )
        if self.Ts is not None and not self.Ts > 0:
            raise InputError(
                f"--Ts was given {self.Ts:g}, but a sampling period is a positive number of "
                "seconds; give for instance --Ts 0.002."
            )
        if self.intersample not in ("held", "smooth"):
            raise InputError(
                f"--intersample was given {self.intersample!r}, but the input between its samples is held or "
                "smooth; give one of the two."
            )
        if self.substeps is not None and self.substeps < 1:
            raise InputError(
                f"--substeps was given {self.substeps}, but each sample is integrated in one step or more; "
                "give for instance --substeps 4."
            )

    def of(self, model: "Model") -> "tuple[Model, Columns]":
        """The model with the integration that the options select, and how to read its recordings."""
        if self.intersample == "smooth":
            solver = model.solver
            if not hasattr(solver, "between"):
                raise InputError(
                    f"--intersample smooth was given, but the model has the integrator "
                    f"{type(solver).__name__}, which has no choice; leave it out."
                )
            substeps = max(SMOOTH_SUBSTEPS, getattr(solver, "substeps", 1))
            smooth: Any = dataclasses.replace(solver, between="smooth", substeps=substeps)  # pyright: ignore
            model = dataclasses.replace(model, solver=smooth)
        if self.substeps is not None:
            solver = model.solver
            if self.substeps > 1 and getattr(solver, "between", "held") == "switched":
                raise InputError(
                    f"--substeps {self.substeps} was given, but the input of the model is switched within "
                    "its samples, which needs one step in each; leave it out."
                )
            model = dataclasses.replace(model, solver=dataclasses.replace(solver, substeps=self.substeps))
        return model, dataclasses.replace(self, mechanism=model.mechanism)

    def load(self, file: Path) -> "Recording":
        """The recording in a file, in the units of the model."""
        if not file.exists():
            raise InputError(f"{file} does not exist; give the path of a recording.")
        from rotflex_jax.data import load
        from rotflex_jax.models.model import in_units_of

        recording = load(file, **self.reading())
        return recording if self.mechanism is None else in_units_of(self.mechanism, recording)

    def reading(self) -> dict[str, Any]:
        """The options as arguments of `rotflex_jax.load`."""
        from rotflex_jax.data.columns import named_outputs
        from rotflex_jax.models.model import units_to_read

        units = {} if self.mechanism is None else units_to_read(self.mechanism, self.input)
        channels, own = _channels(self.outputs or (), self.mechanism.channels if self.mechanism else ())
        named = (*named_outputs(channels), self.input)
        units = {name: unit for name, unit in units.items() if name in named} | own
        return {
            "input": self.input,
            "outputs": channels,
            "signals": _signals(self.signals or (), () if self.mechanism is None else self.mechanism.signals),
            "units": units,
            "degrees": self.degrees,
            "Ts": self.Ts,
            "time": self.time,
            "accept": tuple(self.accept or ()),
            "counts": _counts(self.counts or ()),
            "arm_absolute": self.arm_absolute,
            "time_unit": self.time_unit,
            "resample": _period(self.resample),
        }

    def sensor_alone(self, file: Path) -> str | None:
        """The only sensor of a joint that the options name or that a file has; None if it is not just one.

        A note lists the other columns of the file, since one may be a sensor with another name.
        """
        from rotflex_jax.data.columns import sensor_column
        from rotflex_jax.data.files import read_table
        from rotflex_jax.joints.rotary_flexible import SENSORS

        if self.outputs:
            found = [_name_and_unit(text.partition("=")[0])[0] for text in self.outputs]
            return found[0] if len(found) == 1 and found[0] in SENSORS else None
        try:
            table = read_table(file)
        except (InputError, OSError):
            return None  # loading the file later reports the reason
        column = {name: sensor_column(table, name) for name in SENSORS}
        found = [c for c in SENSORS if column[c] in table.columns]
        if not found or (len(found) > 1 and "alpha" in found):
            return None
        self._say_what_is_not_read(file.name, table, column, found[0])
        return found[0]

    def _say_what_is_not_read(
        self, file: str, table: "Table", column: Mapping[str, str], sensor: str
    ) -> None:
        """Print a note on numeric columns of a file of which only one sensor is read.

        Args:
            file: Name of the file.
            table: The columns of the file.
            column: Name of a sensor -> name of its column.
            sensor: The sensor that is read.
        """
        from rotflex_jax.data.columns import clock_column, input_column, named_signals

        signals = named_signals(_signals(self.signals or (), ()), table).values()
        named = (clock_column(table, self.time), input_column(table, self.input))
        known = {*column.values(), *signals, *named, *table.clocks.values()}
        others = [c for c, values in table.columns.items() if c not in known and values.dtype.kind in "fiu"]
        if others:
            other = "theta" if sensor == "alpha" else "alpha"
            both = (f"{sensor}={column[sensor]}", f"{other}={others[0]}")
            terminal.message(
                f"note: The output that is read from {file} is {column[sensor]!r}; not read: "
                f"{', '.join(map(repr, others))}. If another sensor is among these, name both, such as "
                f"{' '.join(f'--output {shlex.quote(each)}' for each in both)}.",
                error=True,  # stdout may be for JSON
            )

    def load_all(self, files: Sequence[Path]) -> "list[Recording]":
        """Recordings from files, and from public data sets whose names are given in place of a file."""
        found: list[Recording] = []
        for file in files:
            if public_name(file) is None:
                found.append(self.load(file))
                continue
            of_model = {"mechanism": None, "intersample": "held", "substeps": None}
            if dataclasses.replace(self, **of_model, accept=None) != Columns():
                raise InputError(
                    f"{file} is a public data set whose columns and units are known, but an option says how "
                    "to read it; leave that option out."
                )
            from rotflex_jax.data.datasets import load_dataset

            found += load_dataset(str(file))
        return found

    def load_parts(
        self, files: Sequence[Path], held_out: Sequence[Path], share: float
    ) -> "tuple[list[Recording], list[Recording]]":
        """Recordings to fit and held-out recordings; these are separate files or the end of each file."""
        train = self.load_all(files)
        if held_out:
            return train, self.load_all(held_out)
        parts = [recording.split(share) for recording in train]
        return [a for a, _ in parts], [b for _, b in parts]


Command = Callable[..., None]


def reads_files(command: Command) -> Command:
    """A command with the options that state how to read files, which make its argument `columns`.

    It also imports the files of `--with`, since a saved model and a search may have effects of the user.
    """
    reading = [f for f in dataclasses.fields(Columns) if f.name != "mechanism"]

    @functools.wraps(command)
    def inside(**arguments: Any) -> None:
        for file in arguments.pop("effects") or []:
            imported(file)
        command(columns=Columns(**{f.name: arguments.pop(f.name) for f in reading}), **arguments)

    own = inspect.signature(command, eval_str=True)
    before = [p for p in own.parameters.values() if p.name != "columns"]
    options = [(f.name, f.type, f.default) for f in reading] + [("effects", OwnEffects, None)]
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=type_)
        for name, type_, default in options
    ]
    listed = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in before] + added
    inside.__signature__ = own.replace(parameters=listed)  # pyright: ignore[reportAttributeAccessIssue]
    inside.__annotations__ = {p.name: p.annotation for p in listed} | {"return": None}
    del inside.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]
    return inside


def _counts(texts: Sequence[str]) -> float | dict[str, float] | None:
    """`4096` is for all channels, `theta=4096` for one."""
    if not texts:
        return None
    pairs = [text.split("=", 1) if "=" in text else ["", text] for text in texts]
    try:
        numbers = {channel: float(value) for channel, value in pairs}
    except ValueError:
        raise InputError(
            f"--counts was given {' '.join(texts)}, but needs the counts of one turn; give for instance "
            "--counts 4096, or --counts theta=4096 --counts alpha=8192."
        ) from None
    if "" in numbers and len(texts) > 1:
        raise InputError(
            f"--counts was given {' and '.join(texts)}, which do not say what channel each is for; give one "
            "number for all, or --counts theta=4096 --counts alpha=8192."
        )
    return numbers.get("", numbers)


def _period(text: str | None) -> float | str | None:
    """Sampling period [s] or the word `auto`; None if neither was given."""
    if text in (None, "auto"):
        return text
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--resample was given {text!r}, but needs a sampling period in seconds, or auto; give for "
            "instance --resample 0.002."
        ) from None


def _channels(
    outputs: Sequence[str], model: Sequence[str]
) -> tuple[Sequence[str] | Mapping[str, str] | None, dict[str, str]]:
    """Columns of the channels, and units that the options give.

    `theta=servo` names the channel too, `theta [deg]=servo` also its unit. Plain names of columns come in the
    order of the model's channels.
    """
    if outputs and all("=" in text for text in outputs):
        columns, units = {}, {}
        for text in outputs:
            said, column = text.split("=", 1)
            channel, unit = _name_and_unit(said)
            if channel in columns:
                raise InputError(
                    f"--output was given the channel {channel!r} for {columns[channel]!r} and for "
                    f"{column!r}, but a channel has one column; leave one of the two out."
                )
            columns[channel] = column
            units |= {channel: unit} if unit else {}
        return columns, units
    if not outputs and model:
        return dict(zip(model, model, strict=True)), {}
    named = model and len(outputs) == len(model)
    return dict(zip(model, outputs, strict=True)) if named else outputs or None, {}


def _name_and_unit(text: str) -> tuple[str, str]:
    from rotflex_jax.recording.samples import name_and_unit

    return name_and_unit(text)


def _signals(texts: Sequence[str], model: Sequence[str]) -> Sequence[str] | Mapping[str, str] | None:
    """`base [m/s^2]=acc` names the signal too; where none is given, the model's are read by their names."""
    if not texts:
        return dict(zip(model, model, strict=True)) or None
    named = [text for text in texts if "=" in text]
    if not named:
        return list(texts)
    alone = [text for text in texts if "=" not in text]
    if alone:
        raise InputError(
            f"--signal was given {alone[0]!r} and {named[0]!r}, but either each signal has a name or none; "
            f'name that one too, for instance --signal "{alone[0]}={alone[0]}".'
        )
    columns: dict[str, str] = {}
    for text in named:
        name, column = (part.strip() for part in text.split("=", 1))
        if name in columns:
            raise InputError(
                f"--signal was given the name {name!r} for {columns[name]!r} and for {column!r}, but each "
                "signal needs a name of its own; change one."
            )
        columns[name] = column
    return columns


def public_name(file: Path) -> str | None:
    """The name of a public data set that is given in place of a file; None for anything else."""
    from rotflex_jax.data.registry import DATASETS

    name = str(file)
    if name not in DATASETS or file.exists():
        return None
    if not DATASETS[name].joint:
        raise InputError(
            f"The data set {name} has recordings of several machines, or some that are kept for an official "
            f"test, and is not searched by its name; see rf.data.load_dataset({name!r}) and the page of "
            "public machines, or name its files."
        )
    return name


def _check_one_column(outputs: Sequence[str], joint: str) -> None:
    """Refuse a single column if the options do not state which sensor of a joint it is."""
    if len(outputs) == 1 and "=" not in outputs[0]:
        raise InputError(
            f"--output was given {outputs[0]!r} alone, but the joint {joint} has two sensors, and nothing "
            f"says which of them this is; give --output theta={outputs[0]} for the angle of the hub, "
            f"--output alpha={outputs[0]} for the deflection, or a second --output."
        )


def joint_for(files: Sequence[Path], joint: str, columns: Columns) -> str:
    """The joint that was given, or the joint of a public data set if its name is given in place of files.

    If the files have only one sensor of the joint, the joint has only this sensor.

    Raises:
        InputError: A single column is named, but not the sensor that it belongs to.
    """
    from rotflex_jax.data.registry import DATASETS

    names = {public_name(file) for file in files}
    name = names.pop() if len(names) == 1 else None
    if name is not None:
        return DATASETS[name].joint if joint == "paper" else joint
    if joint.partition(":")[0] not in ONE_SENSOR or "sensors=" in joint:
        return joint
    sensor = columns.sensor_alone(files[0])
    if sensor is None:
        _check_one_column(columns.outputs or (), joint)
        return joint
    return f"{joint}{',' if ':' in joint else ':'}sensors={sensor}"
