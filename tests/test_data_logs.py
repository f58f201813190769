"""Logs of MATLAB, LabVIEW, MDF4 and ROS 2, written by other libraries; JSON; one file for each channel."""

import io
import json
import os
import re
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest

from rotflex_jax.cli import main
from rotflex_jax.data import load
from rotflex_jax.data.matlab import StoredObjects
from rotflex_jax.errors import InputError

N = 80
K = np.arange(N)
T = 0.002 * K
VOLTAGE = np.random.default_rng(3).normal(size=N)
THETA, ALPHA = 0.3 * np.sin(K / 9), 0.1 * np.cos(K / 4)
SIGNALS = {"voltage": VOLTAGE, "theta": THETA, "alpha": ALPHA}

JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""


def refused(source, phrase: str, **how) -> None:
    with pytest.raises(InputError) as caught:
        load(source, **how)
    sentence = str(caught.value)
    assert re.search(phrase, sentence), sentence
    assert sentence.endswith(".") and "\n" not in sentence and len(sentence) < 400, sentence


def exact(recording) -> None:
    assert recording.Ts == pytest.approx(0.002, rel=1e-9)
    np.testing.assert_array_equal(recording.u, VOLTAGE)
    np.testing.assert_array_equal(recording.y, np.column_stack([THETA, ALPHA]))


# -- MATLAB ----------------------------------------------------------------------------------------------


def timetable(path: Path, index, version: str = "v7", **others) -> Path:
    """A file with the timetable `log`, written by another implementation of MATLAB's objects."""
    matio, pd = pytest.importorskip("matio"), pytest.importorskip("pandas")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values = {"log": pd.DataFrame(SIGNALS, index=index), **others}
        matio.save_to_mat(str(path), values, version=version)
    return path


PARTS = {"input": "log.voltage", "outputs": ("log.theta", "log.alpha")}


@pytest.mark.parametrize("kind", ["durations", "dates"])
def test_a_timetable_of_matlab_is_read_with_its_times(tmp_path, kind):
    pd = pytest.importorskip("pandas")
    index = pd.to_timedelta(2 * K, unit="ms")
    if kind == "dates":
        index = pd.Timestamp("2025-03-01 10:00") + index
    path = timetable(tmp_path / "run.mat", index, gain=7.0)
    recording = load(path, **PARTS)
    assert recording.Ts == pytest.approx(0.002, rel=1e-6)
    np.testing.assert_array_equal(recording.u, VOLTAGE)
    np.testing.assert_array_equal(recording.y, np.column_stack([THETA, ALPHA]))
    refused(path, r"log\.voltage", input="log.volts", outputs=PARTS["outputs"])


def test_a_table_beside_a_structure_is_read(tmp_path):
    pd = pytest.importorskip("pandas")
    path = timetable(tmp_path / "run.mat", pd.RangeIndex(N), of={"t": T})
    exact(load(path, time="of.t", **PARTS))


def test_a_timetable_of_version_7_3_is_refused_with_its_cure(tmp_path):
    pytest.importorskip("h5py")
    pd = pytest.importorskip("pandas")
    path = timetable(tmp_path / "run.mat", pd.to_timedelta(2 * K, unit="ms"), "v7.3")
    refused(path, r"log \(timetable\): save a timetable, timeseries or Dataset with -v7", **PARTS)


def test_a_damaged_timetable_is_left_out_and_named(tmp_path):
    """The name of a property of its times is overwritten; the rest of the file is intact."""
    pd = pytest.importorskip("pandas")
    path = timetable(tmp_path / "run.mat", pd.to_timedelta(2 * K, unit="ms"), also=np.arange(9.0))
    data = path.read_bytes()
    parts, at = [data[:128]], 128
    place = struct.unpack_from("<Q", data, 116)[0]
    while at < len(data):
        size = struct.unpack_from("<I", data, at + 4)[0]
        plain = zlib.decompress(data[at + 8 : at + 8 + size])
        if at == place:
            assert b"rowTimes" in plain and plain.count(b"millis") == 1
            plain = plain.replace(b"millis", b"milles")
        packed = zlib.compress(plain)
        if at == place:
            parts[0] = data[:116] + struct.pack("<Q", sum(map(len, parts))) + data[124:128]
        parts.append(struct.pack("<II", 15, len(packed)) + packed)
        at += 8 + size
    path.write_bytes(b"".join(parts))
    refused(path, r"objects that only MATLAB reads .* log \(timetable\)", **PARTS)


def timeseries(path: Path, wanted: dict, units: str = "seconds", implicit: bool = False) -> Path:
    """A file of timeseries as MATLAB stores them, written by another implementation of its objects."""
    matio = pytest.importorskip("matio")
    from matio.utils import MatlabOpaque

    def one(t, x):
        about = {"Units": units}
        if implicit:  # as of Simulink: a constant step instead of times, and time along the last axis
            x, step = x[None, None], float(t[1] - t[0])
            about |= {
                "Start_": np.array([[t[0]]]),
                "Increment_": np.array([[step]]),
                "Length": np.array([[len(t)]]),
            }
        info = MatlabOpaque(about, "tsdata.timemetadata")
        kept = {"Data_": x if implicit else x[:, None], "TimeInfo": info, "Name": "signal"}
        return MatlabOpaque(kept if implicit else {**kept, "Time_": t[:, None]}, "timeseries")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(str(path), {name: one(t, x) for name, (t, x) in wanted.items()}, version="v7")
    return path


@pytest.mark.parametrize(
    ("units", "factor", "implicit"),
    [("seconds", 1.0, False), ("milliseconds", 1e3, False), ("seconds", 1.0, True)],
)
def test_timeseries_of_matlab_are_read_with_their_times(tmp_path, units, factor, implicit):
    wanted = {name: (factor * T, x) for name, x in SIGNALS.items()}
    path = timeseries(tmp_path / "run.mat", wanted, units, implicit)
    exact(load(path))
    exact(load(path, input="voltage.Data", outputs=("theta.Data", "alpha.Data")))


def test_timeseries_of_other_times_are_brought_together_on_request(tmp_path):
    late = T[::2] + 0.001
    wanted = {name: (T, x) for name, x in SIGNALS.items()} | {"alpha": (late, np.interp(late, T, ALPHA))}
    path = timeseries(tmp_path / "run.mat", wanted)
    refused(path, "times of their own.*resample")
    assert load(path, resample=0.002).N < N


def test_a_timeseries_without_its_step_is_left_out_and_named(tmp_path):
    path = timeseries(tmp_path / "run.mat", {n: (T, x) for n, x in SIGNALS.items()}, units="fortnights")
    refused(path, r"objects that only MATLAB reads .* \(timeseries\): save")


def dataset(
    path: Path, names=tuple(SIGNALS), deep: bool = False, within: bool = False, again: int = 0
) -> Path:
    """A file with a Simulink Dataset, written by another implementation of MATLAB's objects.

    Args:
        path: Path of the file.
        names: Names of the signals.
        deep: Whether the signals are in a separate object inside the Dataset.
        within: Whether the Dataset is in an object with the outputs of a simulation.
        again: Number of nested objects around the Dataset, each with two references to the next.
    """
    matio = pytest.importorskip("matio")
    from matio.utils import MatlabOpaque

    kind = "Simulink.SimulationData"

    def signal(name: str, x: np.ndarray) -> MatlabOpaque:
        values = MatlabOpaque({"Data_": x[:, None], "Time_": T[:, None], "Name": "unnamed"}, "timeseries")
        where = MatlabOpaque({"Path": f"loop/{name}"}, f"{kind}.BlockPath")
        return MatlabOpaque({"Name": name, "Values": values, "BlockPath": where}, f"{kind}.Signal")

    cells = np.empty((len(names), 1), dtype=object)
    for k, (name, x) in enumerate(zip(names, SIGNALS.values(), strict=True)):
        cells[k, 0] = signal(name, x)
    elements = {"Elements": cells}
    if deep:
        elements = {"Storage_": MatlabOpaque(elements, f"{kind}.Storage.RamDatasetStorage")}
    found = MatlabOpaque({"Name": "logsout", **elements}, f"{kind}.Dataset")
    for _ in range(again):
        found = MatlabOpaque({"First": found, "Second": found}, f"{kind}.Dataset")
    variables = {"log": found}
    if within:
        variables = {"out": MatlabOpaque(variables, "Simulink.SimulationOutput")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(str(path), variables, version="v7")
    return path


@pytest.mark.parametrize(("deep", "within"), [(False, False), (True, False), (True, True)])
def test_a_dataset_of_simulink_is_read_by_the_names_of_its_signals(tmp_path, deep, within):
    path = dataset(tmp_path / "run.mat", deep=deep, within=within)
    start = "out" if within else "log"
    exact(load(path, input=f"{start}.voltage.Data", outputs=(f"{start}.theta.Data", f"{start}.alpha.Data")))
    refused(path, rf"{start}\.voltage\.Data", input="volts", outputs=("theta", "alpha"))


@pytest.mark.parametrize("again", [1, 12])
def test_a_signal_that_is_reached_twice_is_one_signal(tmp_path, again, monkeypatch):
    """Twelve nested objects with two references each make 4096 paths, but fewer than 200 objects are read."""
    path = dataset(tmp_path / "run.mat", again=again)
    read, properties = [], StoredObjects.properties

    def counted(objects, reference):
        read.append(reference)
        return properties(objects, reference)

    monkeypatch.setattr(StoredObjects, "properties", counted)
    exact(load(path, input="log.voltage.Data", outputs=("log.theta.Data", "log.alpha.Data")))
    assert len(read) < 200


def test_a_dataset_with_two_signals_of_one_name_is_left_out_and_named(tmp_path):
    path = dataset(tmp_path / "run.mat", names=("voltage", "theta", "theta"))
    refused(path, r"objects that only MATLAB reads .* log \(Simulink\.SimulationData\.Dataset\): save")


# -- JSON ------------------------------------------------------------------------------------------------

SAMPLES = [
    {"t": t, "voltage": u, "angles": [a, b], "on": True, "unit": {"a": 1}}
    for t, u, a, b in zip(T.tolist(), VOLTAGE.tolist(), THETA.tolist(), ALPHA.tolist(), strict=True)
]


@pytest.mark.parametrize(
    "content",
    [SAMPLES, {"gain": 400, "motion": "sines", "entries": SAMPLES, "notes": ["a"]}],
    ids=["samples alone", "beside settings"],
)
def test_samples_in_a_json_file(tmp_path, content):
    path = tmp_path / "run.json"
    path.write_text(json.dumps(content))
    exact(load(path, outputs=("angles[0]", "angles[1]")))


def test_columns_in_a_json_file(tmp_path):
    path = tmp_path / "run.json"
    columns = {"t": T, "voltage": VOLTAGE, "theta": THETA, "alpha": ALPHA}
    path.write_text(json.dumps({name: values.tolist() for name, values in columns.items()} | {"gain": 4}))
    exact(load(path))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (json.dumps([SAMPLES[0], {"t": 1.0}]), r"has t in sample 2, but t, voltage, angles, on, unit in"),
        (json.dumps({"a": SAMPLES, "b": SAMPLES}), "has samples under a, b, but one recording is read"),
        (json.dumps([1, 2]), "has no table in it"),
        ("[" * 100_000, "cannot be read as JSON"),
        ('{"t": [0, 1', "cannot be read as JSON"),
        (
            json.dumps({"t": [0.0, None], "voltage": [1, 1], "theta": [0, 0], "alpha": [0, 0]}),
            r"column 't' is nan at sample 2",
        ),
    ],
)
def test_json_without_a_recording_is_refused(tmp_path, content, said):
    path = tmp_path / "run.json"
    path.write_text(content)
    refused(path, said)


def test_a_log_of_a_servo_is_read_by_its_columns(measured):
    """The reference for the angle is `load_bam_xl330`.

    The goal is not compared, since that reader interpolates it linearly and `load` holds it.
    """
    known = measured("bam_xl330")[0]
    path = Path(os.environ["ROTFLEX_DATA"]) / "bam_xl330" / known.source.split(",")[0]
    names = {"time": "timestamp", "input": "goal_position", "outputs": {"theta": "position"}}
    found = load(path, units={"goal_position": "rad"}, resample=0.005, **names)
    np.testing.assert_allclose(found.y, known.y, rtol=0, atol=1e-12)
    assert found.input_unit == "rad"


# -- LabVIEW ---------------------------------------------------------------------------------------------


def tdms(path: Path, waveform: bool = True, **others: np.ndarray) -> Path:
    nptdms = pytest.importorskip("nptdms")
    about = {"wf_increment": 0.002, "wf_start_offset": 0.0} if waveform else {}
    units = {"voltage": "V", "theta": "rad", "alpha": "rad"}
    channels = [
        nptdms.ChannelObject("run", name, x, properties=about | {"unit_string": units.get(name, "")})
        for name, x in (({} if waveform else {"Time": T}) | SIGNALS | others).items()
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.RootObject(), nptdms.GroupObject("run"), *channels])
    return path


@pytest.mark.parametrize("waveform", [True, False], ids=["waveform", "channel of times"])
def test_a_labview_file(tmp_path, waveform):
    recording = load(tdms(tmp_path / "run.tdms", waveform))
    exact(recording)
    assert recording.input_unit == "V"


def test_times_of_day_of_a_labview_file_are_seconds(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    stamps = np.datetime64("2025-03-01T10:00:00", "us") + (2000 * K).astype("timedelta64[us]")
    channels = [nptdms.ChannelObject("run", n, x) for n, x in {"Timestamp": stamps, **SIGNALS}.items()]
    with nptdms.TdmsWriter(tmp_path / "run.tdms") as writer:
        writer.write_segment(channels)
    recording = load(tmp_path / "run.tdms")
    assert recording.Ts == pytest.approx(0.002, rel=1e-6)
    np.testing.assert_array_equal(recording.u, VOLTAGE)


def test_angles_of_a_labview_file_may_be_counts(tmp_path):
    counts = {"enc": np.round(THETA * 4096 / (2 * np.pi)).astype(np.int32)}
    path = tdms(tmp_path / "run.tdms", **counts)
    recording = load(path, outputs="enc", counts=4096)
    np.testing.assert_allclose(recording.y[:, 0], THETA, atol=np.pi / 4096)


def test_a_channel_of_another_length_is_refused(tmp_path):
    refused(
        tdms(tmp_path / "run.tdms", short=np.ones(7)), "'short' has 7 samples and its group 'run' 80 times"
    )


# -- MDF4 ------------------------------------------------------------------------------------------------


def mdf(path: Path, groups: list[dict[str, np.ndarray]], clocks: list[np.ndarray], **how) -> Path:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        for signals, t in zip(groups, clocks, strict=True):
            units = {"voltage": "V"}
            file.append(
                [asammdf.Signal(x, t, name=name, unit=units.get(name, "rad")) for name, x in signals.items()]
            )
        file.save(path, overwrite=True, **how)
    return path


@pytest.mark.parametrize("packed", [0, 2], ids=["plain", "packed"])
def test_an_mdf_file(tmp_path, packed):
    recording = load(mdf(tmp_path / "run.mf4", [SIGNALS], [T], compression=packed))
    exact(recording)


def test_groups_with_times_of_their_own_are_brought_together_on_request(tmp_path):
    late = T + 0.0007
    groups = [{"voltage": VOLTAGE}, {"theta": 5.0 * late, "alpha": np.sin(40 * late)}]
    path = mdf(tmp_path / "run.mf4", groups, [T, late])
    refused(path, "times of their own .* resample='auto'")
    recording = load(path, resample="auto", accept=("units", "swapped"))
    t = recording.t
    np.testing.assert_array_equal(t, 0.0007 + 0.002 * np.arange(len(t)))
    # Linear interpolation is exact for a ramp; the voltage is held between its samples.
    np.testing.assert_allclose(recording.y[:, 0], 5.0 * t, atol=1e-12)
    np.testing.assert_array_equal(recording.u, VOLTAGE[: len(t)])
    assert [finding.kind for finding in recording.findings if finding.kind == "resampled"] == ["resampled"]


def test_samples_that_are_marked_invalid_are_missing(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    bad = K == 33
    signals = [asammdf.Signal(x, T, name=name) for name, x in SIGNALS.items() if name != "theta"]
    signals.append(asammdf.Signal(THETA, T, name="theta", invalidation_bits=bad))
    with asammdf.MDF(version="4.10") as file:
        file.append(signals)
        file.save(tmp_path / "run.mf4", overwrite=True)
    refused(tmp_path / "run.mf4", r"'theta'.*sample 33")


# -- ROS 2 -----------------------------------------------------------------------------------------------


def mcap(path: Path, jitter: float = 0.0, stamped: bool = True, packed: str = "ZSTD") -> Path:
    ros2 = pytest.importorskip("mcap_ros2.writer")
    kinds = pytest.importorskip("mcap.writer").CompressionType
    times = 1_700_000_000 * 10**9 + 2_000_000 * K.astype(np.int64)
    times += (1e9 * jitter * np.random.default_rng(5).uniform(-1, 1, N)).astype(np.int64)
    writer = ros2.Writer(out := io.BytesIO(), compression=kinds[packed])
    state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
    number = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
    for k, at in enumerate(times.tolist()):
        stamp = {"sec": at // 10**9, "nanosec": at % 10**9} if stamped else {"sec": 0, "nanosec": 0}
        joints = {
            "name": ["hub", "arm"],
            "position": [THETA[k], ALPHA[k]],
            "velocity": [],
            "effort": [0.1, 0.2],
        }
        message = {"header": {"stamp": stamp, "frame_id": "base"}, **joints}
        # A message is logged later than it was stamped.
        later = at + (3_000_000 if stamped else 0)
        writer.write_message("/joint_states", state, message, log_time=later, publish_time=later)
        writer.write_message("/motor/voltage", number, {"data": VOLTAGE[k]}, log_time=at, publish_time=at)
    writer.finish()
    path.write_bytes(out.getvalue())
    return path


NAMES = {"outputs": ("hub.position", "arm.position")}


@pytest.mark.parametrize("packed", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("stamped", [True, False], ids=["stamped", "logged"])
def test_joint_states_of_ros_2(tmp_path, stamped, packed):
    exact(load(mcap(tmp_path / "run.mcap", stamped=stamped, packed=packed), **NAMES))


def test_joint_states_at_uneven_times_are_resampled_on_request(tmp_path):
    path = mcap(tmp_path / "run.mcap", jitter=0.0004)
    refused(path, r"not uniform|uneven|resample", **NAMES)
    recording = load(path, resample=0.002, **NAMES)
    moved = np.interp(recording.t, T, THETA)
    np.testing.assert_allclose(recording.y[:, 0], moved, atol=0.3 / 9 * 0.5)  # half of the largest step
    assert len(recording.u) >= N - 2


def test_simulated_time_begins_at_zero(tmp_path):
    """A first stamp of zero is a time; stamps count as missing only if all of them are zero."""
    ros2 = pytest.importorskip("mcap_ros2.writer")
    writer = ros2.Writer(out := io.BytesIO())
    state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
    for k in range(N):
        header = {"stamp": {"sec": 0, "nanosec": 2_000_000 * k}, "frame_id": ""}
        joints = {"name": ["hub", "arm"], "position": [THETA[k], ALPHA[k]], "velocity": []}
        message = {"header": header, **joints, "effort": [VOLTAGE[k], 0.0]}
        at = 1_700_000_000 * 10**9 + 5_000_000 * k  # simulated slower than real time
        writer.write_message("/s", state, message, log_time=at, publish_time=at)
    writer.finish()
    (tmp_path / "run.mcap").write_bytes(out.getvalue())
    exact(load(tmp_path / "run.mcap", input="hub.effort", **NAMES))


def test_a_joint_state_that_loses_a_joint_is_refused(tmp_path):
    ros2 = pytest.importorskip("mcap_ros2.writer")
    writer = ros2.Writer(out := io.BytesIO())
    state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
    for k in range(9):
        header = {"stamp": {"sec": k, "nanosec": 0}, "frame_id": ""}
        names = ["hub", "arm"][: 1 + (k != 4)]
        joints = {"name": names, "position": [0.0] * len(names), "velocity": [], "effort": []}
        writer.write_message("/s", state, {"header": header, **joints}, log_time=k, publish_time=k)
    writer.finish()
    (tmp_path / "run.mcap").write_bytes(out.getvalue())
    refused(tmp_path / "run.mcap", "message 4 of the topic '/s' has not the numbers of its first one")


def test_a_packed_part_that_claims_more_is_refused(tmp_path):
    path = mcap(tmp_path / "run.mcap")
    refused(path, r"unpacks to at least", max_bytes=1000 + path.stat().st_size, **NAMES)


# -- One file for each channel ---------------------------------------------------------------------------


def channel_files(folder: Path, header: str | None = None, shift: float = 0.0) -> list[Path]:
    folder.mkdir()
    for name, x in SIGNALS.items():
        rows = np.column_stack([T + (shift if name == "alpha" else 0.0), x])
        np.savetxt(text := io.StringIO(), rows, "%.17g", ",", header=f"t,{header or name}", comments="")
        (folder / f"{name}.csv").write_text(text.getvalue())
    return sorted(folder.iterdir())


@pytest.mark.parametrize("header", [None, "value"], ids=["names in headers", "names of files"])
def test_one_file_for_each_channel(tmp_path, header):
    files = channel_files(tmp_path / "run", header)
    exact(load(tmp_path / "run"))
    exact(load(files))


def test_times_of_the_files_may_have_their_unit_at_the_end_of_the_name(tmp_path):
    files = channel_files(tmp_path / "run")
    for file in files:
        rows = np.loadtxt(file, delimiter=",", skiprows=1) * [1e3, 1.0]
        np.savetxt(file, rows, "%.17g", ",", header=f"t_ms,{file.stem}", comments="")
    found = load(files)
    np.testing.assert_allclose(found.Ts, T[1] - T[0], rtol=1e-9)
    np.testing.assert_allclose(load(files, accept=("units",)).Ts, T[1] - T[0], rtol=1e-9)
    # Other spellings of one unit, and seconds that are named or not, are no other units.
    files[0].write_text(files[0].read_text().replace("t_ms", "t [msec]", 1))
    np.testing.assert_allclose(load(files).Ts, T[1] - T[0], rtol=1e-9)
    seconds = channel_files(tmp_path / "seconds")
    seconds[0].write_text(seconds[0].read_text().replace("t,", "t_s,", 1))
    exact(load(seconds))


def test_another_table_in_the_folder_does_not_hide_the_names_of_the_files(tmp_path):
    channel_files(tmp_path / "run", "value")
    (tmp_path / "run" / "gains.csv").write_text("stage,gain\n1,2\n2,4\n")
    exact(load(tmp_path / "run"))


def test_a_folder_is_a_recording_on_the_command_line(tmp_path, capsys):
    channel_files(tmp_path / "run")
    with pytest.raises(SystemExit) as left:
        main(["check", str(tmp_path / "run"), "--accept", "short"])
    out = capsys.readouterr()
    assert "80 samples" in out.out + out.err, out
    assert left.value.code in (0, 2)


def test_channels_with_other_times_are_not_joined_in_silence(tmp_path):
    files = channel_files(tmp_path / "run", shift=0.0005)
    refused(files, "times of their own")
    assert len(load(files, resample="auto").u) == N - 1


def test_times_in_other_units_and_folders_without_recordings_are_refused(tmp_path):
    files = channel_files(tmp_path / "run")
    files[0].write_text(files[0].read_text().replace("t,", "t [ms],", 1))
    refused(files, "the times are in '' and 'ms'")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "is a folder, but a recording is one file")
    refused([], "list of files was given, but it is empty")


# -- Damage ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make", [tdms, mcap, lambda path: mdf(path, [SIGNALS], [T])], ids=["tdms", "mcap", "mf4"]
)
def test_a_cut_or_foreign_file_is_refused_in_one_sentence(tmp_path, make, request):
    ending = request.node.callspec.id
    data = make(tmp_path / f"run.{ending}").read_bytes()
    broken = tmp_path / f"cut.{ending}"
    for content in (data[: len(data) // 2], b"t,voltage\n0,1\n", bytes(4000), data[:30]):
        broken.write_bytes(content)
        refused(broken, "cannot be read as|no channel with numbers|has no column|samples", **NAMES)
