"""Splits into training, validation and test. Whole interactions or objects, never time steps, since
neighbouring ones are similar."""

import dataclasses
import itertools

import numpy as np

from .schema import SPLITS

FRACTIONS = (0.72, 0.18, 0.10)  # train, validation, test: Narang et al., ICRA 2021


@dataclasses.dataclass(frozen=True)
class Split:
    """Sorted numbers of interactions (k,) each; no interaction is in two of them."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    def check(self) -> "Split":
        """Returns itself; ValueError if a part is empty."""
        count = len(self.train) + len(self.validation) + len(self.test)
        for name in SPLITS:
            if not len(getattr(self, name)):
                raise ValueError(
                    f"the {name} part of the split of {count} interactions is empty: random splits need "
                    f"{least_count()}, or give another object or fractions"
                )
        return self


def assign(count: int, seed: int = 0, fractions: tuple = FRACTIONS) -> np.ndarray:
    """(count,) of "train", "validation", "test" in random order and the given fractions, rounded."""
    fractions = np.asarray(fractions, float)
    if fractions.shape != (3,) or (fractions < 0).any() or abs(fractions.sum() - 1) > 1e-9:
        raise ValueError(
            f"fractions {fractions.tolist()} must be three numbers that add up to 1: train, validation, test"
        )
    bound = np.rint(np.cumsum(fractions) * count).astype(int)
    subset = np.searchsorted(bound, np.arange(count), side="right")
    # not scikit-learn's ShuffleSplit: published numbers and saved models refer to these splits by seed
    return np.array(SPLITS)[np.random.default_rng(seed).permutation(subset)]


def least_count(train: int = 1, validation: int = 1) -> int:
    """Smallest number of interactions of which `assign` gives each part so many."""
    needed = dict(zip(SPLITS, (train, validation, 1)))
    for count in itertools.count(1):
        subset = assign(count)
        if all((subset == name).sum() >= least for name, least in needed.items()):
            return count


def split_by_interaction(data: object, seed: int = 0, fractions: tuple = FRACTIONS) -> Split:
    """Random interactions; labelled and unlabelled ones are split separately, so that both appear in every
    part.

    Args:
      data: TactileSet.
      seed: of the division.

    Raises:
      ValueError: an empty part, or fractions that do not sum to 1.
    """
    subset = np.empty(len(data), "<U10")
    for k, flag in enumerate((False, True)):
        mine = np.flatnonzero(data.labelled == flag)
        subset[mine] = assign(len(mine), [seed, k], fractions)
    return Split(*(np.flatnonzero(subset == name) for name in SPLITS)).check()


def split_by_object(
    data: object, unseen: str | list | tuple = "ring_7mm", seed: int = 0, validation: float = 0.2
) -> Split:
    """All interactions of the unseen object (or objects) are the test set; a fraction of the others is the
    validation set, the remainder trains.

    Raises:
      ValueError: an object that the set does not have; the text lists those it has.
    """
    unseen = [unseen] if isinstance(unseen, str) else list(unseen)
    known = sorted(set(data.object.tolist()))
    for name in unseen:
        if name not in known:
            raise ValueError(f"the set has no object {name!r}: it has {', '.join(known)}")
    test = np.isin(data.object, unseen)
    subset = np.empty(len(data), "<U10")
    subset[test] = "test"
    for k, flag in enumerate((False, True)):
        mine = np.flatnonzero(~test & (data.labelled == flag))
        subset[mine] = assign(len(mine), [seed, k], (1 - validation, validation, 0.0))
    return Split(*(np.flatnonzero(subset == name) for name in SPLITS)).check()
