"""Estimates force, contact position and, through a code, the electrodes from single rows, each with an
interval, and a novelty score against the training rows. Saved as one file."""

import dataclasses
import functools
import hashlib
import pathlib

import numpy as np

from ...data.schema import SPLITS
from ...data.splits import assign, least_count
from ...fields import check_entries
from ...sensor.channels import FULL_SCALE, counts_from_log_impedance, log_impedance
from ..protocol import check_changes, conformal_width, is_better
from .examples import Examples
from .linear import best_ridge, principal_components
from .novelty import NoveltyDetector, StuckDetector, compressed
from .terms import KINDS, Terms

TARGETS = {"force": ("fx", "fy", "fz"), "place": ("x", "y", "z"), "electrodes": ()}  # names of columns
UNITS = {"force": "N", "place": "m", "electrodes": "counts"}
_LEVEL = 0.9  # of the intervals
_CODE = 8
_KNOWN = 1024  # fingerprints of rows that a model keeps
_SPACES = ("rows", "level")  # novelty of electrodes, and of baselines
_FOLDS = 4  # of whole trajectories, for the choice of a ridge
_RIDGE = (1e-4, 1e-3, 1e-2, 1e-1, np.inf)  # the last gives the mean


@dataclasses.dataclass(frozen=True)
class Prediction:
    """n rows.

    Attributes:
      value: target -> (n, k), of TARGETS: force [N], place [m], electrodes [counts]. half: target -> (n, k),
        half widths of the intervals.
      novelty: (n,) 1 at the 95 % quantile of ordinary rows; larger for a row or tare farther from the
        training data, or if an electrode does not move as predicted by the others.
    """

    value: dict[str, np.ndarray]
    half: dict[str, np.ndarray]
    novelty: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Reader:
    """A model; made by `fit_reader`, stored by `save`.

    Attributes:
      meta: description: "tared" (whether ln Z is relative to a tare), "level" of the intervals, "source",
        "useless" (names of outputs that the touches held out do not show to be better than the mean),
        "learned" (the least `fingerprints` of the rows that trained and calibrated it, rising).
      tensors: its parameters.
    """

    meta: dict
    tensors: dict[str, np.ndarray]

    @property
    def targets(self) -> list[str]:
        """Names of its outputs, of TARGETS."""
        return [name for name in TARGETS if f"{name}.half" in self.tensors]

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of its electrodes."""
        return tuple(f"e{i + 1}" for i in range(len(self.tensors["mean"])))

    def predict(
        self, counts: np.ndarray, tare: np.ndarray | None = None, pdc: np.ndarray | None = None
    ) -> Prediction:
        """Predictions for raw counts (n, nelectrode), each from its row only; novelty assumes rows in order.

        Args:
          tare: (nelectrode,) or (n, nelectrode) counts at rest, for a tared model. pdc: (n,) change of PDC
            from rest [counts], only for novelty, if it was in the training data.

        Raises:
          ValueError: a missing tare, or another number of electrodes.
        """
        n = len(self.electrodes)
        if np.shape(counts)[-1] != n:
            raise ValueError(
                f"this model reads {n} electrodes, and the rows have {np.shape(counts)[-1]}: take one of the "
                "same fingertip"
            )
        if self.meta["tared"] and tare is None:
            raise ValueError("this model reads changes from rest: --tare ROWS says how many rows are at rest")
        rest = log_impedance(tare) if self.meta["tared"] else np.zeros(n)
        x = log_impedance(counts) - rest
        strange = self._novelty(x, pdc)
        value, half = {}, {}
        for name in self.targets:
            out = self._code(x) if name == "electrodes" else self._regress(name, x)
            value[name] = counts_from_log_impedance(out + rest) if name == "electrodes" else out
            half[name] = self.tensors[f"{name}.half"] * (1 + strange)[:, None]  # hardly more where usual
        novelty = strange
        if self.meta["tared"]:  # an unusual baseline makes every row unusual
            level = self._novelty_detector["level"](np.atleast_2d(rest)) / self.tensors["level.usual"]
            novelty = np.where(level > 1, np.maximum(level, strange), strange)
        stuck = self._restored(StuckDetector, "moving")(x)
        novelty = np.where(stuck > 1, np.maximum(novelty, stuck), novelty)
        return Prediction(value, half, novelty)

    def known(self, counts: np.ndarray) -> float:
        """Share of different rows (n, nelectrode) that it learned from, estimated from those whose
        fingerprints are as small as the kept ones."""
        learned, found = self.meta.get("learned", []), fingerprints(counts)
        found = [one for one in found if one <= max(learned, default="")]
        return len({*found} & {*learned}) / max(len(found), 1)

    def _regress(self, name, x):
        out = 0.0
        for k in range(len(KINDS)):
            terms = self._restored(Terms, f"terms.{k}")(x)
            out = out + terms @ self.tensors[f"{name}.{k}.weight"] + self.tensors[f"{name}.{k}.offset"]
        return out / len(KINDS)

    def _restored(self, kind, name):
        """A dataclass of arrays from the tensors of `_stored`."""
        return kind(*(self.tensors[f"{name}.{field.name}"] for field in dataclasses.fields(kind)))

    def _code(self, x):
        t = self.tensors
        return (x - t["mean"]) @ t["axes"][:, :_CODE] @ t["axes"][:, :_CODE].T + t["mean"]

    @functools.cached_property
    def _novelty_detector(self):
        spaces = [space for space in _SPACES if f"{space}.rows" in self.tensors]
        return {space: self._restored(NoveltyDetector, space) for space in spaces}

    def _novelty(self, x, pdc):
        """(n,) novelty of rows, without that of their baseline."""
        features = compressed(x - self.tensors["centre"])
        if pdc is None or "pressed.usual" not in self.tensors:
            return self._novelty_detector["rows"](features) / self.tensors["rows.usual"]
        return self._novelty_detector["rows"](features, pdc) / self.tensors["pressed.usual"]

    def save(self, path: pathlib.Path | str) -> None:
        """Writes a safetensors file."""
        import torch

        from ..weights import write_tensors

        tensors = {
            name: torch.tensor(np.asarray(value), dtype=torch.float32) for name, value in self.tensors.items()
        }
        write_tensors(path, tensors, self.meta | {"direction": "reader", "channels": list(self.electrodes)})

    @classmethod
    def load(cls, path: pathlib.Path | str) -> "Reader":
        """Reads what `save` wrote.

        Raises:
          FileNotFoundError, ValueError: no such file, or no such model; the text names it.
        """
        from ..weights import FORMAT, read_tensors

        meta, tensors = read_tensors(path)
        if meta.get("format") != FORMAT or meta.get("direction") != "reader":
            raise ValueError(
                f"{path} holds no model that reads electrodes: it says {meta.get('format')}, "
                f"{meta.get('direction')}; write one with `biotac learn train`"
            )
        check_entries(f"the description of {path}", meta, {"level": float, "tared": bool})
        if not 0 < meta["level"] < 1:
            raise ValueError(
                f"level of the description of {path} is {meta['level']:g}: a share between 0 and 1 is "
                "needed; write it anew with `biotac learn train`"
            )
        one = cls(meta, {name: np.asarray(value, float) for name, value in tensors.items()})
        try:
            n = len(one.electrodes)
            one.predict(np.full((2, n), FULL_SCALE / 2), np.full(n, 2000.0))
        except (KeyError, ValueError) as error:
            raise ValueError(
                f"{path} does not fit together ({error}): it is damaged or an older version's, write it anew"
            ) from None
        return one


def fingerprints(counts: np.ndarray) -> list[str]:
    """Fingerprints of the different rows (n, nelectrode) [counts], rising."""
    rows = np.ascontiguousarray(counts, np.float32)
    return sorted({hashlib.blake2b(row.tobytes(), digest_size=6).hexdigest() for row in rows})


def _stored(name, one):
    """Tensors of a dataclass of arrays."""
    return {f"{name}.{field.name}": getattr(one, field.name) for field in dataclasses.fields(one)}


def _least_aside(level):
    """Fewest trajectories that calibrate intervals of this level."""
    return int(np.ceil(level / (1 - level) - 1e-9))


def fit_reader(
    data: Examples, train: np.ndarray, kept: np.ndarray, level: float = _LEVEL, seed: int = 0
) -> Reader:
    """Fits to trajectories `train` and calibrates the intervals on others, `kept` (numbers of `data.owner`).

    Args:
      level: of the intervals. seed: of the random features and the subsample of rows.

    Raises:
      ValueError: too few trajectories, or a force that never changes.
    """
    least = _least_aside(level)
    if len(kept) < least or len(train) < _FOLDS:
        raise ValueError(
            f"{len(train)} trajectories train and {len(kept)} are held out: intervals of "
            f"{100 * level:.0f} % need {least} aside and at least {_FOLDS} to train; record more touches"
        )
    fit, aside = np.isin(data.owner, train), np.isin(data.owner, kept)
    if list(data.targets) == ["force"]:  # where the place is known, that is learned
        check_changes(data.source, data.targets["force"][fit])
    x = data.log_change
    mean, axes, _ = principal_components(x[fit])
    tensors = {"mean": mean, "axes": axes}
    moving = StuckDetector.fit(x[fit | aside], fit[fit | aside])
    tensors |= _stored("moving", moving)
    tensors["centre"] = np.zeros(x.shape[1]) if data.tared else tensors["mean"]
    features, pressed = compressed(x - tensors["centre"]), data.pdc is not None
    known = {
        "rows": NoveltyDetector.fit(features[fit], data.owner[fit], data.pdc[fit] if pressed else None, seed)
    }
    usual = {"rows": np.quantile(known["rows"](features[aside]), 0.95)}
    if pressed:
        usual["pressed"] = np.quantile(known["rows"](features[aside], data.pdc[aside]), 0.95)
    if data.tared:  # one baseline per trajectory
        first = np.isin(np.arange(len(x)), np.unique(data.owner, return_index=True)[1])
        rest = log_impedance(data.tare)
        known["level"] = NoveltyDetector.fit(rest[fit & first], data.owner[fit & first], seed=seed)
        usual["level"] = max(known["level"](rest[aside & first]).max(), 1.0)
    for name, one in known.items():
        tensors |= _stored(name, one)
    tensors |= {f"{name}.usual": np.array(value) for name, value in usual.items()}
    kinds = [Terms.fit(x[fit], seed=seed, **kind) for kind in KINDS]
    for k, terms in enumerate(kinds):
        tensors |= _stored(f"terms.{k}", terms)
        columns = terms(x)
        for name, y in data.targets.items():
            rows = np.flatnonzero(fit & np.isfinite(y).all(1))
            if len(np.unique(data.owner[rows])) < 2:
                raise ValueError(
                    f"fewer than two of the trajectories that train have {name}: how it goes with the "
                    "electrodes cannot be tried on others; record more touches"
                )
            weight, offset = best_ridge(columns[rows], y[rows], data.owner[rows], _RIDGE, _FOLDS)
            tensors |= {f"{name}.{k}.weight": weight, f"{name}.{k}.offset": offset}
    meta = {"tared": data.tared, "level": level, "source": data.source, "units": UNITS}
    meta |= {"train": len(train), "aside": len(kept), "synthetic": data.synthetic}
    meta["learned"] = fingerprints(data.counts[fit | aside])[:_KNOWN]
    tensors |= {f"{name}.half": np.ones(1) for name in (*data.targets, "electrodes")}
    pdc = None if data.pdc is None else data.pdc[aside]
    raw = Reader(meta, tensors).predict(data.counts[aside], data.tare[aside], pdc)
    truth = data.targets | {"electrodes": data.counts}
    for name in raw.value:
        error = (raw.value[name] - truth[name][aside]) / raw.half[name]
        there = np.isfinite(error).all(1)
        half = conformal_width(error[there], data.owner[aside][there], 1 - level)
        if not np.isfinite(half).all():
            raise ValueError(
                f"{len(np.unique(data.owner[aside][there]))} held-out trajectories have {name}: intervals "
                f"of {100 * level:.0f} % need {least}; record more touches"
            )
        tensors[f"{name}.half"] = half
    return Reader(meta, tensors)


def judge(data: Examples, seed: int = 0) -> tuple[Reader, dict]:
    """A model of a set and its test errors: 72 % of the trajectories train, 18 % calibrate the intervals, 10
    % test. The model's description names the outputs that are no better than the mean.

    Raises:
      ValueError: too few trajectories.
    """
    names, aside = np.unique(data.owner), _least_aside(_LEVEL)
    needed = least_count(_FOLDS, aside)
    if len(names) < needed:
        raise ValueError(
            f"the set has {len(names)} interactions: a model with intervals of {100 * _LEVEL:.0f} % needs "
            f"{needed}, of which {aside} calibrate them; make more with `biotac data generate --count`"
        )
    subset = assign(len(names), seed)
    train, kept, test = (names[subset == name] for name in SPLITS)
    reader, scores = _scored(fit_reader(data, train, kept, seed=seed), data, test, train)
    return reader, scores | {"test": len(test)}


def judge_in_time(data: Examples, fraction: float = 0.7, seed: int = 0) -> tuple[Reader, dict]:
    """`judge` for a recording: the first rows train; the blocks after them calibrate the intervals and give
    the errors. The intervals' coverage is therefore unknown."""
    names = np.unique(data.owner)
    cut = int(fraction * len(names))
    fitted = fit_reader(data, names[:cut], names[cut:], seed=seed)
    reader, scores = _scored(fitted, data, names[cut:], names[:cut])
    for row in scores["targets"].values():
        row["covered"] = None
    return reader, scores


def judge_on(reader: Reader, data: Examples) -> dict:
    """Errors of a model on data, beside those of these data's own mean; "known": as `Reader.known`.

    Raises:
      ValueError: a model of changes from rest where the data's rest is not known, or of other electrodes.
    """
    names = np.unique(data.owner)
    return _scored(reader, data, names, names)[1] | {"known": reader.known(data.counts)}


def _scored(reader, data, test, train):
    """The model whose description names the outputs that the trajectories `test` do not show to be better
    than the mean of `train`, and its errors on them beside those of that mean."""
    known = np.isin(data.owner, train)
    rows = np.isin(data.owner, test)
    tare = data.tare[rows] if data.tared else None
    found = reader.predict(data.counts[rows], tare, None if data.pdc is None else data.pdc[rows])
    truth = data.targets | {"electrodes": data.counts}
    out = {}
    for name in (name for name in found.value if name in truth):
        error = np.abs(found.value[name] - truth[name][rows])
        mean = np.abs(np.nanmean(truth[name][known], axis=0) - truth[name][rows])
        there = np.isfinite(error).all(1)
        error, mean, owner = error[there], mean[there], data.owner[rows][there]
        columns = TARGETS[name] or reader.electrodes
        out[name] = {
            "unit": UNITS[name],
            "half": float(reader.tensors[f"{name}.half"].mean()),
            "rmse": float(np.sqrt((error**2).mean())) if len(error) else None,
            "rmse_of_mean": float(np.sqrt((mean**2).mean())) if len(error) else None,
            "covered": float((error <= found.half[name][there]).mean()) if len(error) else None,
            "useless": [
                column
                for k, column in enumerate(columns)
                if len(error) and not is_better(error[:, k : k + 1], mean[:, k : k + 1], owner)
            ],
        }
    useless = [column for row in out.values() for column in row["useless"]]
    scores = {"targets": out, **{key: reader.meta[key] for key in ("train", "aside")}}
    return dataclasses.replace(reader, meta=reader.meta | {"useless": useless}), scores
