"""`biotac learn judge` of a recording: reconstruction and force on a real recording, trained on the first 70
% of the time, tested on the last 30 %."""

import pathlib
import time

import numpy as np

from ...files import save_figure, write_json
from ...recordings.recording import Recording
from ...sensor.channels import FULL_SCALE
from ..protocol import check_changes, is_better, quartiles
from .examples import blocks
from .force import TRIALS, fit_force
from .linear import principal_components, ridge

_CODE = 8
_BATCH, _EPOCHS, _STEPS = 128, 60, (3000, 6000)  # fewest and most steps
_KL = 1e-4
# of ln Z: augmentation by a common gain, as large as the drift of a few minutes of warm-up
_GAIN = 0.05
_SHORTEST = 400  # rows: fewer are too few for a split in time with walk-forward selection


def evaluate_recording(
    recording: Recording,
    out: pathlib.Path | str = "out/evaluate/recording.json",
    fraction: float = 0.7,
    seed: int = 0,
    network: bool = True,
    progress: bool = True,
) -> dict:
    """Evaluates one recording; writes `out` (JSON, described in docs/lab/learning.md) and a plot next to it.

    Args:
      recording: without force only the reconstruction is evaluated.
      fraction: of the rows, in time, for training; everything is fitted on them only.
      seed: of the network.
      network: False: PCA in place of the network (seconds, for tests).

    Returns:
      the written content.

    Raises:
      ValueError: electrodes that cannot be converted to raw counts, too few rows, constant electrodes or
        force.
    """
    from tqdm import tqdm

    begun = time.time()
    recording, counts, notes = _usable(recording)
    if not 0.2 <= fraction <= 0.95:
        raise ValueError(f"fraction {fraction} leaves too little on one side: take 0.2 to 0.95, as 0.7")
    n = len(counts)
    ntrain = int(fraction * n)
    saturated = ((counts <= 0) | (counts >= FULL_SCALE)).mean(0)
    notes += [
        f"e{i + 1} reads 0 or 4095 in {100 * saturation:.1f} % of the rows: its impedance is not known there"
        for i, saturation in enumerate(saturated)
        if saturation > 0.001
    ]
    steps = int(np.clip(_EPOCHS * ntrain // _BATCH, *_STEPS)) if network else 0
    with tqdm(total=steps, desc="evaluate: code", disable=not progress or None, leave=False) as bar:
        reconstruction, traces = _reconstruction(counts, ntrain, seed, steps, bar)
    result = {
        "schema": "biotac_mj.learning.recording/4",
        "recording": recording.name,
        "source": recording.source,
        "rows": n,
        "train_rows": ntrain,
        "seed": seed,
        "notes": notes,
        "saturated": saturated.tolist(),
        "reconstruction": reconstruction,
    }
    predicted = None
    if recording.force is not None:
        # separate progress bar: steps of networks and trials take different times
        with tqdm(total=TRIALS, desc="evaluate: force", disable=not progress or None, leave=False) as bar:
            result["force_regression"], predicted = _force(counts, recording.force, ntrain, bar)
        result["notes"] += _unjudged(result["force_regression"]["models"], recording.force, ntrain)
        result["notes"] += _useless(predicted, recording.force, ntrain)
    else:
        result["notes"].append("no force: the force regression was left out")
    result["seconds"] = round(time.time() - begun, 1)
    out = pathlib.Path(out)
    picture = out.with_suffix(".png")
    _plot(counts, recording.force, ntrain, traces, predicted, result, picture)
    result["plot"] = str(picture)
    write_json(out, result)
    return result


def _usable(recording):
    """(recording, (n, nelectrode) counts, notes): the rows with all evaluated quantities."""
    notes = []
    if recording.force is not None:
        there = np.isfinite(recording.force).all(1)
        if not there.all():
            notes.append(f"{(~there).sum()} rows without force were left out")
            recording = recording.rows(there)
    counts, assumed = recording.counts()
    if len(counts) < _SHORTEST:
        raise ValueError(
            f"{recording.name} has {len(counts)} rows: at least {_SHORTEST} are needed for a split in time: "
            "record longer"
        )
    if not np.ptp(counts, axis=0).any():
        raise ValueError(
            f"{recording.name}: no electrode changes: this is no recording of a touch; check the sensor and "
            "record again"
        )
    if recording.force is not None:
        check_changes(recording.name, recording.force)
    return recording, counts, notes + assumed


def _rms(error):
    row = np.sqrt((error**2).mean(1))
    median, *others = quartiles(row)
    return {
        "rms": float(np.sqrt((error**2).mean())),
        "median_row": median,
        "quartiles_row": others,
        "per_channel": np.sqrt((error**2).mean(0)).tolist(),
    }


def _reconstruction(counts, ntrain, seed, steps, bar):
    mean, axes, _ = principal_components(counts[:ntrain])
    code = (counts - mean) @ axes[:, :_CODE]
    rows = {"predict_mean": np.broadcast_to(mean, counts.shape), "pca8": code @ axes[:, :_CODE].T + mean}
    if steps:
        rows["electrode_vae"] = np.clip(_through_code(counts, ntrain, seed, steps, bar), 0, FULL_SCALE)
    table = {
        name: {"train": _rms((y - counts)[:ntrain]), "test": _rms((y - counts)[ntrain:])}
        for name, y in rows.items()
    }
    # Differences of neighbouring rows contain a channel's white noise and the slow motion of a press: an
    # upper bound.
    noise = np.diff(counts[ntrain:], axis=0)
    noise = 1.4826 * np.median(np.abs(noise - np.median(noise, axis=0)), axis=0) / np.sqrt(2)
    best = min(
        (name for name in table if name != "predict_mean"), key=lambda name: table[name]["test"]["rms"]
    )
    return {
        "unit": "counts",
        "code": _CODE,
        "models": table,
        "best": best,
        "noise_rms": float(np.sqrt((noise**2).mean())),
    }, rows[best]


def _through_code(counts, ntrain, seed, steps, bar):
    """(n, nelectrode) counts through a code of 8 of the paper's network, trained on the first ntrain rows for
    so many steps."""
    import torch

    from ..networks.electrode_vae import ElectrodeVAE
    from ..training.fitting import TrainingOptions, train

    torch.manual_seed(seed)
    size, mean = counts[:ntrain].std(), counts[:ntrain].mean(0)  # one scale for all channels
    steep = -counts * (1 - counts / FULL_SCALE) / size  # change of counts with a common change of ln Z
    x, common = (torch.tensor(value, dtype=torch.float32) for value in ((counts - mean) / size, steep))
    net = ElectrodeVAE(counts.shape[1])

    def loss(row):
        return net.loss(x[row] + _GAIN * torch.randn(len(row), 1) * common[row], _KL)

    options = TrainingOptions(_BATCH, steps, 1e-3, seed=seed)
    train(net, loss, torch.arange(ntrain), options, progress=bar.update)
    with torch.no_grad():
        return net(x)[0].numpy() * size + mean


def _force(counts, force, ntrain, bar):
    model = fit_force(counts, force, ntrain, bar.update)
    w, b = ridge(counts[:ntrain], force[:ntrain], 1e-4)
    rows = {
        "predict_mean": np.broadcast_to(force[:ntrain].mean(0), force.shape),
        "linear_counts": counts @ w + b,
        "drift_aware": model.prediction,
    }
    table = {name: _errors(y[ntrain:], force[ntrain:]) for name, y in rows.items()}
    return {
        "unit": "N",
        "components": ["Fx", "Fy", "Fz"],
        "models": table,
        "best": min(table, key=lambda name: np.sum(np.square(table[name]["rmse"]))),
        "details": {"left_out": model.trials},
    }, rows["drift_aware"]


def _errors(predicted, truth):
    """RMSE [N] and R2 on the test rows; R2 is null for a component that is constant there."""
    square = ((predicted - truth) ** 2).mean(0)
    r2 = 1 - square / np.maximum(truth.var(0), 1e-12)
    changes = np.ptp(truth, axis=0) > 0
    return {
        "rmse": np.sqrt(square).tolist(),
        "r2": [float(one) if change else None for one, change in zip(r2, changes)],
    }


def _unjudged(models, force, ntrain):
    """Notes on constant components of the force; one that is constant everywhere has no error (None)."""
    notes = []
    for k, axis in enumerate("xyz"):
        changes = [bool(np.ptp(part[:, k])) for part in (force, force[:ntrain], force[ntrain:])]
        if not changes[0]:
            notes.append(f"F{axis} never changes: it is not judged")
            for errors in models.values():
                errors["rmse"][k] = None
        elif not all(changes):
            part = "unseen" if changes[1] else "training"
            notes.append(
                f"F{axis} does not change in the {part} rows, its error says little: record touches there"
            )
    return notes


def _useless(predicted, force, ntrain):
    """A note if the model is not significantly better than the mean on blocks of unseen rows."""
    error, mean = (y[ntrain:] - force[ntrain:] for y in (predicted, force[:ntrain].mean(axis=0) + 0 * force))
    block = blocks(len(force))[ntrain:]
    better = [is_better(error[:, k : k + 1], mean[:, k : k + 1], block) for k in range(3)]
    axes = [f"F{axis}" for k, axis in enumerate("xyz") if np.ptp(force[:, k]) and not better[k]]
    if not axes:
        return []
    return [f"{', '.join(axes)}: drift_aware is no better than the mean here: record more touches like these"]


def _plot(counts, force, ntrain, reconstructed, predicted, result, path):
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    strong = np.argsort(counts.std(0))[::-1][:2]
    rows = 2 + (3 if predicted is not None else 0)
    figure = Figure(figsize=(11, 2.1 * rows), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True)
    t = np.arange(len(counts))
    best = result["reconstruction"]["best"]
    for axis, k in zip(axes, strong):
        axis.plot(t, counts[:, k], lw=0.8, color="0.6", label="measured")
        axis.plot(t, reconstructed[:, k], lw=0.6, color="C0", label=f"{best}, code of 8")
        axis.set_ylabel(f"E{k + 1} [counts]")
    axes[0].set_title(
        f"last {len(t) - ntrain} rows unseen; reconstruction "
        f"{result['reconstruction']['models'][best]['test']['rms']:.1f} counts RMS"
    )
    if predicted is not None:
        error = [
            "no change" if e is None else f"RMSE {e:.3f} N unseen"
            for e in result["force_regression"]["models"]["drift_aware"]["rmse"]
        ]
        for axis, k in zip(axes[2:], range(3)):
            axis.plot(t, force[:, k], lw=0.8, color="0.6", label="measured")
            axis.plot(t, predicted[:, k], lw=0.6, color="C3", label=f"from electrodes, {error[k]}")
            axis.set_ylabel(f"F{'xyz'[k]} [N]")
    for axis in axes:
        axis.axvspan(ntrain, len(t), color="C2", alpha=0.08, lw=0)
        axis.legend(loc="upper left", fontsize=7, framealpha=0.8)
    axes[-1].set_xlabel("row")
    save_figure(path, figure)
