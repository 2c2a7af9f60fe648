"""The sensor of a recording with what simulation in the loop names in it, as a file that a simulation can
run."""

import dataclasses

from ...effects.plate import PLATE, PlateEffect
from ...effects.sensor_file import SensorFile
from ...skin import Material
from ...skin.rubber.material import PRESETS
from ...skin.settings import plain
from ..recordings.amended import amended_sensor
from ..recordings.search import RecordingDiagnosis
from .diagnosis import Candidate, Simulated

__all__ = ["acting", "amended_simulated", "attached"]


def attached(finding: Candidate, effects: tuple[PlateEffect, ...] = PLATE) -> list[dict] | None:
    """What `biotac_mj.attach` takes to have a finding, by sensor; None where no running sensor can."""
    give = next((one.attach for one in effects if one.id == finding.id), None)
    return give and [give(sum(t.value) / len(t.value)) for t in finding.tested]


def acting(found: Simulated) -> Candidate | None:
    """Of what is named and can act in a model, tied or not, that which takes most away."""
    named = [f for f in found.tried if f.id in found.named and attached(f)]
    return max(named, key=lambda f: min(t.worst.closed for t in f.tested), default=None)


def amended_simulated(found: Simulated, first: RecordingDiagnosis) -> SensorFile:
    """The first recording's sensor (rest, noise, effects), with the rubber that its poses were fitted with
    and the skin's settings that its named effect asks for, if any."""
    file, finding = amended_sensor(first)[0], acting(found)
    if finding is None:
        return file
    rubber = Material(
        youngs_modulus=float(finding.tested[0].modulus),
        electrode_radius=PRESETS["calibrated"].electrode_radius,
    )
    given = attached(finding)[0]
    rubber = dataclasses.replace(rubber, **given.get("material", {}))
    base = {**file.base, "material": plain(rubber)}
    if "options" in given:
        base["options"] = given["options"]
    return SensorFile(base, file.effects, file.intervals)
