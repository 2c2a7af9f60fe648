"""Remarks of a report: on the base model, on the poses, on effects that the data cannot show, and on
trajectories and electrodes with large errors of their own."""

import typing

import numpy as np

from ..report.verdict import experiments
from .base.nuisance import OTHER_MESH
from .where import phases

if typing.TYPE_CHECKING:
    from ..report.verdict import Finding
    from .fitting import Fit
    from .search import Search
    from .trajectory import Trajectory
    from .whitening import Comparison

_ASTRAY = 0.25  # of the trajectories, that may be off whatever is named
# Mean square of one trajectory above a second equilibrium at an edge, which gave at most 5.2 in 41 contacts
# of sensors without effects; rubber that stiffens gave 28 in the only deep press of eleven.
_FAR = 10.0
_SEEN = 3.0  # [nats] of all trajectories together, with which an effect can be seen
_OFF = 2.5  # mean square from which on a trajectory is off


def astray(fitted: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Indices of trajectories that disagree, by mean squares of the fitted ones and then of the held-out
    ones: where these are more than `steady` leaves out, or more than half of the held-out ones; else those
    with very large errors."""
    square = np.concatenate([fitted, aside])
    off = square > _OFF
    many = off.mean() > _ASTRAY or off[len(fitted) :].mean() > 0.5
    return np.flatnonzero(off if many else square > _FAR)


def few_off(square: np.ndarray) -> bool:
    """Whether no more than half of the trajectories with these mean squares are off."""
    return bool(np.mean(square > _OFF) <= 0.5)


def strays(comparison: "Comparison", null: "Fit", chosen: np.ndarray, aside: np.ndarray, step: list) -> str:
    """Remark on trajectories that disagree, if too few of their kind were fitted for evidence: two slides of
    six trajectories are what any base model may be off by, two more of the held-out ones are not; and one
    press of eleven that bears a load which no other has is all that there is of it.

    Args:
      step: Candidates of a round."""
    square = null.mean_square(comparison)
    off = np.concatenate([chosen, aside])[astray(square[chosen], square[aside])]
    if not len(off):
        return ""
    raw = null.raw(comparison)
    names = ", ".join(comparison.trajectories[i].id for i in np.sort(off))
    worst = max(off, key=lambda i: (comparison.vector(i, raw[i]) ** 2).sum())
    what = f"{names} disagree{'s' if len(off) == 1 else ''}, {_size(comparison, worst, raw[worst])}"
    left = [(float(c.fit.mean_square(comparison)[off].mean()), c.effect.name) for c in step]
    best = min(left, default=(np.inf, ""))
    hint = f"; {best[1]} would explain it" if best[0] < 0.5 * square[off].mean() else ""
    return f"{what}: too few of them were fitted to tell by what{hint}; measure more like them"


def _size(comparison, i, residual) -> str:
    """Error of a trajectory and its largest value, in the channel group with the largest relative error."""
    loud = {g: np.mean((residual[:, s] / comparison.sigmas[i][s]) ** 2) for g, s in comparison.groups.items()}
    group = max(loud, key=loud.get)
    part = comparison.groups[group]
    error, of = (float(np.abs(x[:, part]).max()) for x in (residual, comparison.measured[i]))
    unit = "N" if group == "force" else "counts"
    return f"{group} by up to {error:.3g} {unit} of {of:.3g} in {comparison.trajectories[i].id}"


def of_base(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> list[str]:
    """Remarks on the base model and the poses by the fitted nuisance parameters; they name no effect."""
    nuisance, sim = fit.nuisance, comparison.sim
    poses = comparison.poses(fit.effects, nuisance)[chosen]
    mean, error = poses.mean(0), poses.std(0, ddof=1) / np.sqrt(len(chosen))
    far = np.abs(mean) > 3 * np.hypot(error, comparison.repeatability / np.sqrt(len(chosen)))
    said = {
        f"the base model was calibrated first: its modulus times {nuisance.modulus:.2f} fits the data": (
            abs(nuisance.log_modulus) > 0.2
        ),
        f"the poses of all trials are off by {np.round(1e3 * mean, 3).tolist()} mm on average, which no "
        "effect found takes up: check the set-up, or the base model": far.any(),
        f"the film where the skin lies on the core times {np.exp(nuisance.log_film):.2f} fits the data": (
            abs(nuisance.log_film) > 0.2
        ),
        f"the base model's contact footprint is {nuisance.footprint:+.0%} off: calibrate before looking for "
        "small effects": abs(nuisance.footprint) > 0.05,
        f"the data lie nearer to the mesh {OTHER_MESH.get(sim.skin)!r} than to {sim.skin!r}: use that one": (
            nuisance.mesh > 0.5
        ),
    }
    return [text for text, so in said.items() if so]


def of_data(data: "list[Trajectory]", comparison: "Comparison") -> list[str]:
    """Remarks on effects that trajectories like these cannot show."""
    most = {name: max(phases(t)[name].sum() for t in data) for name in ("unload", "free", "hold")}
    said = {
        f"{len(data)} trajectories: small effects stay unseen": len(data) < 12,
        "no unloading was recorded: hysteresis, adhesion and Mullins softening cannot be known": (
            not most["unload"]
        ),
        "no free segment: drift and warm-up cannot be told from load; begin each trajectory before the "
        "touch": most["free"] < 2,
        "no holds: relaxation cannot be told from hysteresis": most["hold"] < 4,
        "no force: the rubber's modulus shows in the liquid's pressure alone": not comparison.has_force,
    }
    return [text for text, so in said.items() if so]


def of_search(search: "Search") -> list[str]:
    """Remark on the effects that these data would hardly show."""
    names = ", ".join(effect.name for _, effect, visible in search.unseen if visible < _SEEN)
    return [f"too small to show in these data at a realistic size: {names}"] if names else []


def next_experiment(
    effects: "list[Finding]", suspected: "list[Finding]", names: dict, unknown: bool, tier: str
) -> str:
    """Recommends the next experiment.

    Args:
      effects: Findings, the one that explains most first. suspected: those that are less likely than not.
      names: id -> name of the effects that were looked for.
      unknown: whether something is left that no effect explains.
      tier: of the skin with which the recording was compared.
    """
    out = []
    if tier == "condensed" and (effects or unknown):
        out.append("compare again with --tier full: what the condensed skin lacks may be taken for an effect")
    out += experiments([*suspected, *effects], names)
    if unknown and not effects:
        out.append("repeat some trajectories unchanged: what does not come again is no effect of the sensor")
    return "; ".join(out) or "none needed: nothing is tied, and nothing is left"
