"""A model as a functional mock-up unit (FMI 3.0, co-simulation): C source, description, compiled library."""

import hashlib
import importlib.resources
import io
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.errors import InputError, optional
from rotflex_jax.export.c_code import to_c
from rotflex_jax.export.certificate import Exported, Subject, in_comment
from rotflex_jax.export.mjcf import machine_name, safe_identifier
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import one_line

# Fixed date of all files in the archive, so that its bytes depend on the model only.
_DATE = (1980, 1, 1, 0, 0, 0)

_BASE_UNITS = {
    "rad": {"rad": "1"},
    "rad/s": {"rad": "1", "s": "-1"},
    "m": {"m": "1"},
    "m/s": {"m": "1", "s": "-1"},
    "V": {"kg": "1", "m": "2", "s": "-3", "A": "-1"},
    "A": {"A": "1"},
    "s": {"s": "1"},
}


def to_fmu(
    model: Mechanism | Model,
    Ts: float,
    name: str = "machine",
    u: Real[np.ndarray, " N"] | Sequence[float] | None = None,
) -> Exported:
    """A model as an FMU for co-simulation (FMI 3.0), with its certificate.

    The archive contains the C code of `to_c`, with every effect, and a shared library for this machine if a C
    compiler is found. A communication step must be a whole multiple of `Ts`; the FMU refuses any other step
    with a message. The input is held over the step. Initial positions and speeds are fixed parameters.

    Args:
        model: Mechanism with its parameter values, or a Model.
        Ts: Sampling period, which is the internal step [s].
        name: Name of the model.
        u: Input of the certificate; None for three sines with rests.

    Returns:
        The bytes of the archive, with the certificate, which `modelDescription.xml` contains as a comment.
        Without a compiler or the package fmpy, nothing is simulated, and the certificate gives the reason.

    Raises:
        InputError: C code cannot express an effect; `name` is no name, `Ts` no sampling period, or `u` no
            signal.

    Source: Modelica Association, Functional Mock-up Interface specification 3.0, 2022.
    """
    subject, name = Subject.of(model, Ts, u), machine_name(name)
    identifier = safe_identifier(name)
    header = to_c(subject.model, subject.Ts, prefix="model")
    token = "{" + hashlib.sha256(f"{name}\n{header}".encode()).hexdigest()[:32] + "}"
    wrapper = _wrapper(subject, identifier, token)
    library = _compiled(identifier, header, wrapper)
    description = _description(subject, name, identifier, token)
    why_not = _why_not(library)
    if why_not:
        certificate = subject.certificate("FMI 3.0", "", None, why_not=why_not)
    else:
        trial = _archive(identifier, header, wrapper, library, description)
        fmpy = optional("fmpy", "A certificate of an FMU")
        y = run_in_fmpy(trial, subject.u, subject.Ts)
        certificate = subject.certificate("FMI 3.0", f"FMPy {fmpy.__version__}", y)
    description.insert(0, ET.Comment(in_comment(str(certificate))))
    return Exported(_archive(identifier, header, wrapper, library, description), certificate)


def run_in_fmpy(
    fmu: bytes, u: Real[np.ndarray, " N"] | Sequence[float], Ts: float
) -> Float[np.ndarray, "N C"]:
    """Outputs of an FMU from `to_fmu` in co-simulation, from rest.

    Args:
        fmu: Bytes of the archive.
        u: Input, held over each sample.
        Ts: Sampling period [s].

    Raises:
        InputError: FMPy is not installed.
    """
    optional("fmpy", "A run of an FMU")
    reader, slave = (
        optional("fmpy.model_description", "A run of an FMU"),
        optional("fmpy.fmi3", "A run of an FMU"),
    )
    y = []
    with tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(io.BytesIO(fmu)) as archive:
            archive.extractall(folder)
        description = reader.read_model_description(folder)
        outputs = [v.valueReference for v in description.modelVariables if v.causality == "output"]
        unit = slave.FMU3Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="certificate",
        )
        unit.instantiate()
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        for k, value in enumerate(np.asarray(u, float).tolist()):
            y.append(unit.getFloat64(outputs))
            unit.setFloat64([1], [value])
            unit.doStep(k * Ts, Ts)
        unit.terminate()
        unit.freeInstance()
    return np.array(y)


def platform_folder() -> str | None:
    """Name of this platform in FMI, such as `x86_64-linux`; None if it is unknown."""
    systems = {"linux": "linux", "darwin": "darwin"}
    system = systems.get(sys.platform)
    machine = {"arm64": "aarch64", "amd64": "x86_64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    return f"{machine}-{system}" if system else None


def _why_not(library: bytes | None) -> str:
    if library is None:
        return "no C compiler (cc) for this machine; the archive holds the source"
    try:
        optional("fmpy", "A certificate of an FMU")
    except InputError as missing:
        return str(missing)
    return ""


def _wrapper(subject: Subject, identifier: str, token: str) -> str:
    file = importlib.resources.files("rotflex_jax.export") / "templates" / "fmi3.c"
    text = file.read_text(encoding="utf-8")
    starts = str(2 * len(subject.mechanism.coordinates))
    filled = {"IDENTIFIER": identifier, "TOKEN": token, "STARTS": starts, "TS": repr(subject.Ts)}
    for mark, value in filled.items():
        text = text.replace(f"@{mark}@", value)
    return text


def _compiled(identifier: str, header: str, wrapper: str) -> bytes | None:
    """The shared library, or None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None or platform_folder() is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        # File names without the folder, so that the library does not depend on the place of compilation.
        write_file(Path(folder, "model.h"), header)
        write_file(Path(folder, "fmi3_model.c"), wrapper)
        command = [compiler, "-std=c99", "-shared", "-fPIC", "-O2", "-o", "model.so", "fmi3_model.c", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(
                f"The C compiler {os.path.basename(compiler)} did not accept the source of {identifier}: "
                f"{one_line(done.stderr.strip())[:300]}; repair the compiler, or take it off the path for an "
                "FMU of source alone."
            )
        return Path(folder, "model.so").read_bytes()


def _description(subject: Subject, name: str, identifier: str, token: str) -> ET.Element:
    m, units = subject.mechanism, subject.mechanism.units
    first = rest_state(m.structure, np.float64)
    n = len(m.coordinates)
    taken = {"time"}
    listed: list[tuple[str, str, dict[str, str]]] = [
        ("time", "s", {"causality": "independent"}),
        (_free("u", taken), units.input, {"causality": "input", "start": "0"}),
    ]
    for channel, quantity in zip(m.channels, m.quantities, strict=True):
        listed.append((_free(one_line(channel), taken), quantity.unit(units), {"causality": "output"}))
    for k in range(2 * n):
        word, unit = ("", units.motion) if k < n else ("_rate", f"{units.motion}/s")
        variable = _free(f"{one_line(m.coordinates[k % n])}{word}_start", taken)
        fixed = {"causality": "parameter", "variability": "fixed", "start": repr(float(first[k]))}
        listed.append((variable, unit, fixed))
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": name,
            "instantiationToken": token,
            "generationTool": "rotflex_jax",
            "description": "Free run of an identified machine",
        },
    )
    ET.SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": identifier,
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
            "fixedInternalStepSize": repr(subject.Ts),
        },
    )
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(unit for _, unit, _ in listed):
        base = ET.SubElement(definitions, "Unit", {"name": unit})
        if unit in _BASE_UNITS:
            ET.SubElement(base, "BaseUnit", _BASE_UNITS[unit])
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", {"name": "logStatusError", "description": "What was refused"})
    stop = repr(float(len(subject.u) * subject.Ts))
    ET.SubElement(
        root, "DefaultExperiment", {"startTime": "0", "stopTime": stop, "stepSize": repr(subject.Ts)}
    )
    variables = ET.SubElement(root, "ModelVariables")
    for reference, (variable, unit, kind) in enumerate(listed):
        attributes = {"name": variable, "valueReference": str(reference), "unit": unit}
        ET.SubElement(variables, "Float64", attributes | kind)
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [str(2 + k) for k in range(len(m.channels))]
    for reference in outputs:
        ET.SubElement(structure, "Output", {"valueReference": reference, "dependencies": ""})
    for reference in outputs:
        ET.SubElement(structure, "InitialUnknown", {"valueReference": reference})
    return root


def _free(name: str, taken: set[str]) -> str:
    """The name, with underscores appended until no other variable has it."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _archive(
    identifier: str, header: str, wrapper: str, library: bytes | None, description: ET.Element
) -> bytes:
    build = ET.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    configuration = ET.SubElement(build, "BuildConfiguration", {"modelIdentifier": identifier})
    sources = ET.SubElement(configuration, "SourceFileSet", {"language": "C99"})
    ET.SubElement(sources, "SourceFile", {"name": "fmi3_model.c"})
    files: dict[str, bytes] = {
        "modelDescription.xml": _xml(description),
        "sources/buildDescription.xml": _xml(build),
        "sources/fmi3_model.c": wrapper.encode(),
        "sources/model.h": header.encode(),
    }
    if library is not None:
        ending = "dylib" if sys.platform == "darwin" else "so"
        files[f"binaries/{platform_folder()}/{identifier}.{ending}"] = library
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in files.items():
            entry = zipfile.ZipInfo(path, _DATE)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return held.getvalue()


def _xml(root: ET.Element) -> bytes:
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"
