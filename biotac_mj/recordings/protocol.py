"""Protocol of a checkup: actions on a sensor during a recording, and their timeline.

Each segment isolates some effects, so that a diagnosis can search for them while nothing else changes."""

import dataclasses
import math
import pathlib
import threading
import time as clock
import typing
from collections.abc import Callable, Sequence

import numpy as np

from ..fields import check_entries, refuse_unknown
from ..files import replacing
from ..reading import read_yaml
from ..short_repr import short_repr

SCHEMA = "biotac_mj.protocol/1"
MOVE = 3.0  # [s] pause between two segments
_REMEDY = "`biotac checkup --out protocol.yaml` writes one"


class Step(typing.NamedTuple):
    """A step of the protocol. seconds: duration; line: instruction; tells: the effects that it isolates;
    touched: whether there is contact; sharp: whether it begins and ends within a few rows."""

    seconds: float
    line: str
    tells: str
    touched: bool = True
    sharp: bool = False


STEPS = {
    "rest": Step(
        45, "Switch the sensor on cold and leave it in air.", "noise, hum, drift, warm-up, lost rows", False
    ),
    "taps": Step(
        15, "Tap the pad twice a second with a hard, light thing.", "latency, filters, swaps", sharp=True
    ),
    "hold": Step(
        30,
        "Press the pad slowly on a flat, hard thing, and hold for 20 s.",
        "relaxation, leaks, noise of load",
    ),
    "release": Step(15, "Let go, and leave it in air.", "relaxation, offsets", False),
    "loops": Step(20, "Press slowly and let go slowly, five times at one place.", "hysteresis, saturation"),
    "fast": Step(15, "Press fast and let go at once, at many places.", "latency, filters, gain", sharp=True),
    "slides": Step(25, "Press lightly and slide along and across.", "friction, cross-talk, gain, signs"),
    "warm": Step(
        30, "Warm it in a fist for 10 s, then leave it in air.", "temperature, noise after load", False
    ),
}


@dataclasses.dataclass(frozen=True)
class Segment:
    """kind: of STEPS; start, stop [s] since the first row; against: what touched it, "" if unknown."""

    kind: str
    start: float
    stop: float
    against: str = ""

    def __post_init__(self):
        refuse_unknown([self.kind], STEPS, "kind of a segment")
        if not (0 <= self.start < self.stop < math.inf):
            raise ValueError(
                f"a segment {self.kind!r} goes from {self.start:g} to {self.stop:g} s: it must end after it "
                "starts, at 0 s or later"
            )


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Segments in order of time.

    Raises:
      ValueError: none, or two that overlap.
    """

    segments: tuple[Segment, ...]

    def __post_init__(self):
        if not self.segments:
            raise ValueError(f"a protocol has no segments: {_REMEDY}")
        for a, b in zip(self.segments, self.segments[1:]):
            if b.start < a.stop:
                raise ValueError(
                    f"segment {b.kind!r} starts at {b.start:g} s, before {a.kind!r} ends at {a.stop:g} s: "
                    "give segments in order, without overlap"
                )

    @classmethod
    def planned(cls, against: str = "") -> "Protocol":
        """All STEPS in sequence."""
        segments, start = [], 0.0
        for kind, step in STEPS.items():
            start += MOVE
            segments.append(Segment(kind, start, start + step.seconds, against if step.touched else "air"))
            start += step.seconds
        return cls(tuple(segments))

    @property
    def seconds(self) -> float:
        return self.segments[-1].stop

    def rows(self, time: np.ndarray, *kinds: str) -> list[np.ndarray]:
        """Row numbers at times (n,) [s] since the first row, one array for each segment of these kinds
        (default: all). Segments without rows are skipped."""
        found = [
            np.flatnonzero((time >= one.start) & (time < one.stop))
            for one in self.segments
            if not kinds or one.kind in kinds
        ]
        return [rows for rows in found if len(rows)]


def read_protocol(path: pathlib.Path | str) -> Protocol:
    """Reads a protocol.yaml.

    Raises:
      FileNotFoundError, ValueError: no file, no YAML, another schema, or invalid segments.
    """
    document = read_yaml(path, "protocol", _REMEDY)
    if document.get("schema") != SCHEMA:
        raise ValueError(
            f"{path} has schema {short_repr(document.get('schema'))}, {SCHEMA!r} is needed: {_REMEDY}"
        )
    entries = {"schema": str, "segments": list[dict]}
    refuse_unknown(document, entries, str(path))
    check_entries(str(path), document, entries)
    known = {"kind": str, "start": float, "stop": float, "against": str}
    segments = []
    for number, item in enumerate(document["segments"], 1):
        where = f"segment {number} of {path}"
        refuse_unknown(item, known, where)
        check_entries(where, item, known, ["against"])
        segments.append(Segment(**item))
    return Protocol(tuple(segments))


def write_protocol(path: pathlib.Path | str, protocol: Protocol) -> None:
    """Writes a protocol.yaml, whole or not at all."""
    import yaml

    segments = [dataclasses.asdict(one) for one in protocol.segments]
    with replacing(path) as temporary:
        text = yaml.safe_dump({"schema": SCHEMA, "segments": segments}, sort_keys=False)
        temporary.write_text(text)


class Prompter:
    """Announces each step of a plan when it is due, during a recording, and notes the time.

    Args:
      plan: the steps and their durations. report: prints a line.

    Use as a context manager around the recording.
    """

    def __init__(self, plan: Protocol, report: Callable[[str], None] = print):
        self.plan, self.report, self.spoken = plan, report, []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self.begun = clock.time()
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()
        self.ended = clock.time()

    def _run(self):
        before = 0.0
        for one in self.plan.segments:
            ready = f" against {one.against}" if one.against and STEPS[one.kind].touched else ""
            self.report(f"next, {one.stop - one.start:g} s{ready}: {STEPS[one.kind].line}")
            if self._stop.wait(max(self.begun + one.start - clock.time(), 0)):
                return
            self.spoken.append((one, clock.time()))
            self.report(f"now: {one.kind}")
            before = one.stop
            if self._stop.wait(max(self.begun + before - clock.time(), 0)):
                return
        self.report("done")

    def timeline(self, time: Sequence[float]) -> Protocol:
        """The segments as announced, since the first of the recording's rows (n,) [s].

        The rows' clock is used if it is this machine's. A clock of messages has another origin, so its first
        row is taken as the start of the recording."""
        here = self.begun - 1 <= time[0] <= self.ended
        first = time[0] if here else self.begun
        last = min(self.ended - first, time[-1] - time[0])
        segments = []
        for one, began in self.spoken:
            start = max(float(began - first), 0.0)
            stop = float(min(start + one.stop - one.start, last))
            if stop > start:
                segments.append(dataclasses.replace(one, start=round(start, 3), stop=round(stop, 3)))
        return Protocol(tuple(segments))
