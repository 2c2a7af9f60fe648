"""`biotac diagnose --simulate`."""

import pathlib

from ...effects.plate import PLATE, PlateEffect
from ...geometry.design import check_nelectrode
from ...geometry.skins import load_skin, shipped_skin
from ...recordings.recording import designed
from ..recordings.recording import PlainRecording
from ..recordings.search import RecordingDiagnosis, diagnose_recording
from ..report.text import summary
from .diagnosis import Simulated, diagnose_simulated
from .report import verdict_of, write_simulated
from .tables import base_response, with_effects

__all__ = ["diagnose_with_states"]

_SKIN = "coarse"  # of the tables of states: the default's take ten times as long


def diagnose_with_states(
    recordings: list[PlainRecording],
    folder: pathlib.Path,
    quiet: bool = False,
    effects: tuple[PlateEffect, ...] = PLATE,
    first: RecordingDiagnosis | None = None,
) -> Simulated:
    """Diagnoses recordings of flat presses against simulated states, prints and writes what it found, beside
    what `first` found in the first of them alone (None: it is diagnosed).

    Raises:
      ValueError: a recording without force, or with too few loaded rows.
    """
    for k, one in enumerate(recordings):
        if one.force is None:
            raise ValueError(f"{one.name}: no force, which a fit of states needs: give Fx Fy Fz [N]")
        if [r.name for r in recordings].count(one.name) > 1:
            one.name = f"{one.name} ({k + 1})"
    design = designed(recordings[0].electrodes)
    for one in recordings:
        check_nelectrode(design, one.electrodes.shape[1], one.name)
    geometry = load_skin(shipped_skin(design, _SKIN))
    base, straight, states = base_response(geometry, quiet)
    response = with_effects(base, states, geometry, effects, quiet)
    found = diagnose_simulated(recordings, response, straight, effects, quiet)
    first = diagnose_recording(recordings[0], progress=not quiet) if first is None else first
    print(summary(verdict_of(found)))
    print("  " + " ".join(str(f) for f in write_simulated(found, first, folder)[:3]))
    return found
