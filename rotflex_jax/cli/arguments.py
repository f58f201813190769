"""Every option of the command line with its help, and the checks that several commands share."""

import dataclasses
import functools
import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rotflex_jax.errors import InputError
from rotflex_jax.joints.by_name import JOINTS

if TYPE_CHECKING:
    from rotflex_jax.models.model import Model
    from rotflex_jax.recording import Recording


STDOUT = Path("-")
SIMULATORS = ("mjcf", "urdf", "fmu", "bam")
EXPORT_FORMS = ("c", "latex", "text", "statespace", "controller", *SIMULATORS)

Files = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        help="Recordings: .csv, .tsv, .xlsx, .mat, .npz, .parquet, .tdms, .mf4, .mcap; a folder with a file "
        "for each channel; or rotflex, the public data set.",
    ),
]
JointName = Annotated[
    str,
    typer.Option(
        "--joint",
        "--model",
        metavar="NAME",
        help=f"Model to start from: {', '.join(JOINTS)}, parameters as paper:stiffness=1.2; your own as "
        "FILE.py:NAME; or a saved MODEL.json.",
    ),
]
InputColumn = Annotated[
    str | None,
    typer.Option(
        "--input", metavar="COLUMN", help="Column of the motor voltage in volts, or of the goal of a servo."
    ),
]
OutputColumns = Annotated[
    list[str] | None,
    typer.Option(
        "--output",
        metavar="COLUMN",
        help="Column of theta, and once more for that of alpha; or CHANNEL=COLUMN.",
    ),
]
Degrees = Annotated[bool, typer.Option("--degrees", help="Angles in the files are in degrees.")]
SamplingPeriod = Annotated[
    float | None,
    typer.Option("--Ts", metavar="SECONDS", help="Sampling period, where no column has the time."),
]
TimeColumn = Annotated[
    str | None, typer.Option("--time", metavar="COLUMN", help="Column of the time in seconds.")
]
Counts = Annotated[
    list[str] | None,
    typer.Option(
        "--counts",
        metavar="NUMBER",
        help="Angles in the files are encoder counts, so many a turn; CHANNEL=NUMBER for one of them.",
    ),
]
ArmAbsolute = Annotated[
    bool,
    typer.Option("--arm-absolute", help="Alpha is the arm's angle in the room; theta is subtracted from it."),
]
TimeUnit = Annotated[
    str | None, typer.Option("--time-unit", metavar="UNIT", help="Unit of the time: s, ms or us.")
]
Resample = Annotated[
    str | None,
    typer.Option(
        "--resample", metavar="SECONDS", help="Bring uneven times on a grid of this period, or auto."
    ),
]
Intersample = Annotated[
    str,
    typer.Option(
        "--intersample",
        metavar="KIND",
        help="The input between its samples: held, or smooth where it was measured behind a low-pass filter.",
    ),
]
Accept = Annotated[
    list[str] | None,
    typer.Option("--accept", metavar="FAULT", help="Accept a named fault of the data, such as saturated."),
]
JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - means stdout."),
]
ModelFile = Annotated[
    Path | None,
    typer.Option("--save-model", metavar="FILE", help="Write the fitted model as JSON for later use."),
]
ReportFolder = Annotated[
    Path | None,
    typer.Option("--report", metavar="FOLDER", help="Write a self-contained HTML report here."),
]
HeldOut = Annotated[
    list[Path] | None,
    typer.Option("--held-out", metavar="FILE", help="Recording held out for validation; may be repeated."),
]
Test = Annotated[
    list[Path] | None,
    typer.Option(
        "--test", metavar="FILE", help="Recording that has no say, to report errors on; may be repeated."
    ),
]
Calibrate = Annotated[
    float,
    typer.Option(
        "--calibrate",
        metavar="SECONDS",
        min=0.0,
        help="Report errors also with the offsets of each unseen recording's own first SECONDS; 0: not.",
    ),
]
Continue = Annotated[
    Path | None,
    typer.Option(
        "--continue",
        metavar="FILE",
        help="Go on from NAME.stopped.json that a stopped search of the same files has left.",
    ),
]
Share = Annotated[
    float | None,
    typer.Option("--split", metavar="SHARE", help="Share of each FILE to fit, the rest is held out: 0.7."),
]
Each = Annotated[
    bool,
    typer.Option("--each", help="Search each FILE by itself, many at once; --report has the summary."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="With --each: Dask scheduler whose workers search."),
]
Workers = Annotated[
    int | None,
    typer.Option(metavar="COUNT", help="With --each: processes here; by cores and memory unless given."),
]

# rotflex compare
Methods = Annotated[str | None, typer.Option(metavar="A,B", help="Methods to compare; all unless given.")]
Quick = Annotated[bool, typer.Option("--quick", help="Only methods without a long search.")]

# rotflex effects
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]

# rotflex data
DataNames = Annotated[list[str], typer.Argument(metavar="NAME...", help="Names that `list` shows.")]

# rotflex simulate
OneFile = Annotated[Path, typer.Argument(metavar="FILE", help="Recording to simulate.")]
AddedEffects = Annotated[
    list[str] | None,
    typer.Option(metavar="EFFECT@PORT", help="Add an effect: coulomb@hub or coulomb@hub:level=0.03."),
]
FittedBefore = Annotated[
    list[Path] | None, typer.Option(metavar="FILE", help="Fit the model to this recording before.")
]
SimulationFile = Annotated[
    Path | None, typer.Option(metavar="CSV", help="Write what was measured and simulated.")
]

SimulationReport = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FOLDER",
        help="Write a page here: measured and simulated, errors, residual tests, frequency response.",
    ),
]

# rotflex export
ExportedModel = Annotated[
    str,
    typer.Argument(metavar="MODEL", help="File that --save-model has written, FILE.py:NAME, or a preset."),
]
ExportForm = Annotated[str, typer.Option("--to", metavar="FORM", help=f"One of {', '.join(EXPORT_FORMS)}.")]
ExportFile = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", help="Write here instead of to stdout.")
]
ExportPeriod = Annotated[
    float | None,
    typer.Option(
        "--Ts",
        metavar="SECONDS",
        help="Sampling period of the C code, of an FMU and of a simulator's certificate (that of the model's "
        "data unless given) or of a discrete state space (continuous unless given).",
    ),
]
Prefix = Annotated[
    str | None,
    typer.Option(
        "--prefix",
        metavar="NAME",
        help="What the names in the C code begin with: rotflex, those of a controller control, unless given.",
    ),
]
PendulumLength = Annotated[
    float, typer.Option("--length", metavar="M", help="Length of the servo's pendulum, for bam.")
]
ServoName = Annotated[str, typer.Option("--actuator", metavar="NAME", help="The servo's name in bam.")]
OwnEffects = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="FILE.py", help="Python file that registers effects of your own."),
]

# rotflex experiment
AmbiguousFiles = Annotated[
    list[Path] | None,
    typer.Option("--fit", metavar="FILE", help="Recording in which the two look alike; may be repeated."),
]
Between = Annotated[
    tuple[str, str] | None,
    typer.Option("--between", metavar="EFFECT@PORT EFFECT@PORT", help="The two: delay@input lag@input."),
]
Voltage = Annotated[
    float | None, typer.Option("--voltage", metavar="V", help="Largest voltage the amplifier gives.")
]
Played = Annotated[
    Path | None,
    typer.Argument(metavar="[RECORDING]", help="With --continue: what was recorded of the last voltage."),
]
Also = Annotated[
    list[str] | None,
    typer.Option("--or", metavar="EFFECT@PORT", help="With --state: a third possibility; may be repeated."),
]
State = Annotated[
    Path | None,
    typer.Option(
        "--state", metavar="JSON", help="Begin an experiment that stops by itself, and keep its state here."
    ),
]
GoOn = Annotated[
    Path | None,
    typer.Option(
        "--continue", metavar="JSON", help="Go on from this state with RECORDING: the next voltage."
    ),
]
ErrorProbability = Annotated[
    float, typer.Option("--error", metavar="SHARE", help="Probability of a wrong answer at which it stops.")
]
MostSeconds = Annotated[
    float, typer.Option("--max-seconds", metavar="SECONDS", help="Time on the rig at which it stops.")
]
Slew = Annotated[float, typer.Option("--slew", metavar="V/S", help="Fastest change of the voltage.")]
Travel = Annotated[float, typer.Option("--travel", metavar="DEG", help="Largest servo angle from the start.")]
Deflection = Annotated[
    float, typer.Option("--deflection", metavar="DEG", help="Largest deflection of the arm.")
]
Length = Annotated[float, typer.Option(metavar="SECONDS", help="Length of the experiment.")]
RankOnly = Annotated[bool, typer.Option("--rank-only", help="Rank the standard inputs, design none.")]
FoundBefore = Annotated[
    list[str] | None,
    typer.Option("--add", metavar="EFFECT@PORT", help="Effect that was found before; may be repeated."),
]
InputFile = Annotated[Path | None, typer.Option(metavar="CSV", help="Write the input: t,voltage.")]
PlotFile = Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the input and what it shows.")]

# rotflex reproduce
PaperData = Annotated[
    list[str] | None,
    typer.Option(
        "--data",
        metavar="FILE",
        help="Recording to fit instead of a simulation, or the data set rotflex; may be repeated.",
    ),
]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a setting; --list names them; may be repeated."),
]
PageFolder = Annotated[
    Path, typer.Option("--out", metavar="FOLDER", help="Write the figures and the page here.")
]
ListSettings = Annotated[bool, typer.Option("--list", help="List all settings with their reasons, and stop.")]
Scenario = Annotated[str | None, typer.Option(metavar="NAME", help="Simulated machine: S0 to S7, S5s, S5p.")]
Seed = Annotated[int | None, typer.Option(metavar="NUMBER", help="Of the random numbers.")]
GreyBox = Annotated[
    bool, typer.Option("--grey-box", help="Fit the equations with friction too; takes a minute.")
]


# rotflex arena
ArenaMethods = Annotated[
    list[str] | None,
    typer.Argument(metavar="FILE.py:FUNCTION...", help="Your methods: function(train, validation, model)."),
]
Entrants = Annotated[
    str | None,
    typer.Option(metavar="A,B", help="Methods that come with the arena, as search,refit_bic; all for all."),
]
Records = Annotated[int, typer.Option(metavar="COUNT", help="How many simulated records.")]
ArenaSeed = Annotated[
    int | None,
    typer.Option("--seed", metavar="NUMBER", help="What the records are drawn from; drawn unless given."),
]
RecordSeconds = Annotated[float, typer.Option("--seconds", metavar="SECONDS", help="Length of a record.")]
AnswerLimit = Annotated[float, typer.Option("--limit", metavar="SECONDS", help="Most time for an answer.")]
WithMeasured = Annotated[
    bool, typer.Option("--measured", help="Free runs on public recordings too, where they are here.")
]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="FILE", help="Write a self-contained HTML page here.")
]


# Joints that can have one sensor alone.
ONE_SENSOR = ("paper", "quanser_2002", "quanser_2010")

# Substeps within which a smooth input is followed.
SMOOTH_SUBSTEPS = 4


@dataclasses.dataclass(frozen=True)
class Columns:
    """How to read a recording: the options that all commands with files share, see `reads_files`."""

    input: InputColumn = None
    outputs: OutputColumns = None
    degrees: Degrees = False
    Ts: SamplingPeriod = None
    time: TimeColumn = None
    accept: Accept = None
    counts: Counts = None
    arm_absolute: ArmAbsolute = False
    time_unit: TimeUnit = None
    resample: Resample = None
    intersample: Intersample = "held"
    mechanism: Any = None  # whose channels are read where the options name none

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

    def of(self, model: "Model") -> "tuple[Model, Columns]":
        """The model with the input between its samples as it was given, and how to read its recordings."""
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
        return model, dataclasses.replace(self, mechanism=model.mechanism)

    def load(self, file: Path) -> "Recording":
        """The recording in a file."""
        if not file.exists():
            raise InputError(f"{file} does not exist; give the path of a recording.")
        from rotflex_jax.data import load

        try:
            recording = load(file, **self.reading())
        except InputError as error:
            raise InputError(as_options(str(error))) from None
        driven = "" if self.mechanism is None else self.mechanism.units.input
        if driven and recording.input_unit != driven and "units" not in recording.accept:
            raise InputError(
                f"{recording.source}: the input {recording.input_name!r} is in {recording.input_unit}, but "
                f"the model is driven in {driven}; name the column of that with --input, give a model with "
                "such an input (--model FILE.py:NAME, for a current one with CurrentDrive), or "
                "--accept units."
            )
        return recording

    def reading(self) -> dict[str, Any]:
        """The same as arguments of `rotflex_jax.load`."""
        from rotflex_jax.mechanism.linear import output_units

        units = {} if self.mechanism is None else output_units(self.mechanism)
        channels = _channels(self.outputs or (), tuple(units))
        if self.mechanism is not None and self.mechanism.units.input != "V":
            units |= {self.input or "voltage": self.mechanism.units.input}
        return {
            "input": self.input,
            "outputs": channels,
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
        """The one sensor of a joint that the options name, or that a file has; None where it is not one."""
        from rotflex_jax.data.files import OTHER_NAMES, read_table
        from rotflex_jax.joints.rotary_flexible import SENSORS

        if self.outputs:
            found = [text.partition("=")[0] for text in self.outputs]
            return found[0] if len(found) == 1 and found[0] in SENSORS else None
        try:
            table = read_table(file)
        except (InputError, OSError):
            return None  # whoever loads it says why
        found = [c for c in SENSORS if table.find(c, *OTHER_NAMES.get(c, ())) in table.columns]
        return found[0] if found and (len(found) == 1 or "alpha" not in found) else None

    def load_all(self, files: Sequence[Path]) -> "list[Recording]":
        """The recordings in files, and those of public data sets that are named in the place of a file."""
        found: list[Recording] = []
        for file in files:
            if public_name(file) is None:
                found.append(self.load(file))
                continue
            if dataclasses.replace(self, mechanism=None, intersample="held", accept=None) != Columns():
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
        """Recordings to fit and held-out ones: files of their own, or the end of each file."""
        train = self.load_all(files)
        if held_out:
            return train, self.load_all(held_out)
        parts = [recording.split(share) for recording in train]
        return [a for a, _ in parts], [b for _, b in parts]


Command = Callable[..., None]


def reads_files(command: Command) -> Command:
    """A command whose argument `columns` is made of the options that say how files are read."""
    options = {f.name: f for f in dataclasses.fields(Columns) if f.name != "mechanism"}
    types = {name: f.type for name, f in options.items()}

    @functools.wraps(command)
    def inside(**arguments: Any) -> None:
        command(columns=Columns(**{name: arguments.pop(name) for name in options}), **arguments)

    own = inspect.signature(command, eval_str=True)
    before = [p for p in own.parameters.values() if p.name != "columns"]
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
        for name, f in options.items()
    ]
    listed = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in before] + added
    inside.__signature__ = own.replace(parameters=listed)  # pyright: ignore[reportAttributeAccessIssue]
    inside.__annotations__ = {p.name: p.annotation for p in before} | types | {"return": None}
    del inside.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]
    return inside


def was_given(context: typer.Context, name: str) -> bool:
    """Whether an option was written on the command line, and not left at its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


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
    """Seconds, or the word auto."""
    if text in (None, "auto"):
        return text
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--resample was given {text!r}, but needs a sampling period in seconds, or auto; give for "
            "instance --resample 0.002."
        ) from None


def _channels(outputs: Sequence[str], model: Sequence[str]) -> Sequence[str] | Mapping[str, str] | None:
    """`theta=servo` names the channel too; plain column names come in the order of the model's channels."""
    if outputs and all("=" in text for text in outputs):
        return dict(text.split("=", 1) for text in outputs)
    if not outputs and model:
        return dict(zip(model, model, strict=True))
    named = model and len(outputs) == len(model)
    return dict(zip(model, outputs, strict=True)) if named else outputs or None


def as_options(sentence: str) -> str:
    """A sentence about arguments of `rotflex_jax.load`, in terms of the options of the command line."""
    sentence = re.sub(r"accept=\('(\w+)',\)", r"--accept \1", sentence)
    sentence = sentence.replace("degrees=True", "--degrees").replace("degrees=False", "no --degrees")
    sentence = sentence.replace("arm_absolute=True", "--arm-absolute")
    sentence = re.sub(r"\btime_unit='(\w+)'", r"--time-unit \1", sentence)
    sentence = re.sub(r"\bresample='?(\w+)'?", r"--resample \1", sentence)
    sentence = re.sub(r"\bcounts=\{'(\w+)': (\d+)\}", r"--counts \1=\2", sentence)
    sentence = re.sub(r"\b(input|time|Ts|counts)=(?=\d)", r"--\1 ", sentence)
    sentence = re.sub(r"\b(input|time|Ts)=", r"--\1", sentence)
    sentence = re.sub(r"\boutputs=|Argument `outputs`", "--output", sentence)
    return re.sub(r"Argument `(\w+)`", lambda m: "--" + m[1].replace("_", "-"), sentence)


def public_name(file: Path) -> str | None:
    """The name of a public data set that is given in the place of a file; None where there is such a file."""
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


def joint_for(files: Sequence[Path], joint: str, columns: Columns) -> str:
    """The joint that was given, or that of the public data set where all files are its name.

    A joint of which the files have one sensor alone becomes one with that sensor.
    """
    from rotflex_jax.data.registry import DATASETS

    names = {public_name(file) for file in files}
    name = names.pop() if len(names) == 1 else None
    if name is not None:
        return DATASETS[name].joint if joint == "paper" else joint
    sensor = columns.sensor_alone(files[0])
    if sensor is None or joint.partition(":")[0] not in ONE_SENSOR or "sensors=" in joint:
        return joint
    return f"{joint}{',' if ':' in joint else ':'}sensors={sensor}"


def check_distinct(files: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Refuse a file that is given twice: the error on data that were fitted proves nothing."""
    seen: dict[str, Path] = {}
    for file in (*files, *held_out):
        place = os.path.realpath(file)  # also where links go round in a circle
        if place in seen:
            raise InputError(
                f"{file} was given twice, but a recording must not count twice nor be both fitted "
                "and held out; name each file once."
            )
        seen[place] = file


def check_split(split: float | None, held_out: Sequence[Path]) -> float:
    """The share of each file to fit."""
    if split is None:
        return 0.7
    if held_out:
        raise InputError(
            "--split and --held-out were both given, but the held-out data are either the end of "
            "each FILE or files of their own; give one of the two."
        )
    if not 0 < split < 1:
        raise InputError(
            f"--split was given {split:g}, but it is the share of each FILE to fit and must "
            "lie between 0 and 1; give for instance --split 0.7."
        )
    return split


def check_writable(*, json_file: Path | None = None, folder: Path | None = None) -> None:
    """Refuse a place that nothing can be written to, while nothing has been computed yet."""
    if json_file not in (None, STDOUT):
        if json_file.is_dir():
            raise InputError(f"{json_file} is a folder, but a file is written; name the file.")
        if not json_file.absolute().parent.is_dir():
            raise InputError(
                f"{json_file} cannot be written, since the folder {json_file.parent} does not "
                "exist; create it or name another."
            )
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, but the report needs a folder; name another.")
