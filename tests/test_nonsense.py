"""Invalid arguments of public functions: each is refused with one sentence before any computation."""

import inspect
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import rotflex_jax as rf
from rotflex_jax import adaptive, basis, checks, control, export, joints, kernels, metrics
from rotflex_jax.data import excitation, save_csv
from rotflex_jax.discover.probabilities import Probabilities
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording.recording import SHORTEST_TO_FIT
from rotflex_jax.runtime import xla

NAN, INF = math.nan, math.inf
N = 200
U = excitation.noise(N, 0.002, seed=8)
JOINT = joints.paper()
Y = rf.simulate(JOINT, U, 0.002) + 1e-4 * np.random.default_rng(0).normal(size=(N, 2))
RUN = rf.Recording(u=U, y=Y, Ts=0.002)
A, B = RUN.split(0.7)
MODEL = Model(JOINT)
FRAME = pd.DataFrame({"t": 0.002 * np.arange(N), "voltage": U, "theta": Y[:, 0], "alpha": Y[:, 1]})
SERIES = basis.Volterra(basis.Delays(3))
LIMITS = rf.Limits(voltage=5.0)
CONTROLLER = rf.controller(JOINT, 0.002)
NOISE = {"theta": 1e-3, "alpha": 1e-3}
FITTED = rf.Fit(MODEL, 0.0, "converged", (), NOISE, 1e-9 * np.eye(5), JOINT.free_names, 1)
AT_REST = rf.Recording(
    u=U, y=np.column_stack([Y[:, 0], np.zeros(N)]), Ts=0.002, accept=("constant", "saturated")
)


def refused(call: Callable[[], object], phrase: str) -> None:
    """The call raises `InputError` with one sentence that matches the phrase and contains no Python."""
    with pytest.raises(InputError) as caught:
        call()
    sentence = str(caught.value)
    assert re.search(phrase, sentence), sentence
    assert sentence[-1] in ".?" and "\n" not in sentence and len(sentence) < 400, sentence
    assert not re.search("[.!] [A-Z]|np[.]|dtype|array\\(|object at 0x", sentence), sentence


# Each function with valid arguments; a test replaces one of them by an invalid value of `BAD`.
FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "fit": (rf.fit, {"mechanism": JOINT, "recordings": RUN}),
    "many_starts": (rf.many_starts, {"mechanism": JOINT, "recordings": RUN}),
    "profile": (rf.profile, {"fitted": FITTED, "recordings": RUN, "of": "hub.inertia.inertia"}),
    "identifiable": (rf.identifiable, {"mechanism": JOINT, "recording": RUN}),
    "prediction_bands": (rf.prediction_bands, {"fitted": FITTED, "recording": RUN}),
    "discover": (rf.discover, {"mechanism": JOINT, "train": A, "validation": B}),
    "learn_torque": (rf.learn_torque, {"model": JOINT, "train": A, "validation": B}),
    "latent_torque": (rf.latent_torque, {"model": JOINT, "recordings": RUN}),
    "compare": (rf.compare, {"recordings": RUN, "methods": ["arx"]}),
    "least_squares": (rf.least_squares, {"basis": SERIES, "recordings": RUN, "channel": "theta"}),
    "forward_regression": (rf.forward_regression, {"basis": SERIES, "recordings": RUN, "channel": "theta"}),
    "simulate": (rf.simulate, {"mechanism": JOINT, "u": U, "Ts": 0.002}),
    "linearise": (rf.linearise, {"mechanism": JOINT}),
    "keep_programs": (rf.keep_programs, {"folder": True}),
    "compare_plot": (
        lambda recording, model, **options: rf.compare_plot(recording, model, **options),
        {"recording": RUN, "model": JOINT},
    ),
    "locate": (
        rf.locate,
        {"recording": RUN, "residual": Y, "channels": ("theta", "alpha"), "noise": [1e-3, 1e-3]},
    ),
    "next_experiment": (
        rf.next_experiment,
        {"model": JOINT, "a": "coulomb@hub", "b": "delay@input", "limits": LIMITS, "noise": NOISE},
    ),
    "experiment_until": (
        rf.experiment_until,
        {
            "models": [JOINT, JOINT + rf.effects.Delay()],
            "rig": rf.CallbackRig(lambda u: np.zeros((len(u), 2)), LIMITS, 0.002),
            "noise": NOISE,
        },
    ),
    "CallbackRig": (rf.CallbackRig, {"function": np.sin, "limits": LIMITS, "Ts": 0.002}),
    "fleet": (rf.fleet, {"mechanism": JOINT, "recordings": [RUN], "folder": "never-made", "workers": 0}),
    "arena.score": (rf.arena.score, {"methods": "search"}),
    "load": (rf.load, {"source": "no-such.csv"}),
    "load, from a frame": (rf.load, {"source": FRAME, "outputs": ["theta", "alpha"]}),
    "load, resampled": (rf.load, {"source": FRAME, "outputs": ["theta", "alpha"], "resample": "auto"}),
    "enable_fast_loops": (xla.enable_fast_loops, {}),
    "enable_compilation_cache": (xla.enable_compilation_cache, {}),
    "explore": (rf.explore, {"model": MODEL, "recordings": RUN}),
    "Limits": (rf.Limits, {"voltage": 5.0}),
    "Exponential": (rf.Exponential, {}),
    "SmoothRK4": (rf.SmoothRK4, {}),
    "Mechanism": (
        rf.Mechanism,
        {"coordinates": ("a",), "ports": {"p": (1,)}, "effects": (), "outputs": {"a": "p"}},
    ),
    "Model": (Model, {"mechanism": JOINT}),
    "Recording": (rf.Recording, {"u": U, "y": Y, "Ts": 0.002}),
    "Recording.split": (RUN.split, {}),
    "Recording.decimate": (RUN.decimate, {"k": 2}),
    "Recording.slice": (RUN.slice, {"i": 0, "j": 60}),
    "Model.simulate": (MODEL.simulate, {"recording": RUN}),
    "Model.simulate_states": (MODEL.simulate_states, {"recording": RUN}),
    "Model.simulate_windows": (MODEL.simulate_windows, {"recording": RUN}),
    "Model.behind_actuation": (MODEL.behind_actuation, {"recording": RUN}),
    "Model.inputs": (MODEL.inputs, {"recording": RUN}),
    "Model.at": (MODEL.at, {"recording": RUN}),
    "Model.predict": (
        MODEL.predict,
        {"recording": RUN, "process_noise": {"hub": 1e-6}, "noise": [1e-3, 1e-3]},
    ),
    "Model.save": (MODEL.save, {"path": "never-made"}),
    "Mechanism.with_values": (JOINT.with_values, {}),
    "controller": (rf.controller, {"model": JOINT, "Ts": 0.002}),
    "Controller.plan": (CONTROLLER.plan, {"reference": np.zeros(50)}),
    "close_loop": (
        control.close_loop,
        {"controller": CONTROLLER, "plant": JOINT, "reference": np.zeros(50)},
    ),
    "assess": (rf.assess, {"controller": CONTROLLER, "models": [JOINT], "reference": np.zeros(50)}),
    "credible_models": (control.credible_models, {"fit": None}),
    "controller_to_c": (control.controller_to_c, {"controller": CONTROLLER}),
    "export.to_c": (export.to_c, {"model": JOINT, "Ts": 0.002}),
    "export.latex": (export.latex, {"model": JOINT}),
    "export.text": (export.text, {"model": JOINT}),
    "export.state_space": (export.state_space, {"model": JOINT}),
    "export.to_mjcf": (export.to_mjcf, {"model": JOINT, "Ts": 0.002}),
    "export.to_urdf": (export.to_urdf, {"model": JOINT, "Ts": 0.002}),
    "export.to_fmu": (export.to_fmu, {"model": JOINT, "Ts": 0.002}),
    "export.to_bam": (export.to_bam, {"model": joints.xl330_pendulum(), "Ts": 0.005}),
    "load_mjcf": (rf.load_mjcf, {"path": "no-such.xml"}),
    "export.save": (export.save, {"path": "never-made"}),
    "export.read": (export.read, {}),
    "kernels.local_kernels": (
        kernels.local_kernels,
        {"model": JOINT, "Ts": 0.002, "channel": "theta", "memory": 5},
    ),
    "kernels.average_kernels": (
        kernels.average_kernels,
        {"model": JOINT, "data": RUN, "channel": "theta", "memory": 5},
    ),
    "adaptive.identify": (
        adaptive.identify,
        {"filter": adaptive.LMS(0.1), "basis": SERIES, "recording": RUN, "channel": "theta"},
    ),
    "basis.Delays": (basis.Delays, {"memory": 3}),
    "basis.Volterra": (basis.Volterra, {"bank": basis.Delays(3)}),
    "Probabilities.credible": (Probabilities((), {}, 0.1).credible, {}),
    "save_csv": (save_csv, {"recording": RUN, "path": "never-made"}),
    "metrics.rmse": (metrics.rmse, {"y": Y, "y_hat": Y}),
    "joints.paper": (joints.paper, {}),
    "joints.quanser_2010": (joints.quanser_2010, {}),
    "joints.servo": (joints.servo, {}),
    "joints.flexible_joint": (
        joints.flexible_joint,
        {"hub_inertia": 0.002, "arm_inertia": 0.006, "stiffness": 1.6, "motor": rf.effects.Motor("hub")},
    ),
    "joints.flexible_link": (joints.flexible_link, {}),
    "joints.single_inertia": (joints.single_inertia, {}),
    "joints.position_servo": (joints.position_servo, {}),
    "joints.xl330_pendulum": (joints.xl330_pendulum, {}),
    "LoadFriction": (rf.effects.LoadFriction, {"at": "hub"}),
    "noise": (excitation.noise, {"N": 100, "Ts": 0.01}),
    "multisine": (excitation.multisine, {"N": 100, "Ts": 0.01}),
    "prbs": (excitation.prbs, {"N": 100, "Ts": 0.01}),
    "steps": (excitation.steps, {"N": 100, "Ts": 0.01}),
    "sweep": (excitation.sweep, {"N": 100, "Ts": 0.01}),
    "pulse": (excitation.pulse, {"N": 100, "Ts": 0.01}),
}

NO_MODEL = [(None, "None was given"), ("paper", "'paper' was given"), (RUN, "a Recording was given")]
NO_RECORDINGS = [
    (None, "is None; read a file"),
    ("run.csv", r"is 'run\.csv'; read a file with rotflex_jax\.load"),
    (3, "is 3; read a file"),
    ([], "No recording was given"),
    ([RUN, None], "has None as entry 2"),
    (np.array(None), "is an? ndarray; read a file"),
    ([Path("a.csv"), RUN], "has a PosixPath as entry 1"),
    (U, "as entry 1"),
]
TOO_SHORT = [(RUN.slice(0, 2), f"has 2 samples, but at least {SHORTEST_TO_FIT} are needed")]
NO_SECONDS = [(0, "above 0.*is 0;"), (NAN, "is nan"), (INF, "is inf"), (-1.0, "is -1.0"), ("2", "is '2'")]
NO_PROGRESS = [(3, "`progress` must be a function .* but is 3")]
PROCESS_NOISE = [
    ({"hub": -1}, r"`process_noise\['hub'\]` must be a finite number from 0, but is -1"),
    ({"hub": NAN}, "is nan"),
    ({"hub": "much"}, "is 'much'"),
    ({"x": 1.0}, "given at 'x', but the mechanism has the ports hub, joint, arm"),
    (["hub"], "an intensity for each port, but is a list"),
    (1e-6, "but is 1e-06"),
]
NO_NUMBER = [(NAN, "nan"), ("a", "'a'"), (None, "None")]
NO_COUNT = [(0.5, ""), (True, ""), ("many", ""), (NAN, ""), ([1], "")]
COUNTS = [(0, "is 0"), (1.5, "is 1.5"), (NAN, "is nan"), (-1, "is -1"), ("many", "is 'many'")]
COUNTS += [(1e308, "from [0-9]+ to 2.14748e[+]09, but is 1e[+]308")]
NO_DEVICES = [(True, "a list of devices, but is True"), ("cpu", "but is 'cpu'"), ([1], "but is a list")]

BAD: dict[tuple[str, str], list[tuple[Any, str]]] = {
    ("fit", "mechanism"): NO_MODEL,
    ("fit", "recordings"): [*NO_RECORDINGS, *TOO_SHORT, (AT_REST, "'alpha' has one value throughout")],
    ("fit", "process_noise"): PROCESS_NOISE,
    ("fit", "first"): [("x", "one of 'fitted', 'measured', but is 'x'"), (None, "is None")],
    ("fit", "max_steps"): COUNTS,
    ("fit", "window_seconds"): NO_SECONDS,
    ("fit", "robust"): NO_SECONDS,
    ("fit", "local"): [
        (("x",), "'x' was to be local"),
        ("hub.inertia.inertia", "list of names"),
        (3, "is 3"),
        (np.array(None), "is an? ndarray"),
    ],
    ("fit", "throw"): [(np.zeros(2), "True or False, but is an? ndarray"), (1, "but is 1")],
    ("fit", "devices"): NO_DEVICES,
    ("many_starts", "devices"): NO_DEVICES,
    ("fit", "minimiser"): [(3, "a solver of optimistix, but is 3")],
    ("fit", "progress"): NO_PROGRESS,
    ("many_starts", "mechanism"): NO_MODEL,
    ("many_starts", "recordings"): [*NO_RECORDINGS, *TOO_SHORT, (AT_REST, "one value throughout")],
    ("many_starts", "starts"): COUNTS,
    ("many_starts", "keep"): COUNTS,
    ("many_starts", "max_steps"): COUNTS,
    ("many_starts", "spread"): [
        (NAN, "is nan"),
        (0, "is 0"),
        (1, "below 1, but is 1"),
        ("wide", "is 'wide'"),
    ],
    ("many_starts", "short_seconds"): NO_SECONDS,
    ("many_starts", "seed"): [(-1, "is -1"), (1.5, "is 1.5"), ("a", "is 'a'")],
    ("many_starts", "progress"): NO_PROGRESS,
    ("profile", "fitted"): [
        (None, "fit is needed, but None was given"),
        (JOINT, "a Mechanism was given; give what"),
        ("paper", "'paper' was given"),
    ],
    ("profile", "recordings"): [*NO_RECORDINGS, *TOO_SHORT, (AT_REST, "one value throughout")],
    ("profile", "of"): [
        ("x", "'x' was to be profiled, but the free parameters of the fit are hub.inertia.inertia"),
        ("arm.inertia.inertia", "name one of these"),
        (3, "a function of the values by name, but is 3"),
        (None, "but is None"),
        (lambda values: values["x"], "failed with KeyError"),
        (lambda values: "a", "gives nan at the fit"),
    ],
    ("profile", "level"): [(NAN, "is nan"), (0, "above 0"), (1, "below 1, but is 1"), ("high", "is 'high'")],
    ("identifiable", "mechanism"): [
        *NO_MODEL,
        (JOINT.trust(*JOINT.parameter_names), "All parameters are trusted"),
    ],
    ("identifiable", "recording"): [*NO_RECORDINGS[1:4], *TOO_SHORT, (AT_REST, "one value throughout")],
    ("prediction_bands", "fitted"): [
        (None, "fit and its weight, is needed, but None was given"),
        (MODEL, "a Model was given"),
        ([], "a list was given"),
        ([(MODEL, 1.0)], "a list was given"),
        ([(FITTED, 0)], "above 0, but is 0"),
        ([(FITTED, NAN)], "is nan"),
    ],
    ("prediction_bands", "recording"): [*NO_RECORDINGS[:3], *TOO_SHORT],
    ("prediction_bands", "level"): [(NAN, "is nan"), (0, "above 0"), (1, "below 1"), (None, "is None")],
    ("prediction_bands", "known"): [*NO_RECORDINGS[:3], *TOO_SHORT],
    ("discover", "mechanism"): NO_MODEL,
    ("discover", "train"): [*NO_RECORDINGS, *TOO_SHORT, (AT_REST, "alpha")],
    ("discover", "validation"): [*NO_RECORDINGS[1:3], *NO_RECORDINGS[4:], *TOO_SHORT],
    ("discover", "test"): [*NO_RECORDINGS[1:3], *NO_RECORDINGS[4:], *TOO_SHORT],
    ("discover", "candidates"): [
        (
            [(rf.effects.Coulomb, "nowhere")],
            "Coulomb is to be tried at 'nowhere', but .* 'hub', 'joint'",
        ),
        ([(rf.effects.SensorBias, "hub")], "SensorBias .* at 'hub', but .*'theta', 'alpha'"),
        ([("coulomb", "hub")], "pairs of an effect's class and a port, but has a tuple"),
        ("coulomb", "but has 'coulomb'"),
        ([rf.effects.Coulomb], "has the class Coulomb"),
        (3, "has 3"),
    ],
    ("discover", "rounds"): [(-1, "is -1"), (1.5, "is 1.5"), (NAN, "is nan"), ("all", "is 'all'")],
    ("discover", "window_seconds"): NO_SECONDS,
    ("discover", "calibrate_seconds"): [(-1, "is -1"), (NAN, "is nan"), (INF, "is inf"), (None, "is None")],
    ("discover", "resume"): [(3, "path of a file is needed, but 3"), ("no.json", "cannot be read")],
    ("discover", "progress"): NO_PROGRESS,
    ("learn_torque", "model"): NO_MODEL,
    ("learn_torque", "train"): [*NO_RECORDINGS, *TOO_SHORT],
    ("learn_torque", "validation"): [*NO_RECORDINGS, *TOO_SHORT],
    ("learn_torque", "at"): [("x", "'x' was asked for"), (3, "3 was asked for")],
    ("learn_torque", "window_seconds"): NO_SECONDS,
    ("learn_torque", "progress"): NO_PROGRESS,
    ("latent_torque", "model"): NO_MODEL,
    ("latent_torque", "recordings"): [*NO_RECORDINGS, *TOO_SHORT, (AT_REST, "one value throughout")],
    ("latent_torque", "ports"): [(["x"], "'x' was asked for"), (3, "a list of names, but is 3")],
    ("latent_torque", "progress"): NO_PROGRESS,
    ("compare", "recordings"): [*NO_RECORDINGS, *TOO_SHORT],
    ("compare", "methods"): [(3, "a list of methods, but is 3")],
    ("compare", "mechanism"): NO_MODEL[1:],
    ("compare", "test"): [*NO_RECORDINGS[1:], *TOO_SHORT],
    ("compare", "fraction"): [(NAN, "is nan"), ("a", "is 'a'"), (2, "would have 400 of 200")],
    ("compare", "window_seconds"): NO_SECONDS,
    ("compare", "progress"): NO_PROGRESS,
    ("least_squares", "basis"): [(3, "but int was given")],
    ("least_squares", "recordings"): NO_RECORDINGS,
    ("least_squares", "channel"): [("x", "no channel 'x'")],
    ("least_squares", "ridge"): [
        (NAN, "is nan"),
        (-1, "is -1"),
        ("x", "is 'x'"),
        (np.zeros(2), "an? ndarray"),
    ],
    ("forward_regression", "channel"): [(np.zeros(2), "no channel an? ndarray"), (3, "no channel 3")],
    ("least_squares", "skip"): [(-1, "is -1"), (NAN, "is nan"), ("a", "is 'a'"), (10**9, "are left out")],
    ("forward_regression", "recordings"): NO_RECORDINGS,
    ("forward_regression", "terms"): COUNTS,
    ("forward_regression", "skip"): [(-1, "is -1"), (NAN, "is nan")],
    ("simulate", "mechanism"): [
        *NO_MODEL,
        (joints.paper(hub_inertia=0.0), "Nothing gives theta an inertia|inertia"),
        (joints.paper(arm_inertia=0.0), "inertia"),
    ],
    ("simulate", "u"): [
        (np.ones((5, 2)), r"is float64 of shape \(5, 2\); give one signal"),
        ([], r"of shape \(0,\)"),
        ([1.0, NAN], "is nan at sample 1"),
        ([1j, 2], "is complex128"),
        (["a", "b"], "real numbers of shape"),
        ([[1, 2], [3]], "is a list"),
        (3.0, r"of shape \(\)"),
        (None, "is None"),
        ([True, False], "is bool"),
        (RUN, r"is a Recording; .* Model\(mechanism\).simulate\(recording\)"),
    ],
    ("simulate", "Ts"): [*NO_SECONDS, (None, "is None"), ([0.1, 0.2], "is a list"), (True, "is True")],
    ("simulate", "x0"): [
        (np.zeros(9), "has 9 entries, but the model has 4 states"),
        ([NAN, 0, 0, 0], "must be numbers, finite and in a row"),
        (np.zeros((2, 2)), r"of shape \(2, 2\)"),
        (np.ma.array([1.0, 2.0], mask=[1, 0]), "must be numbers, finite and in a row"),
        ("a", "`x0` must be numbers"),
        (3.0, r"is 3.0 of shape \(\); give for instance \[0.1, 0.0\]"),
    ],
    ("simulate", "solver"): [("rk4", r"must be Exponential\(...\) or SmoothRK4\(...\), but is 'rk4'")],
    ("linearise", "mechanism"): [
        *NO_MODEL,
        (joints.paper(arm_inertia=0.0), "inertia"),
        (MODEL, "a Model was given; give its attribute `mechanism`"),
    ],
    ("controller", "model"): [*NO_MODEL, (joints.paper(arm_inertia=0.0), "inertia")],
    ("controller", "Ts"): [*NO_SECONDS, (None, "is None")],
    ("controller", "accuracy"): NO_SECONDS,
    ("controller", "limit"): NO_SECONDS,
    ("controller", "port"): [("x", "one of 'hub', 'joint', 'arm', but is 'x'"), (3, "but is 3")],
    ("controller", "load"): [("x", "one of 'hub', 'joint', 'arm', but is 'x'"), (3, "but is 3")],
    ("controller", "compensate"): [("all", "one of 'nothing', .* but is 'all'"), (None, "is None")],
    ("controller", "poles"): [
        ([-1.0, -2.0], "must be 4 poles .* but is a list"),
        ([-1.0, -2.0, -3.0, 4.0], "negative real parts"),
        ([-1.0, -1.0, -3.0, -4.0], "must be different ones"),
        ([-1.0 + 2j, -1.0, -3.0, -4.0], "complex ones in pairs"),
        ("fast", "but is 'fast'"),
    ],
    ("controller", "resolution"): [(0, "above 0"), ({"x": 1.0}, "one of 'theta', 'alpha', but is 'x'")],
    ("Controller.plan", "reference"): [
        ([NAN] * 9, "is nan at sample 0"),
        (3.0, "of shape"),
        ([], "of shape"),
    ],
    ("close_loop", "plant"): [(None, "but is None"), (3, "a model, or an object with read")],
    ("close_loop", "noise"): [(-1, "is -1"), (NAN, "is nan")],
    ("close_loop", "seed"): [(-1, "is -1"), ("a", "is 'a'")],
    ("assess", "models"): [
        ([], "is a list"),
        (3, "is 3"),
        ([3], "'model 1' is 3"),
        (JOINT, "is a Mechanism"),
    ],
    ("assess", "hold"): [(-1, "is -1"), (NAN, "is nan")],
    ("credible_models", "fit"): [(None, "is None"), (3, "is 3")],
    ("controller_to_c", "prefix"): [("1a", "begins no name in C"), (3, "begins no name in C")],
    ("locate", "recording"): NO_RECORDINGS[:3],
    ("locate", "residual"): [
        (Y[:5], "a finite number for each"),
        (np.full_like(Y, NAN), "400 of them"),
        *((value, "a finite number for each") for value in (None, "x", 1j, [[1, 2], [3]])),
    ],
    ("locate", "channels"): [
        (None, "is None"),
        ("theta", "write .'theta'."),
        (("x", "alpha"), "no channel 'x'"),
    ],
    ("locate", "noise"): [
        *((value, "from 0 for each of the channels theta, alpha") for value in (None, [1e-3], "x", [-1, 1])),
        ({"theta": NAN}, "from 0 for each"),
    ],
    ("locate", "mechanism"): [("paper", "must be a Mechanism, but is 'paper'"), (MODEL, "is a Model")],
    ("locate", "window_seconds"): NO_SECONDS,
    ("next_experiment", "model"): NO_MODEL,
    ("next_experiment", "a"): [
        ("x", "'x'"),
        ("delay@input", "delay"),
        (np.zeros(2), "an? ndarray, but needs"),
    ],
    ("next_experiment", "limits"): [(5.0, r"must be Limits\(voltage=...\), but is 5.0")],
    ("next_experiment", "seconds"): [(NAN, "of nan s"), (0, "of 0 s"), ("a", "of 'a' s")],
    ("next_experiment", "Ts"): [(NAN, "of nan s"), (0, "period of 0 s")],
    ("next_experiment", "noise"): [
        ({"theta": -1, "alpha": 1}, "needs a positive standard deviation"),
        ({"theta": NAN, "alpha": 1}, "needs a positive"),
        ({"x": 1}, "needs a positive"),
        ([1e-3, 1e-3], "given as a list"),
    ],
    ("next_experiment", "process_noise"): PROCESS_NOISE,
    ("next_experiment", "reference"): [([NAN] * 10, "is nan at sample 0"), (np.ones((2, 2)), "of shape")],
    ("next_experiment", "starts"): [(-1, "is -1"), (NAN, "is nan")],
    ("next_experiment", "evaluations"): COUNTS,
    ("next_experiment", "progress"): NO_PROGRESS,
    ("experiment_until", "models"): [
        (None, "None was given"),
        (JOINT, "a Mechanism was given"),
        ([JOINT], "one was given"),
        ([JOINT, 3], "a list was given"),
        ([JOINT, JOINT], "name -> model"),
    ],
    ("experiment_until", "rig"): [(None, "is None"), (np.sin, "must be a Rig")],
    ("experiment_until", "probabilities"): [([1, NAN], "`probabilities`"), ("a", "'a'"), ([1], "a list")],
    ("experiment_until", "error"): [(NAN, "is nan"), (0, "is 0"), (0.6, "is 0.6")],
    ("experiment_until", "max_seconds"): [(NAN, "is nan"), (0.1, "is 0.1")],
    ("experiment_until", "segment_seconds"): [(NAN, "is nan"), (0.1, "is 0.1")],
    ("experiment_until", "noise"): [({"x": 1}, "needs a positive"), (3, "given as 3")],
    ("experiment_until", "process_noise"): PROCESS_NOISE,
    ("experiment_until", "uncertainty"): [(NAN, "is nan"), (0, "is 0")],
    ("experiment_until", "seed"): [(-1, "is -1"), (NAN, "is nan")],
    ("experiment_until", "progress"): NO_PROGRESS,
    ("CallbackRig", "function"): [(3, "is 3")],
    ("CallbackRig", "limits"): [(5.0, "is 5.0")],
    ("CallbackRig", "Ts"): [(NAN, "is nan"), (0, "is 0")],
    ("fleet", "mechanism"): NO_MODEL,
    ("fleet", "recordings"): [
        (None, "None was given"),
        (3, "3 was given"),
        ("run.csv", r"'run\.csv' was given"),
        ([None], "None was given"),
        ([], "No recording was given"),
        (["no.csv"], "no.csv does not exist"),
    ],
    ("fleet", "split"): [(NAN, "is nan"), ("a", "is 'a'"), (0, "is 0"), (1, "is 1")],
    ("fleet", "pages"): [(3, "True or False, but is 3")],
    ("fleet", "workers"): [(-1, "is -1"), (1.5, "is 1.5"), (NAN, "is nan")],
    ("fleet", "search"): [(3, "a function of a model and two recordings, but is 3")],
    ("fleet", "scheduler"): [(3, "must be an address, but is 3")],
    ("fleet", "folder"): [(3, "must be a path, but is 3")],
    ("fleet", "progress"): NO_PROGRESS,
    ("arena.score", "methods"): [
        (None, "a function, a name or a list of these, but is None"),
        ([], "is a list"),
        ([3], "functions or names, but has 3"),
        (["search", "search"], "'search' was given twice"),
        ("nobody", "neither FILE.py:NAME nor one of search"),
    ],
    ("arena.score", "records"): COUNTS,
    ("arena.score", "seed"): [(-1, "is -1"), (1.5, "is 1.5"), ("a", "is 'a'")],
    ("arena.score", "seconds"): [(1.0, "from 4 .*is 1.0"), (NAN, "is nan"), ("2", "is '2'")],
    ("arena.score", "limit"): NO_SECONDS,
    ("arena.score", "progress"): NO_PROGRESS,
    ("fleet", "degres"): [(True, "did you mean degrees")],
    ("load", "source"): [(None, "NoneType was given"), (3, "int was given")],
    ("load", "accept"): [(np.zeros(2), "has an? ndarray"), (3, "has 3")],
    ("load, from a frame", "input"): [(3, "`input` must be a word, but is 3"), (np.zeros(2), "an? ndarray")],
    ("load, from a frame", "time"): [(True, "must be a word, but is True"), (b"x", "a bytes")],
    ("load, from a frame", "time_unit"): [([], "must be a word, but is a list"), ("h", "one of s, ms, us")],
    ("load, from a frame", "degrees"): [(np.zeros(2), "True or False"), ("yes", "is 'yes'")],
    ("load, from a frame", "arm_absolute"): [(np.zeros(2), "True or False"), (1, "is 1")],
    ("load, from a frame", "signals"): [
        (3, "must name columns, each once, but is 3"),
        (np.zeros(2), "must name columns"),
        ("voltage", "as a signal and as input or output"),
    ],
    ("load, from a frame", "units"): [
        (True, "by the names of channels, but is True"),
        ({"theta": 3}, "is a dict"),
    ],
    ("load, from a frame", "resample"): [(np.zeros(2), "an? ndarray"), (-1, "is -1")],
    ("load, from a frame", "counts"): [(c, "`counts` must be the counts of one turn") for c, _ in NO_COUNT],
    ("load, resampled", "Ts"): [(0.02, "`resample` and Ts=0.02 were both given"), (NAN, "both given")],
    ("enable_fast_loops", "limit"): COUNTS,
    ("enable_compilation_cache", "folder"): [(3, "must be a path, but is 3"), (True, "is True")],
    ("explore", "recordings"): NO_RECORDINGS,
    ("Limits", "voltage"): [(NAN, "given as nan"), ("a", "given as 'a'"), (INF, "given as inf")],
    ("Limits", "slew"): [(NAN, "given as nan"), (0, "given as 0")],
    ("Limits", "margin"): [(NAN, "is nan"), (1, "is 1")],
    ("Exponential", "order"): [(3, "2 or 4, but is 3"), (np.array([2, 4]), "2 or 4, but is a ndarray")],
    ("Exponential", "substeps"): COUNTS,
    ("Exponential", "passes"): COUNTS,
    ("Exponential", "between"): [("linear", "one of 'held', 'smooth', 'switched', but is 'linear'")],
    ("SmoothRK4", "width"): NO_SECONDS,
    ("SmoothRK4", "substeps"): COUNTS,
    ("Mechanism", "coordinates"): [
        (None, "is None"),
        (3, "is 3"),
        ("a", "must be a list of names, but is 'a'"),
        ((), "no coordinates"),
    ],
    ("Mechanism", "ports"): [(None, "given as None"), ({"p": (NAN,)}, "one number per coordinate")],
    ("Mechanism", "effects"): [(None, "given as None"), ([3], "3 was given as an effect")],
    ("Mechanism", "trusted"): [(("x",), "'x' was named"), ((3,), "a list of names")],
    ("Model", "mechanism"): [*NO_MODEL, (joints.paper(arm_inertia=0.0), "inertia")],
    ("Model", "solver"): [(3, "`solver` must be .* but is 3")],
    ("Model", "gates"): [
        ((1.0,), r"be 6 numbers, finite and in a row, but is a tuple of shape \(1,\)"),
        ((NAN,) * 6, "finite"),
        (True, "is True"),
        (U, r"of shape \(200,\)"),
    ],
    ("Recording", "n_init"): [(NAN, "is nan"), (INF, "is inf"), ("a", "is 'a'"), ([1, 2], "is a list")],
    ("Recording", "Ts"): [([[1, 2], [3]], "is a list"), ([0.1, 0.2], "is 2 values"), (True, "is True")],
    ("Recording", "start"): [(NAN, "is nan"), ("a", "is 'a'"), (None, "is None")],
    ("Recording", "source"): [(3, "`source` must be text, but is 3")],
    ("Recording", "input_name"): [(3, "must be text")],
    ("Recording", "input_unit"): [(None, "must be text")],
    ("Recording", "resolution"): [
        ({"theta": -1}, "is -1"),
        ({"theta": NAN}, "is nan"),
        ({"x": 1}, "names 'x', but the recording has the channels theta, alpha"),
        (3, "is 3"),
    ],
    ("Recording", "remarks"): [(3, "list of findings, but has 3"), ("ab", "has 'ab'"), ([1], "has 1")],
    ("Recording", "continues"): [(3, "the recording before this one, but is 3")],
    ("Recording", "constants"): [
        (3, "is 3"),
        ({"a": NAN}, "the value nan"),
        ({"a": True}, "the value True"),
        ({"a": np.ones(1)}, "the value a ndarray"),
    ],
    ("Recording", "signals"): [
        (3, "by its name, but is 3"),
        ({"": U}, "the name ''"),
        ({"a": U[1:]}, r"one value for each of the 200 samples, but has the shape \(199,\)"),
        ({"a": U[:, None]}, r"the shape \(200, 1\)"),
        ({"a": U * NAN}, "is nan"),
    ],
    ("Recording", "channels"): [(3, "must be words"), ((1, 2), "must be words")],
    ("Recording", "units"): [((1, 2), "must be words")],
    ("Recording", "accept"): [(3, "but has 3")],
    ("Recording", "u"): [(None, "`u` must hold real numbers"), ({}, "must hold real numbers")],
    ("Recording.split", "share"): [(NAN, "is nan"), ("a", "is 'a'"), (INF, "is inf"), (2, "between 0 and 1")],
    ("Recording.split", "seconds"): [(NAN, "is nan"), (0, "would have 0 of 200")],
    ("Recording.decimate", "k"): [*COUNTS[:-1], (None, "is None"), (INF, "is inf")],
    ("Recording.slice", "i"): [
        (0.5, "from 0.5 to 60"),
        (NAN, "from nan"),
        ("a", "from 'a'"),
        (-1, "from -1"),
    ],
    ("Model.simulate", "recording"): NO_RECORDINGS,
    ("Model.simulate", "x0"): [
        (np.zeros(9), "9 entries"),
        ([NAN], "must be numbers, finite and in a row"),
        ("a", "`x0` must be numbers"),
    ],
    ("Model.simulate_states", "recording"): NO_RECORDINGS[:3],
    ("Model.simulate_windows", "recording"): NO_RECORDINGS[:3],
    ("Model.behind_actuation", "recording"): NO_RECORDINGS[:3],
    ("Model.inputs", "recording"): NO_RECORDINGS[:3],
    ("Model.at", "recording"): NO_RECORDINGS[:3],
    ("Model.simulate_windows", "seconds"): NO_SECONDS,
    ("Model.predict", "recording"): NO_RECORDINGS[:3],
    ("Model.predict", "process_noise"): PROCESS_NOISE,
    ("Model.predict", "noise"): [
        ([1e-3], "one number for each of theta, alpha"),
        ([0.0, 1e-3], "is 0.0"),
        ([NAN, 1e-3], "is nan"),
        ("ab", "one number for each"),
        (None, "is None"),
    ],
    ("Model.save", "path"): [(3, "path of a file is needed, but 3 was given")],
    ("Mechanism.with_values", "values"): [
        ([1.0], "one number for each of the 1[0-9] parameters, but is a list"),
        (np.ones(99), "one number for each"),
        (np.ones((len(JOINT.values), 2)), "is an? ndarray"),
        (None, "is None"),
        ({"x": 1.0}, "'x' was named"),
        ({"hub.inertia.inertia": NAN}, "finite value"),
    ],
    ("export.to_c", "model"): NO_MODEL,
    ("export.to_c", "Ts"): NO_SECONDS,
    ("export.to_c", "prefix"): [("a b", "begins no name in C"), (3, "begins no name in C"), ("", "no name")],
    ("export.latex", "model"): NO_MODEL,
    ("export.text", "model"): NO_MODEL,
    ("export.state_space", "model"): NO_MODEL,
    ("export.state_space", "Ts"): NO_SECONDS,
    ("export.state_space", "positions"): [
        ([1.0], "be 2 numbers"),
        (1j, "is 1j"),
        ("", "is ''"),
        ([0, NAN], "list"),
    ],
    ("export.state_space", "voltage"): NO_NUMBER,
    **{
        (f"export.to_{form}", argument): rows
        for form in ("mjcf", "urdf", "fmu", "bam")
        for argument, rows in (
            ("model", NO_MODEL),
            ("Ts", NO_SECONDS),
            (
                "u",
                [([NAN], "is nan"), ("a", "`u` must be real numbers"), ([], "`u` must be"), (U[None], "`u`")],
            ),
        )
    },
    **{
        (f"export.to_{form}", "name"): [(3, "a name, but 3"), (" ", "needs a name"), (None, "but None")]
        for form in ("mjcf", "urdf", "fmu")
    },
    ("export.to_bam", "actuator"): [(3, "a name, but 3"), ("", "needs a name")],
    ("export.to_bam", "length"): [(0, "is 0"), (NAN, "is nan"), ("a", "is 'a'")],
    ("load_mjcf", "path"): [(3, "3 was given"), ("no-such.xml", "cannot be read"), (".", "cannot be read")],
    ("load_mjcf", "ignore"): [("ref", "list of names"), (["x"], "one of 'forcerange'"), (3, "is 3")],
    ("export.save", "saved"): [(3, "3 was given")],
    ("export.read", "path"): [(3, "but 3 was given"), ("no-such.json", "does not exist")],
    ("kernels.local_kernels", "model"): NO_MODEL,
    ("kernels.local_kernels", "channel"): [("x", "'x' were requested")],
    ("kernels.local_kernels", "memory"): COUNTS,
    ("kernels.local_kernels", "Ts"): NO_SECONDS,
    ("kernels.local_kernels", "settle"): [(-1, "is -1"), ("a", "'a'"), (1e99, "settle / Ts")],
    ("kernels.local_kernels", "voltage"): NO_NUMBER,
    ("kernels.average_kernels", "data"): [
        (None, "NoneType|None"),
        (1j, "complex"),
        (U, "`Ts` must be a finite number above 0 .s., but is None; give for instance 0.002, or a recording"),
    ],
    ("kernels.average_kernels", "autocovariance"): [
        ("x", "10 numbers.* is 'x'"),
        (U, "10 numbers.*lags 0 to 9"),
    ],
    ("kernels.average_kernels", "model"): NO_MODEL,
    ("kernels.average_kernels", "blocks"): COUNTS,
    ("kernels.average_kernels", "reach"): COUNTS,
    ("adaptive.identify", "recording"): NO_RECORDINGS[:3],
    ("basis.Delays", "memory"): COUNTS,
    ("basis.Volterra", "order"): COUNTS,
    ("save_csv", "recording"): NO_RECORDINGS[:3],
    ("save_csv", "path"): [(3, "but 3 was given")],
    ("metrics.rmse", "y_hat"): [(Y[:5], "the same shape"), (None, "arrays of numbers")],
    ("metrics.rmse", "y"): [(None, "arrays of numbers"), (np.array([["a"]]), "arrays of numbers")],
    ("metrics.rmse", "n_init"): [(NAN, "is nan"), ("a", "is 'a'"), (1.5, "is 1.5"), (N, "leave samples")],
    ("noise", "N"): [(n, "`N` and `Ts` must be a number of samples") for n, _ in [*COUNTS, (INF, "")]],
    ("noise", "Ts"): [(0, "and 0"), (NAN, "and nan"), (INF, "and inf"), ("a", "and 'a'")],
    ("noise", "rms"): NO_SECONDS,
    ("noise", "bandwidth"): NO_SECONDS,
    ("noise", "seed"): [(-1, "is -1"), ("a", "is 'a'"), (0.5, "is 0.5")],
    ("multisine", "band"): [((NAN, 3), "nan to 3 Hz"), (3, "is 3"), ("ab", "is 'ab'"), ((3, 1), "3 to 1 Hz")],
    ("multisine", "periods"): [
        (0, "is 0"),
        (NAN, "is nan"),
        (1.5, "is 1.5"),
        (None, "is None"),
        (7, "a multiple"),
    ],
    ("prbs", "hold"): [*NO_SECONDS, (1e308, "a number of usual size above 0, but is 1e[+]308")],
    ("steps", "hold"): [*NO_SECONDS, ([], "is a list")],
    ("steps", "amplitude"): NO_SECONDS,
    ("sweep", "band"): [((NAN, 1), "nan to 1 Hz"), (None, "is None")],
    ("pulse", "amplitude"): NO_NUMBER,
    ("pulse", "width"): NO_SECONDS,
    ("keep_programs", "folder"): [(3, "is 3"), (None, "is None"), (__file__, "is a file")],
    ("compare_plot", "recording"): [("x", "x|recording"), (None, "None|recording")],
    ("compare_plot", "model"): [("x", "x|mechanism|model"), (None, "None|mechanism|model")],
    ("compare_plot", "labels"): [
        ("a", "`labels` must be a list of names, but is 'a'"),
        (3, "is 3"),
        ([1], "is a list"),
        (["a", "b"], "2 names for 1 models"),
    ],
    ("compare_plot", "seconds"): [(NAN, "nan"), (-1, "-1")],
    ("Probabilities.credible", "share"): [
        (0, "0, but it must be above 0|0"),
        (1.5, "1.5, but it is a probability"),
        (NAN, "nan"),
        ("most", "most"),
    ],
    ("joints.servo", "kind"): [("ax12", "one of 'xl330', 'sts3215', but is 'ax12'"), (None, "is None")],
    ("joints.servo", "gain"): [(-1.0, "between 0 and inf"), (NAN, "nan"), ("a", "'a'")],
    ("joints.servo", "integral"): [(-1.0, "from 0, but is -1"), (NAN, "nan"), ("a", "'a'")],
    ("joints.servo", "inertia"): [(-1.0, "between 0 and inf"), ("a", "'a'")],
    ("joints.servo", "sensors"): [("alpha", "one of 'theta'.* but is 'alpha'"), (3, "is 3")],
    ("LoadFriction", "of"): [
        ("load", "given of='load', but the load is of 'both' sides"),
        (None, "of=None"),
        (np.array([1, 2]), "of=a ndarray"),
    ],
    ("joints.paper", "sensors"): [
        ("beta", "one or several of 'theta', 'alpha', 'speed', but is 'beta'"),
        ((), "but is ''"),
        (3, "list of names, but is 3"),
        ("theta+theta", "but is 'theta.theta'"),
    ],
    ("joints.paper", "tied"): [("yes", "needs True or False"), (1, "needs True or False")],
    ("close_loop", "controller"): [
        (None, "must be a Controller, but is None; make one"),
        (JOINT, "a Mechanism"),
    ],
    ("assess", "controller"): [(None, "must be a Controller, but is None")],
    ("controller_to_c", "controller"): [("x", "must be a Controller, but is 'x'")],
    ("adaptive.identify", "filter"): [(None, "must be an AdaptiveFilter, but is None"), ("rls", "is 'rls'")],
    ("joints.quanser_2010", "arm"): [([], "given a list"), (4, "given 4")],
    ("joints.quanser_2010", "spring"): [([], "given a list"), ("x", "given 'x'")],
    ("joints.quanser_2010", "sensors"): [(["x"], "but is 'x'")],
    ("joints.flexible_joint", "motor"): [(None, "must be a Motor, but is None"), (3, "is 3")],
    **{
        ("joints.flexible_link", name): [*NO_NUMBER, (-1.0, "is -1")]
        for name in ("mass", "length", "frequency", "damping_ratio", "gauge_gain")
    },
    ("joints.flexible_link", "hub"): [("a", "'a'"), (-1.0, "is -1")],
    ("joints.flexible_link", "motor"): [("x", "must be a Motor, but is 'x'")],
    ("joints.single_inertia", "motor"): [("x", "must be a Motor, but is 'x'")],
    ("joints.position_servo", "servo"): [("x", "must be a PositionLoop, but is 'x'; give .*PositionServo")],
    ("joints.xl330_pendulum", "mass"): NO_NUMBER,
    ("joints.xl330_pendulum", "length"): NO_NUMBER,
    ("joints.xl330_pendulum", "rotor_inertia"): NO_NUMBER,
    ("pulse", "delay"): [(NAN, "is nan"), (-1, "is -1")],
}

CASES = [
    pytest.param(function, argument, value, phrase, id=f"{function} {argument} {checks.shown(value)} {k}")
    for (function, argument), rows in BAD.items()
    for k, (value, phrase) in enumerate(rows)
]


@pytest.mark.parametrize(("function", "argument", "value", "phrase"), CASES)
def test_nonsense_is_refused(
    function: str,
    argument: str,
    value: Any,
    phrase: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    if function == "explore":
        pytest.importorskip("ipywidgets")
    call, good = FUNCTIONS[function]
    refused(lambda: call(**{**good, argument: value}), phrase)


def test_every_public_function_is_in_the_table() -> None:
    settings = {"live", "performance"}
    functions = {name for name in rf.__all__ if inspect.isfunction(getattr(rf, name))} - settings
    inputs = set(excitation.INPUTS)
    assert functions | inputs <= {function for function, _ in BAD}
    assert {function for function, _ in BAD} == set(FUNCTIONS)


def test_settings_of_the_kit_may_be_numbers_of_numpy() -> None:
    given = joints.quanser_2010(np.int64(1), spring=np.int32(3), hub_anchor=np.str_("A"))
    assert given == joints.quanser_2010(1, spring=3, hub_anchor="A")


def test_a_list_of_one_recording_is_this_recording() -> None:
    noise = {"hub": 1e-6}, [1e-3, 1e-3]
    for run in (
        MODEL.simulate,
        MODEL.simulate_states,
        MODEL.simulate_windows,
        lambda recording: MODEL.predict(recording, *noise),
    ):
        np.testing.assert_array_equal(run([RUN]), run(RUN))


def test_whole_numbers_may_be_floats() -> None:
    assert RUN.decimate(2.0).N == RUN.decimate(2).N == 100
    assert RUN.slice(np.int64(0), 60).N == 60
    assert rf.Recording(u=U, y=Y, Ts=np.array([[0.002]]), n_init=np.float64(20)).n_init == 20


def test_windows_longer_than_any_recording_are_the_whole_recording() -> None:
    for seconds in (1e99, 1e9):
        starts, longest = metrics.window_starts(RUN, seconds)
        assert (starts.tolist(), longest) == ([0], N)


def test_counts_may_be_a_number_of_numpy() -> None:
    options = {"outputs": ["theta", "alpha"], "accept": ("units",)}
    plain = rf.load(FRAME, counts=4096, **options)
    for counts in (np.int64(4096), np.float32(4096), {"theta": np.int32(4096), "alpha": np.array(4096)}):
        assert np.array_equal(rf.load(FRAME, counts=counts, **options).y, plain.y)


def test_what_no_float_can_hold_is_refused():
    with pytest.raises(rf.InputError, match=r"level=1000.* N m, but it needs a finite value"):
        rf.effects.Coulomb("hub", level=10**400)
    with pytest.raises(rf.InputError, match="list of degrees, but is True"):
        basis.Volterra(basis.Delays(3), degrees=True)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (True, "True"),
        ("2", "'2'"),
        (b"2", "a bytes"),
        (2 + 0j, r".2.0j."),
        ([2.0], "a list"),
        (np.array([2.0]), "a ndarray"),
        (pd.Series([2.0]), "a Series"),
        (np.array("2"), "'2'"),
        (np.ma.masked, "a MaskedConstant"),
    ],
)
def test_a_parameter_that_is_no_number_is_refused(value: Any, shown: str) -> None:
    with pytest.raises(rf.InputError, match=f"level={shown}, but it needs a number in N m; give one"):
        rf.effects.Coulomb(at="hub", level=value)


def test_an_array_of_no_axis_is_a_number() -> None:
    made = rf.effects.Coulomb(at="hub", level=cast(Any, np.array(0.25)))
    assert made == rf.effects.Coulomb(at="hub", level=0.25) and hash(made) == hash(made.replace(level=0.25))
    with pytest.raises(rf.InputError, match=r"level=-0.25 N m, but it needs a finite value"):
        rf.effects.Coulomb(at="hub", level=cast(Any, np.array(-0.25)))


def test_constants_of_a_recording_are_floats() -> None:
    known = {"a": np.float32(0.25), "b": np.array(0.25), "c": jnp.float32(0.25)}
    found = rf.Recording(u=U, y=Y, Ts=0.01, accept=("units",), constants=cast(Any, known)).constants
    assert set(found.values()) == {0.25} and all(type(value) is float for value in found.values())


def test_a_series_of_pandas_is_no_vector_of_values() -> None:
    """Its rows may have another order than the parameters."""
    values = pd.Series(dict(zip(JOINT.parameter_names, JOINT.values, strict=True)))[::-1]
    with pytest.raises(rf.InputError, match=r"`values` must have one number for each .* is a Series"):
        JOINT.with_values(cast(Any, values))
    assert JOINT.with_values(values.to_dict()) == JOINT


def test_masked_samples_are_not_used() -> None:
    masked = np.ma.masked_greater(U, 0.0)
    with pytest.raises(rf.InputError, match="`u` has masked samples, but all are needed"):
        rf.simulate(JOINT, masked, 0.002)
    for pair in ((masked, U), (U, masked)):
        with pytest.raises(rf.InputError, match="has masked samples, but all are scored"):
            metrics.rmse(*pair)
    assert metrics.rmse(np.ma.array(U), 0 * U) == pytest.approx(np.sqrt(np.mean(U**2)))
