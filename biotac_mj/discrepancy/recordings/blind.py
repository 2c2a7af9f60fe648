"""Effects of the catalogue that a plain recording cannot show, because it lacks data that they require."""

import math

from ...effects.catalogue import entries
from ...effects.effect import Entry
from ...effects.logged import LOGGED
from .model import LEAST, WINDOW
from .recording import FORCE_MOVED
from .session import Session


def not_identifiable(session: Session) -> list[str]:
    """A line for each kind of data that the recording lacks (`Effect.requires`), with the names of the
    effects that require it. An effect is listed in the first of them."""
    lacking, kinds = _lacking(session), _by_need(session)
    return [
        f"{text}: {', '.join(e.name for e in kinds[need])}" for need, text in lacking.items() if need in kinds
    ]


def searched(session: Session) -> list[Entry]:
    """The effects that the recording has the data for."""
    return _by_need(session).get(None, [])


def _by_need(session):
    """Effects by the first of what they require that the recording lacks, None where it lacks nothing."""
    lacking, kinds = _lacking(session), {}
    for effect in {e.id: e for e in (*entries("poses"), *LOGGED, *entries("log"))}.values():
        first = next((need for need in lacking if need in effect.requires), None)
        kinds.setdefault(first, []).append(effect)
    return kinds


def _lacking(session):
    """Keys of `Effect.requires` that the recording lacks, with a description each."""
    r, out = session.recording, {}
    if r.force is None:
        out["force"] = "no force"
    if r.tdc is None:
        out["tdc"] = "no TDC"
    if not r.absolute:
        out["rest"] = (
            f"the electrodes are {r.unit}, their rest is assumed, as is that of the amended sensor, and the "
            "ends of the converter are not known"
        )
    if not r.signed:
        out["sign"] = "the electrodes have no sign"
    if r.joints:
        out["time"] = "series that were put together, which one clock does not go through"
    elif not session.model().parted:
        least = math.ceil(LEAST / session.fit.mean())
        out["time"] = f"too short to tell touches from drift, record {least} s or more"
    elif not session.loaded and r.force is not None and r.force.std(0).max() > FORCE_MOVED:
        out["load"] = (
            "touches could not be told from drift, record some at several places that each change electrodes "
            f"by tens of counts within {WINDOW[0]:g} s"
        )
    elif not session.loaded:
        out["load"] = "not loaded"
    out["change"] = "told only where it begins or ends here, not where it holds throughout or comes slowly"
    if session.protocol is None:
        out["protocol"] = "no checkup, whose steps tell these, and no poses"
    out["poses"] = "no poses of what touched, with which `diagnose` searches these"
    return out
