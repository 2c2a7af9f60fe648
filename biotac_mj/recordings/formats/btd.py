"""SynTouch's native log (.btd): a text header, then one line per sample.

A line has time [s], batch, frame, channel, and for each of three sensors on the bus its word and whether
parity failed; words of an absent sensor are zero. A frame has 44 samples: PAC 22 times, every other channel
once. SynTouch's C library writes the same lines without a header, for three or five sensors, with times only
if compiled so.
"""

import pathlib
import re

import numpy as np

from ...geometry.design import design_named, design_of_channels, designs
from ...quality.clock import BUS_RATE
from .streams import Stream

# channels' numbers in the log
_PAC, _PDC, _TAC, _TDC, _E1 = 0, 1, 2, 3, 17
_BEGIN = b"Begin File"


def is_btd(content: bytes) -> bool:
    """Whether a file begins like a .btd log."""
    head = content[:4096]
    return _BEGIN in head or b"SampStruct" in head or _is_bare(head)


def _is_bare(head):
    """Whether text begins with a frame's samples: no other table has these channels in its fourth column."""
    return any(_begins_with_frame(head, design) for design in designs())


def _begins_with_frame(head, design):
    samples = len(_frame_of(design))
    lines = [line.split() for line in head.split(b"\n")[: samples + 1]]
    if len(lines) <= samples or any(len(line) < 6 or len(line) % 2 for line in lines[:samples]):
        return False
    return {line[3] for line in lines[:samples]} == {b"%d" % channel for channel in set(_frame_of(design))}


def _frame_of(design):
    """Channels of a frame's samples, sorted: PAC before each of the others."""
    others = [_PDC, _TAC, _TDC, *range(_E1, _E1 + design.nelectrode)]
    return [*[_PAC] * len(others), *others]


def read_btd(path: pathlib.Path, content: bytes, role: str | None = None) -> list[Stream]:
    """One stream for each sensor on the bus. Rows are frames, timed at their first sample. Channels are
    numbered in the file, so `role` has no effect.

    Raises:
      ValueError: no header, no samples, malformed lines, or no complete frame.
    """
    bare = _is_bare(content[:4096])
    head, mark, body = (b"", b"", b"\n" + content) if bare else content.partition(_BEGIN)
    if not (mark or bare):
        raise ValueError(
            f"{path} has a header of a .btd log without 'Begin File': was it cut off? Copy it again"
        )
    header = dict(re.findall(r"^([\w ]+?)\s*:\s*(.*?)\s*$", head.decode("latin-1"), re.M))
    lines = body.split(b"\n")[1:]
    try:
        table = np.array([line.split() for line in lines if line.strip()], float)
    except ValueError:
        table = np.zeros((0, 0))
    if table.ndim != 2 or not len(table) or table.shape[1] < 6 or table.shape[1] % 2:
        raise ValueError(
            f"{path} has no samples, or lines that are not time, batch, frame, channel and two numbers "
            "for each sensor: was it cut off? Export it again, or remove the last line"
        )
    if not np.isfinite(table).all():
        raise ValueError(f"{path} has samples that are not finite: copy it again")
    starts, channel, there, n = _frames(path, table)
    notes = [
        f"{path.name}: {key} {''.join(filter(str.isprintable, header[key])).strip(', ')}"
        for key in ("Serial Number", "Date")
        if header.get(key)
    ]
    named = design_named(header.get("Serial Number", ""))
    if named is not None and n < named.nelectrode:
        notes.append(
            f"{path.name}: the serial number is that of a {named.title}, of which this log has {n}: they are "
            f"read as those of a {design_of_channels(n).title}, and lie elsewhere"
        )
    lost = table[starts[-1], 2] - table[starts[0], 2] + 1 - len(starts)
    if lost > 0:
        notes.append(f"{path.name}: the frames' own numbers lack {lost:.0f} of {lost + len(starts):.0f}")
    time = table[starts, 0]
    if not np.ptp(time):
        time = (table[starts, 2] - table[starts[0], 2]) / BUS_RATE
        notes.append(f"{path.name}: no times: frames are {1e3 / BUS_RATE:g} ms long")
    streams = []
    for k in range(4, table.shape[1], 2):
        word = table[:, k][there]
        if not word.any():
            continue
        failed = table[:, k + 1][there] != 0
        fields = {
            "electrodes": np.stack([word[channel == _E1 + i] for i in range(n)], 1),
            "pac": word[channel == _PAC].reshape(len(starts), -1),
            **{name: word[channel == c] for name, c in (("pdc", _PDC), ("tac", _TAC), ("tdc", _TDC))},
        }
        more = [f"parity failed in {failed.sum()} of {failed.size} samples"] if failed.any() else []
        streams.append(Stream(path.name, f"bt{(k - 2) // 2}", fields, time, notes=[*notes, *more]))
    if not streams:
        raise ValueError(f"{path} has no sensor on its bus: all words are zero")
    return streams


def _frames(path, table):
    """(first line of each complete frame, (frames, samples) channels, (frames, samples) lines,
    electrodes)."""
    change = np.flatnonzero(np.diff(table[:, 2]) != 0) + 1
    begin, beyond = np.r_[0, change], np.r_[change, len(table)]
    for design in designs():
        wanted = _frame_of(design)
        first = begin[beyond - begin == len(wanted)]
        lines = first[:, None] + np.arange(len(wanted))
        channel = table[:, 3][lines] if len(first) else np.zeros((0, len(wanted)))
        good = (np.sort(channel, axis=1) == wanted).all(1)
        if good.any():
            return first[good], channel[good], lines[good], design.nelectrode
    raise ValueError(
        f"{path} has no whole frame: 22 samples of PAC and one of each other channel in 44 lines are needed, "
        "of a BioTac SP with all its electrodes 27 in 54"
    )
