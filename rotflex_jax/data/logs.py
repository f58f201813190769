"""Logs of LabVIEW (TDMS), of test benches (MDF4) and of ROS 2 (MCAP) as tables; packages are imported on use.

In a log each group of signals has its own times. The groups become one table, which has for each signal the
name of its column of times.
"""

import contextlib
import math
import struct
from collections import Counter
from collections.abc import Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from rotflex_jax.data.tables import MAX_BYTES, Table, check_size, unreadable
from rotflex_jax.errors import InputError, optional

CLOCKS = ("t", "time", "timestamp", "timestamps")
"""Names of a channel with the times."""

MOST_NUMBERS = 64
"""Largest number of columns from one message."""

DEEPEST_FIELD = 8
"""Largest depth of nested messages."""

WIDEST_SCALING = 8
"""Most unpacked bytes per byte of a TDMS file: 8-bit readings of a converter that are scaled to float64."""


class Channel(NamedTuple):
    """A signal of a log.

    Attributes:
        group: group of the signal, whose channels have common times.
        name: name of the signal.
        unit: unit in the file, empty if there is none.
        values: one value for each time.
    """

    group: str
    name: str
    unit: str
    values: Shaped[np.ndarray, " N"]


def table_of_channels(
    label: str,
    channels: Sequence[Channel],
    clocks: dict[str, Shaped[np.ndarray, " _"]],
    clock: str = "t",
) -> Table:
    """A table with the names of the channels; equal names have the names of their groups in front.

    Args:
        label: name of the table in an error message.
        channels: signals.
        clocks: group -> its times.
        clock: name of the column with the times, followed by the unit if that is not the second.

    >>> x = np.arange(3.0)
    >>> table = table_of_channels("run", [Channel("a", "u", "V", x), Channel("b", "u", "", x)], {"a": x})
    >>> list(table.columns), table.clocks
    (['t', 'a.u', 'b.u'], {'a.u': 't'})
    """
    often = Counter(channel.name for channel in channels)
    timed = [group for group in clocks if any(channel.group == group for channel in channels)]
    columns: dict[str, Any] = {}
    clock_of = {group: clock if len(timed) == 1 else f"{group}.{clock}" for group in timed}
    for group, column in clock_of.items():
        columns[column] = clocks[group]
    units: dict[str, str] = {}
    of_column: dict[str, str] = {}
    for channel in channels:
        alone = often[channel.name] == 1 and channel.name not in columns
        name = channel.name if alone else f"{channel.group}.{channel.name}"
        if name in columns:
            raise InputError(
                f"{label} has more than one channel {name!r}, so that it is open which is meant; rename or "
                "remove one."
            )
        columns[name] = channel.values
        if channel.unit:
            units[name] = channel.unit
        if channel.group in clock_of:
            of_column[name] = clock_of[channel.group]
    return Table(label, columns, "sample", 0, units, clocks=of_column)


def table_from_tdms(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The channels of a LabVIEW file; times come from a channel of that name or from waveform properties.

    Raises:
        InputError: nptdms is missing, or the file is damaged, too large or without numbers.
    """
    nptdms: Any = optional("nptdms", f"Reading {path.name}")
    try:
        # We open the file ourselves, so that it is closed if nptdms fails.
        with path.open("rb") as opened, nptdms.TdmsFile.open(opened) as file:
            found = [
                (group.name, channel)
                for group in file.groups()
                for channel in group.channels()
                if len(channel) and channel.dtype.kind in "iufM"
            ]
            size = sum(len(channel) * channel.dtype.itemsize for _, channel in found)
            check_size(path.name, size, max_bytes)
            if size > WIDEST_SCALING * path.stat().st_size:
                raise ValueError("its channels claim more samples than are there")
            channels: list[Channel] = []
            clocks: dict[str, Any] = {}
            for group, channel in found:
                values = _seconds(channel[:])
                if channel.name.casefold() in CLOCKS:
                    clocks[group] = values
                    continue
                step = channel.properties.get("wf_increment")
                if isinstance(step, float) and step > 0 and group not in clocks:
                    start = channel.properties.get("wf_start_offset", 0.0)
                    clocks[group] = float(start) + step * np.arange(len(values))
                unit = str(channel.properties.get("unit_string", ""))
                channels.append(Channel(group, channel.name, unit, values))
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within nptdms
        raise unreadable(path, "a TDMS file", error) from error
    return _filled(path, channels, clocks)


def _seconds(values: np.ndarray) -> np.ndarray:
    """Dates as seconds since the first date; other numbers unchanged."""
    if values.dtype.kind != "M" or not len(values):
        return values
    return (values - values[0]) / np.timedelta64(1, "ns") * 1e-9


def table_from_mdf(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The numeric channels of an MDF4 file; the master channel of each group is its time.

    Samples that the file marks as invalid are missing values.

    Raises:
        InputError: asammdf is missing, or the file is damaged, too large or without numbers.
    """
    asammdf: Any = optional("asammdf", f"Reading {path.name}")
    channels: list[Channel] = []
    clocks: dict[str, Any] = {}
    try:
        data = path.read_bytes()
        if data[:8] not in (b"MDF     ", b"UnFinMF ") or data[8:10] != b"4.":
            raise ValueError("it does not begin as one of version 4")
        _check_blocks(data)
        # From memory, because asammdf leaves a file open if it fails.
        with contextlib.redirect_stdout(StringIO()), asammdf.MDF(BytesIO(data)) as file:  # it prints errors
            sizes = [
                group.channel_group.cycles_nr * max(group.channel_group.samples_byte_nr, 1)
                for group in file.groups
            ]
            check_size(path.name, sum(sizes), max_bytes)
            for number, group in enumerate(file.groups):
                width = group.channel_group.samples_byte_nr
                for channel in group.channels:  # asammdf does not check this
                    if channel.byte_offset + (channel.bit_offset + channel.bit_count + 7) // 8 > width:
                        raise ValueError(f"the channel {channel.name!r:.40} lies outside its record")
                name = str(group.channel_group.acq_name or f"group_{number}")
                for index in range(len(group.channels)):
                    if index == file.masters_db.get(number):
                        continue
                    signal = file.get(group=number, index=index, ignore_invalidation_bits=True)
                    values = np.asarray(signal.samples)
                    if values.dtype.kind not in "iuf" or values.ndim != 1 or not len(values):
                        continue
                    if signal.invalidation_bits is not None:
                        values = np.where(np.asarray(signal.invalidation_bits, bool), np.nan, values)
                    if number in file.masters_db:
                        clocks.setdefault(name, np.asarray(signal.timestamps, float))
                    channels.append(Channel(name, str(signal.name), str(signal.unit or ""), values))
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within asammdf
        raise unreadable(path, "an MDF4 file", error) from error
    return _filled(path, channels, clocks)


_CHAINED = (b"##DG", b"##CG", b"##CN", b"##FH", b"##AT", b"##EV", b"##DL", b"##CH")
"""Blocks of an MDF4 file whose first link leads to the next block of the same kind."""


def _check_blocks(data: bytes) -> None:
    """Refuse links between the blocks of an MDF4 file that lead out of the file or in a circle.

    asammdf follows such links without end, or stops in a state that it cannot leave without error messages.

    Raises:
        ValueError: there is such a link.

    Source:
        ASAM MDF 4.1, general block structure: name, reserved, length, number of links, links.
    """
    after: dict[int, int] = {}
    waiting, seen = [64], {64}
    while waiting:
        at = waiting.pop()
        if at + 24 > len(data) or data[at : at + 2] != b"##" or (at == 64 and data[at : at + 4] != b"##HD"):
            raise ValueError(f"no block begins at byte {at}")
        length, count = struct.unpack_from("<QQ", data, at + 8)
        if length < 24 + 8 * count or at + length > len(data):
            raise ValueError(f"a block at byte {at} claims {length} bytes and {count} links")
        links = struct.unpack_from(f"<{count}Q", data, at + 24)
        if links and data[at : at + 4] in _CHAINED:
            after[at] = links[0]
        new = {link for link in links if link} - seen
        seen |= new
        waiting += new
    met: set[int] = set()
    for start in after:
        way: set[int] = set()
        at = start
        while at and at not in met:
            if at in way:
                raise ValueError(f"the blocks behind byte {at} lead back to it")
            way.add(at)
            at = after.get(at, 0)
        met |= way


def table_from_mcap(path: Path, max_bytes: int = MAX_BYTES) -> Table:
    """The numbers in the messages of a ROS 2 log, topic by topic.

    A joint of `sensor_msgs/msg/JointState` gives `joint.position`, `joint.velocity` and `joint.effort`. The
    number of a message with a single number has the name of the topic; other numbers have the names
    `topic.field`, and `topic.field[k]` in a list. The time is in seconds since the first message. It comes
    from the headers, or from the log if no header of the topic has a time.

    Raises:
        InputError: mcap or mcap-ros2-support is missing; the file is damaged, too large, or has no ROS 2
            messages with numbers; or the messages of a topic have different numbers.
    """
    readers: Any = optional("mcap.stream_reader", f"Reading {path.name}")
    records: Any = optional("mcap.records", f"Reading {path.name}")
    ros2: Any = optional("mcap_ros2.decoder", f"Reading {path.name}")
    topics: dict[str, tuple[list[tuple[int, int]], list[dict[str, float]]]] = {}
    try:
        stream = readers.StreamReader(
            BytesIO(path.read_bytes()), emit_chunks=True, validate_crcs=True, record_size_limit=max_bytes
        )
        schemas: dict[int, Any] = {}
        sources: dict[int, Any] = {}
        factory = ros2.DecoderFactory()
        size = 0
        for record in stream.records:
            if isinstance(record, records.Chunk):
                size += max(record.uncompressed_size, len(record.data))
                check_size(path.name, size, max_bytes)
                if record.compression in ("lz4", "zstd"):
                    _check_unpacked(record)
                parts = readers.breakup_chunk(record, validate_crc=True)
            else:
                parts = [record]
            for part in parts:
                if isinstance(part, records.Schema):
                    schemas[part.id] = part
                elif isinstance(part, records.Channel):
                    sources[part.id] = part
                elif isinstance(part, records.Message):
                    source = sources[part.channel_id]
                    decode = factory.decoder_for(source.message_encoding, schemas.get(source.schema_id))
                    if decode is None:
                        continue
                    stamp, numbers = _message(decode(part.data), source.topic)
                    if numbers:
                        times, rows = topics.setdefault(source.topic, ([], []))
                        times.append((stamp, part.log_time))
                        rows.append(numbers)
    except InputError:
        raise
    except Exception as error:  # a damaged file fails in many ways within mcap
        raise unreadable(path, "an MCAP file", error) from error
    # Headers without a time are zero in all messages; simulated time may be zero in the first message alone.
    stamped = {topic: any(stamp for stamp, _ in times) for topic, (times, _) in topics.items()}
    at = {topic: [t[0 if stamped[topic] else 1] for t in times] for topic, (times, _) in topics.items()}
    first = min((times[0] for times in at.values()), default=0)
    channels: list[Channel] = []
    clocks: dict[str, Any] = {}
    for topic, (_, rows) in topics.items():
        group = topic.strip("/").replace("/", ".")
        clocks[group] = np.array([stamp - first for stamp in at[topic]]) * 1e-9  # exact: whole numbers
        names = list(rows[0])
        odd = next((k for k, row in enumerate(rows) if list(row) != names), None)
        if odd is not None:
            raise InputError(
                f"{path.name}: message {odd} of the topic {topic!r} has not the numbers of its first one "
                f"({', '.join(names[:6])}); log each source under a topic of its own."
            )
        columns = np.array([list(row.values()) for row in rows], float).T
        channels += [Channel(group, name, "", x) for name, x in zip(names, columns, strict=True)]
    return _filled(path, channels, clocks)


def _check_unpacked(chunk: Any) -> None:
    """Refuse a chunk whose unpacked size differs from its stated size, before it is unpacked.

    Raises:
        ValueError: the packed data state another size.
    """
    if chunk.compression == "zstd":
        said = optional("zstandard", "Reading a packed log").frame_content_size(chunk.data)
    else:
        said = optional("lz4.frame", "Reading a packed log").get_frame_info(chunk.data)["content_size"] or -1
    if said not in (-1, chunk.uncompressed_size):
        raise ValueError("a packed part has another size than it says")


def _message(message: Any, topic: str) -> tuple[int, dict[str, float]]:
    """Time of a message [ns], zero if it has none, and its numbers by name."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    nanoseconds = 0 if stamp is None else 1_000_000_000 * int(stamp.sec) + int(stamp.nanosec)
    if str(getattr(message, "_type", "")) in ("sensor_msgs/JointState", "sensor_msgs/msg/JointState"):
        numbers: dict[str, float] = {}
        for field in ("position", "velocity", "effort"):
            values = list(getattr(message, field))
            if values and len(values) != len(message.name):
                raise ValueError(f"a joint state has {len(message.name)} names and {len(values)} of {field}")
            numbers |= {f"{name}.{field}": float(x) for name, x in zip(message.name, values, strict=False)}
        return nanoseconds, numbers
    found = list(_numbers(message, "", 0))
    last = topic.rstrip("/").rpartition("/")[2]
    if len(found) == 1:
        return nanoseconds, {last: found[0][1]}
    return nanoseconds, {f"{last}.{name}": value for name, value in found[:MOST_NUMBERS]}


def _numbers(value: Any, name: str, depth: int) -> list[tuple[str, float]]:
    """The numbers of a message by dotted name, without those in its header and in the layout of a list."""
    if isinstance(value, bool | str | bytes) or depth > DEEPEST_FIELD:
        return []
    if isinstance(value, int | float):
        return [(name, float(value))]
    if hasattr(value, "__slots__"):
        fields = [field for field in value.__slots__ if field not in ("header", "layout")]
        pairs = [(f"{name}.{field}".lstrip("."), getattr(value, field)) for field in fields]
    elif hasattr(value, "__len__"):
        pairs = [(f"{name}[{k}]", value[k]) for k in range(min(len(value), MOST_NUMBERS))]
    else:
        return []
    return [number for key, part in pairs for number in _numbers(part, key, depth + 1)]


def _filled(path: Path, channels: list[Channel], clocks: dict[str, Any]) -> Table:
    """The table of the channels; raises `InputError` if there are none, or if lengths do not agree."""
    if not channels:
        raise InputError(f"{path.name} has no channel with numbers in it; export the recording again.")
    lengths = {group: len(t) for group, t in clocks.items()}
    for channel in channels:
        if lengths.get(channel.group, len(channel.values)) != len(channel.values):
            raise InputError(
                f"{path.name}: {channel.name!r} has {len(channel.values)} samples and its group "
                f"{channel.group!r} {lengths[channel.group]} times, but each sample needs one; record them "
                "in one task, or in groups of their own."
            )
    finite_clocks = {group: t for group, t in clocks.items() if len(t) and math.isfinite(float(t[0]))}
    return table_of_channels(path.name, channels, finite_clocks)
