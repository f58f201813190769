from . import (
    adaptive as adaptive,
    arena as arena,
    basis as basis,
    control as control,
    data as data,
    effects as effects,
    export as export,
    joints as joints,
    kernels as kernels,
    metrics as metrics,
)
from .batch import Fleet as Fleet, fleet as fleet
from .compare import Comparison as Comparison, compare as compare
from .control import Controller as Controller, assess as assess, controller as controller
from .data import load as load
from .discover import (
    Discovery as Discovery,
    LearnedTorqueResult as LearnedTorqueResult,
    discover as discover,
    learn_torque as learn_torque,
    locate as locate,
)
from .errors import InputError as InputError
from .experiment import (
    CallbackRig as CallbackRig,
    Experiment as Experiment,
    FileRig as FileRig,
    Limits as Limits,
    Rig as Rig,
    Segment as Segment,
    SequentialResult as SequentialResult,
    SimulatedRig as SimulatedRig,
    experiment_until as experiment_until,
    next_experiment as next_experiment,
)
from .fit import (
    Bands as Bands,
    Fit as Fit,
    Identifiability as Identifiability,
    ManyStarts as ManyStarts,
    Profile as Profile,
    SeriesFit as SeriesFit,
    fit as fit,
    forward_regression as forward_regression,
    identifiable as identifiable,
    least_squares as least_squares,
    many_starts as many_starts,
    prediction_bands as prediction_bands,
    profile as profile,
)
from .joints import load_mjcf as load_mjcf
from .latent import LatentTorque as LatentTorque, latent_torque as latent_torque
from .mechanism import (
    Exponential as Exponential,
    Mechanism as Mechanism,
    SmoothRK4 as SmoothRK4,
    linearise as linearise,
    simulate as simulate,
)
from .models.comparison import compare_plot as compare_plot
from .models.model import Model as Model
from .models.series import Series as Series
from .notebook import explore as explore, live as live
from .recording import Recording as Recording
from .runtime.persistent_jit import performance as performance
from .runtime.program_files import keep_programs as keep_programs
from .runtime.xla import (
    enable_compilation_cache as enable_compilation_cache,
    enable_fast_loops as enable_fast_loops,
)

__version__: str
__all__: list[str]
