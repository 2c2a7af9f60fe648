"""What a recording shows of how it was logged: clock, dropped and held rows, units, channels that are
stuck."""

import numpy as np

from ..sensor.channels import FULL_SCALE
from .recording import CHANNELS, FIELDS, REST_LIKE, Recording

__all__ = ["findings"]

_HELD = 0.02  # share of repeated rows: fewer are chance


def findings(recording: Recording) -> list[str]:
    """One line each; the first says what there is."""
    n, rate = len(recording), recording.rate
    duration = recording.time[-1] - recording.time[0]
    out = [
        f"{n} rows, {duration:.2f} s, {rate:.4g} Hz ({recording.rate_source}); {', '.join(recording.fields)}"
        + (f"; object {recording.object}" if recording.object else "")
    ]
    return (
        out
        + _gaps(recording)
        + _held(recording)
        + _units(recording)
        + _stuck(recording)
        + _missing(recording)
    )


def _gaps(recording):
    if len(recording) < 3:
        return []
    step = np.diff(recording.time)
    usual = np.median(step)
    gap = step > 1.5 * usual
    if not gap.any():
        return ["clock: no gap"] if recording.rate_source == "the file's times" else []
    worst = int(np.argmax(step))
    lost = np.rint(step[gap] / usual - 1).sum()
    return [
        f"clock: {gap.sum()} gap{'s' * int(gap.sum() > 1)}, the longest {step[worst]:.3g} s after row "
        f"{worst}; "
        f"about {lost:.0f} rows were dropped ({lost / (lost + len(recording)):.1%})"
    ]


def _held(recording):
    held = recording.repeated
    if not held.any():
        return []
    text = f"repeated rows: {held.sum()} ({held.mean():.1%})"
    if held.mean() > _HELD:
        text += f", values are held, new ones come at {recording.rate * (1 - held.mean()):.3g} Hz"
    return [text]


def _units(recording):
    said = {}
    for name in CHANNELS:
        if getattr(recording, name) is not None:
            said.setdefault(recording.unit(name), []).append(name)
    out = [f"units: {'; '.join(f'{unit}: ' + ', '.join(names) for unit, names in said.items())}"]
    if "tared counts without sign" in said:
        out.append(
            "the sign is lost: values are never negative and rest near zero; use energies, not waveforms"
        )
    return out


def _stuck(recording):
    out = []
    value = recording.electrodes
    if value is None:
        return out
    still = np.flatnonzero(np.nanmax(value, 0) == np.nanmin(value, 0)) if len(value) > 1 else []
    if len(still) == value.shape[1]:
        out.append("no electrode changes: this is no recording of a touch")
    elif len(still):
        out.append(f"electrodes that never change: {', '.join(f'e{i + 1}' for i in still)}")
    if recording.unit("electrodes") == "counts":
        share = ((value <= 0) | (value >= FULL_SCALE)).mean(0)
        full = [f"e{i + 1} {share[i]:.1%}" for i in np.flatnonzero(share > 0.001)]
        if full:
            out.append(f"saturated (0 or 4095 counts): {', '.join(full)}")
    if recording.rest_correlation < REST_LIKE:
        out.append(
            f"rest levels are unlike published BioTacs' (correlation {recording.rest_correlation:.2f}): "
            "is this another sensor, or are the columns in another order than e1..e19?"
        )
    return out


def _missing(recording):
    out = []
    for name in recording.fields:
        value = getattr(recording, name).reshape(len(recording), -1)
        share = 1 - np.isfinite(value).mean()
        if share > 0 and FIELDS[name].width != 22:
            out.append(f"{name}: not there in {share:.1%} of its values")
    return out
