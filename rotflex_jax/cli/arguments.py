"""Every option of the command line with its help, and the checks that several commands share."""

import contextlib
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rotflex_jax.errors import InputError
from rotflex_jax.joints.by_name import JOINTS
from rotflex_jax.text.files import without_folder

STDOUT = Path("-")
SIMULATORS = ("mjcf", "urdf", "fmu", "bam")
EXPORT_FORMS = ("c", "latex", "text", "statespace", "controller", *SIMULATORS)

Files = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        help="Recordings: .csv, .tsv, .xlsx, .json, .mat, .npz, .parquet, .tdms, .mf4, .mcap; a folder with "
        "a file for each channel; or rotflex, the public data set.",
    ),
]
JointNames = Annotated[
    list[str] | None,
    typer.Option(
        "--joint",
        "--model",
        metavar="NAME",
        help=f"Model to start from: {', '.join(JOINTS)} (paper unless given), parameters as "
        "paper:stiffness=1.2; your own as FILE.py:NAME; or a saved MODEL.json.",
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
        help="Column of theta, and once more for that of alpha; or CHANNEL=COLUMN, CHANNEL [UNIT]=COLUMN.",
    ),
]
Signals = Annotated[
    list[str] | None,
    typer.Option(
        "--signal",
        metavar="COLUMN",
        help="Column of what else was measured that acts on the machine, such as the acceleration of its "
        "base; or NAME [UNIT]=COLUMN; may be repeated.",
    ),
]
Degrees = Annotated[
    bool,
    typer.Option(
        "--degrees", help='All angles are in degrees; for one of them, --output "CHANNEL [UNIT]=COLUMN".'
    ),
]
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
        "--counts-per-turn",
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
Substeps = Annotated[
    int | None,
    typer.Option(
        "--substeps",
        metavar="NUMBER",
        help="Steps of integration in each sample; 4 where friction stops the machine within a sample.",
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
HeldOutForErrors = Annotated[
    list[Path] | None,
    typer.Option("--held-out", metavar="FILE", help="Recording for the errors only; may be repeated."),
]
Test = Annotated[
    list[Path] | None,
    typer.Option(
        "--test",
        metavar="FILE",
        help="Test recording to report errors on, used for no fit and no choice; may be repeated.",
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
ControlledPort = Annotated[
    str, typer.Option("--port", metavar="PORT", help="Port whose position a controller moves.")
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
Travel = Annotated[
    float,
    typer.Option(
        "--travel", metavar="DEG", help="Largest servo angle from the start, in mm if the machine slides."
    ),
]
Deflection = Annotated[
    float, typer.Option("--deflection", metavar="DEG", help="Largest deflection of the arm, likewise.")
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


def was_given(context: typer.Context, name: str) -> bool:
    """Whether an option was written on the command line, and not left at its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name != "DEFAULT"


def one_model(given: Sequence[str] | None) -> str:
    """The model that --joint and --model, two names of one option, give.

    Raises:
        InputError: They give several.
    """
    if not given:
        return "paper"
    if len(set(given)) > 1:
        raise InputError(
            f"{' and '.join(dict.fromkeys(given))} were given with --joint or --model, two names of one "
            "option, but there is one model; give one of them."
        )
    return given[0]


def as_options(sentence: str) -> str:
    """A sentence about arguments in Python, in terms of the options of the command line.

    It reads names of arguments and calls as Python writes them, and no other words of a sentence.
    """
    sentence = re.sub(r"accept=\('(\w+)',\)", r"--accept \1", sentence)
    sentence = sentence.replace("degrees=True", "--degrees")
    sentence = re.sub(r"\bunits=\{'(\w+)': '([^']+)'\}", r'--output "\1 [\2]=COLUMN"', sentence)
    sentence = sentence.replace("arm_absolute=True", "--arm-absolute")
    sentence = re.sub(r"\btime_unit='(\w+)'", r"--time-unit \1", sentence)
    sentence = re.sub(r"\btime_unit=(?!')", "--time-unit", sentence)
    sentence = re.sub(r"\bresample='?(\w+)'?", r"--resample \1", sentence)
    sentence = re.sub(r"\bcounts=\{'(\w+)': (\d+)\}", r"--counts \1=\2", sentence)
    sentence = re.sub(r"\bSettings\((\w+=[^()]+)\)", r"--set \1", sentence)
    sentence = re.sub(r"(?<!--set )\b(input|time|Ts|counts|seconds)=(?=\d)", r"--\1 ", sentence)
    sentence = re.sub(r"\boutputs=\{'(\w+)': 'COLUMN'\}", r"--output \1=COLUMN", sentence)
    sentence = sentence.replace("import the module that registers it first", "name its file, --with FILE.py")
    sentence = re.sub(r"\bsignals=\{'([^']+)': 'COLUMN'\}", r'--signal "\1=COLUMN"', sentence)
    sentence = sentence.replace("model.with_values({...})", "--joint paper:stiffness=1.2")
    sentence = re.sub(r"(?<!--set )\b(input|time|Ts)=", r"--\1", sentence)
    sentence = re.sub(r"\boutputs=|Argument `outputs`", "--output", sentence)
    sentence = re.sub(r"\bsignals=|Argument `signals`", "--signal", sentence)
    sentence = re.sub(r"a mapping such as \{'([^']+)': '(\w+)'\}", r'for instance "\1=\2"', sentence)
    return re.sub(r"Argument `(\w+)`", lambda m: "--" + m[1].replace("_", "-"), sentence)


def check_distinct(files: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Refuse a file that is given twice: the error on data that were fitted proves nothing."""
    seen: dict[str, Path] = {}
    for file in (*files, *held_out):
        place = os.path.realpath(file)  # works also if links form a cycle
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


def check_writable(
    *files: Path | None,
    or_stdout: Path | None = None,
    folder: Path | None = None,
    read: Sequence[Path] = (),
) -> None:
    """Refuse outputs that cannot be written or would replace another file, before anything is computed.

    Args:
        files: Output files.
        or_stdout: Output file that may be `STDOUT`.
        folder: Output folder.
        read: Files that the command reads.
    """
    if STDOUT in files:
        raise InputError("A file was given as -, but only --json goes to stdout; name the file.")
    taken = {os.path.realpath(file) for file in read}
    for file in (*files, or_stdout):
        if file in (None, STDOUT):
            continue
        if (place := os.path.realpath(file)) in taken:
            raise InputError(
                f"An output would be written over {file}, which this command reads or writes already; name "
                "another file for it."
            )
        taken.add(place)
        if file.is_dir():
            raise InputError(f"{file} is a folder, but a file is written; name the file.")
        if not file.absolute().parent.is_dir():
            raise without_folder(file)
    if folder is not None:
        _check_folder(folder)


def _check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be created or written to; folders created for this test are removed."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, but the report needs a folder; name another.")
    place = folder.absolute()
    missing = [part for part in (place, *place.parents) if not part.exists()]
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written to ({error.strerror or error}), but the report needs a folder of "
            "its own; name another."
        ) from error
    finally:
        for part in missing:
            with contextlib.suppress(OSError):
                part.rmdir()
