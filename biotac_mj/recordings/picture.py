"""A recording on one page."""

import pathlib

import numpy as np

from ..files import check_output_file, picture_kind, save_figure
from ..sensor.acquisition_kernels import SLOT_RATE
from ..sensor.colors import change_map, line_color
from .recording import Recording, check_recording

_REST = 0.02  # fraction of rows whose median is the baseline
_RATE = SLOT_RATE / 2  # [Hz] of samples
_WINDOW = 176  # samples of a spectrum: 12.5 Hz apart
_AXES = ("x", "y", "z")
_SHORT = {
    "tared counts": "counts, tared",
    "tared counts without sign": "|counts|, tared",
    "normalised": "of full scale",
}


def pac_spectrum(recording: Recording) -> tuple[np.ndarray, np.ndarray, int] | None:
    """(frequency [Hz], power density [unit^2/Hz], number of frames) of PAC, averaged over gap-free stretches
    of new frames; None if there is no complete frame."""
    from scipy.signal import welch

    if recording.pac is None:
        return None
    good = np.isfinite(recording.pac).all(1) & ~recording.repeated
    if good.sum() < 2:
        return None
    step = np.diff(recording.time[good])
    new = max(1, round(_RATE * float(np.median(step))))  # rows may be less than a frame apart
    frames = recording.pac[good][:, -new:]
    ends = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    stretches = [part.ravel() for part in np.split(frames, ends)]
    size = min(_WINDOW, int(np.median([len(one) for one in stretches])))
    if size < frames.shape[1]:
        return None
    made = [
        (len(one), *welch(one, _RATE, nperseg=size, detrend="linear"))
        for one in stretches
        if len(one) >= size
    ]
    weight = np.array([n for n, _, _ in made], float)
    return made[0][1], np.average([power for _, _, power in made], axis=0, weights=weight), len(frames)


def draw(recording: Recording, path: pathlib.Path | str) -> None:
    """Draws the channels over time and the spectrum of PAC into a picture file.

    Raises:
      TypeError: not a Recording. ValueError: the path cannot be written, or is no picture.
    """
    check_recording(recording)
    check_output_file(path)
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    kind = picture_kind(path)
    panels = [
        (draw_one, size)
        for draw_one, size, wanted in _PANELS
        if any(getattr(recording, f) is not None for f in wanted)
    ]
    spectrum = pac_spectrum(recording)
    sizes = [size for _, size in panels] + ([1.4] if spectrum else [])
    figure = Figure(figsize=(11, 1.35 * sum(sizes) + 0.8), layout="constrained")
    axes = figure.subplots(len(sizes), 1, height_ratios=sizes, squeeze=False)[:, 0]
    time = recording.time - recording.time[0]
    for axis, (draw_one, _) in zip(axes, panels):
        draw_one(axis, time, recording)
        axis.set_xlim(time[0], max(time[-1], 1e-9))
        if axis is not axes[len(panels) - 1]:
            axis.tick_params(labelbottom=False)
    axes[len(panels) - 1].set_xlabel("time [s]")
    if spectrum:
        frequency, power, frames = spectrum
        axes[-1].semilogy(frequency[1:], power[1:], color="C4", lw=1)
        axes[-1].set(xlabel=f"frequency [Hz], {frames} frames of PAC", xlim=(0, frequency[-1]))
        axes[-1].set_ylabel(f"PAC\n[({_short(recording, 'pac')})²/Hz]", fontsize=8)
    what = f", {recording.object}" if recording.object else ""
    figure.suptitle(f"{recording.name}{what}: {len(recording)} rows, {recording.rate:.4g} Hz", fontsize=11)
    save_figure(path, figure, kind=kind)


def _short(recording, name):
    unit = recording.unit(name)
    return _SHORT.get(unit, unit)


def _change(recording):
    """Change of the electrodes from their baseline, and its description; tared values are unchanged. The
    baseline is of the rows with the least force, or else PDC: a recording may start under load."""
    value, unit = recording.electrodes, _short(recording, "electrodes")
    if recording.unit("electrodes").startswith("tared"):
        return value, f"[{unit}]"
    order, since = np.arange(len(value)), "since the start"
    if recording.force is not None:
        order, since = np.argsort(np.linalg.norm(recording.force, axis=1), kind="stable"), "from least force"
    elif recording.pdc is not None:
        order, since = np.argsort(recording.pdc, kind="stable"), "from least PDC"
    rest = np.nanmedian(value[order[: max(5, int(_REST * len(value)))]], axis=0)
    return value - rest, f"{since}\n[{unit}]"


def _map(axis, time, recording):
    value, unit = _change(recording)
    step = np.median(np.diff(time)) if len(time) > 1 else 1.0
    # a gap is an empty column
    gap = np.flatnonzero(np.diff(time) > 1.5 * step)
    edge = np.insert(time, gap + 1, time[gap] + step)
    edge = np.append(edge, time[-1] + step)
    value = np.insert(value, gap + 1, np.nan, axis=0)
    reach, n = np.nanpercentile(np.abs(value), 99.5) or 1.0, value.shape[1]
    picture = axis.pcolormesh(
        edge, np.arange(0.5, n + 1), value.T, cmap=change_map(), vmin=-reach, vmax=reach, rasterized=True
    )
    axis.set(yticks=[1, *range(5, n - 1, 5), n], ylim=(n + 0.5, 0.5))
    axis.set_ylabel("electrode")
    axis.figure.colorbar(picture, ax=axis, pad=0.01, aspect=12).set_label(unit.replace("\n", " "), fontsize=8)


def _lines(axis, time, recording):
    value, unit = _change(recording)
    time, value = _broken(time, value)
    for k, column in enumerate(value.T):
        axis.plot(time, column, lw=0.6, color=line_color(k, value.shape[1]), label=f"e{k + 1}")
    axis.margins(y=0.25)
    axis.legend(ncols=10, fontsize=6, loc="upper left", handlelength=1, framealpha=0.6)
    axis.set_ylabel("electrodes\n" + unit.replace("\n", " "), fontsize=8)


def _plain(name, color, label):
    def paint(axis, time, recording):
        axis.plot(*_broken(time, getattr(recording, name)), lw=0.8, color=color)
        axis.set_ylabel(f"{label}\n[{_short(recording, name)}]", fontsize=8)

    return paint


def _pac(axis, time, recording):
    with np.errstate(all="ignore"):
        low, high = np.nanmin(recording.pac, 1), np.nanmax(recording.pac, 1)
    axis.fill_between(*_broken(time, low, high), color="C4", lw=0.5, alpha=0.8)
    axis.set_ylabel(f"PAC, range\n[{_short(recording, 'pac')}]", fontsize=8)


def _temperature(axis, time, recording):
    for name, color, side in (("tdc", "C3", axis), ("tac", "C1", None)):
        if getattr(recording, name) is None:
            continue
        here = side or (axis.twinx() if recording.tdc is not None else axis)
        here.plot(*_broken(time, getattr(recording, name)), lw=0.8, color=color)
        here.set_ylabel(f"{name.upper()}\n[{_short(recording, name)}]", fontsize=8, color=color)


def _vector(name, label):
    def paint(axis, time, recording):
        value = getattr(recording, name)
        if name.endswith("_pos"):
            value = 1e3 * (value - np.nanmedian(value, axis=0))
        time, value = _broken(time, value)
        for k, column in enumerate(value.T):
            axis.plot(time, column, lw=0.8, label=_AXES[k])
        axis.set_ylabel(label, fontsize=8)
        axis.legend(fontsize=7, loc="upper left", ncols=3, handlelength=1)

    return paint


def _broken(time, *values):
    """Times and values (n, ...) with one more row in every gap, where lines break."""
    step = np.diff(time)
    gap = np.flatnonzero(step > 3 * np.median(step)) if len(step) else np.zeros(0, int)
    return np.insert(time, gap + 1, time[gap] + 1e-9), *(np.insert(v, gap + 1, np.nan, 0) for v in values)


# drawing function, its height, and the fields of which it needs one
_PANELS = (
    (_map, 2.2, ("electrodes",)),
    (_lines, 2.0, ("electrodes",)),
    (_plain("pdc", "C0", "PDC"), 1, ("pdc",)),
    (_pac, 1, ("pac",)),
    (_temperature, 1, ("tdc", "tac")),
    (_vector("force", "force [N]"), 1.2, ("force",)),
    (_vector("torque", "torque [N m]"), 1, ("torque",)),
    (_vector("contact_pos", "contact, from\nits median [mm]"), 1, ("contact_pos",)),
    (_vector("object_pos", "object, from\nits median [mm]"), 1, ("object_pos",)),
    (_vector("sensor_pos", "sensor, from\nits median [mm]"), 1, ("sensor_pos",)),
)
