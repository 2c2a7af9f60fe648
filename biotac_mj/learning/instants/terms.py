"""Features of a regression on ln Z of the electrodes, row by row, that can be saved in a file."""

import dataclasses

import numpy as np

from .linear import principal_components

_WAVES = 200  # random Fourier features: more changed nothing on two recordings
# arguments of `Terms.fit`; predictions are the mean over these, since none is reliable on new data
KINDS = [
    {"common": common, **more}
    for common in (False, True)
    for more in ({}, {"products": 3}, {"products": 5}, {"length": 1.0})
]


@dataclasses.dataclass(frozen=True, eq=False)
class Terms:
    """Features: ln Z (n, nelectrode), products of its first components, and random Fourier features (of a
    Gaussian kernel).

    Attributes:
      common: 1.0 subtracts the mean over the electrodes, which warm-up changes.
      mean (nelectrode,), axes (nelectrode, k): of the components in products, clipped to low and high (k,).
      wave: (nelectrode, m) frequencies, over all components.
    """

    common: np.ndarray
    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    wave: np.ndarray

    @classmethod
    def fit(
        cls, log_z: np.ndarray, products: int = 0, common: bool = False, length: float = 0.0, seed: int = 0
    ) -> "Terms":
        """Fits to rows (n, nelectrode).

        Args:
          products: number of components with products. common: without the mean over the electrodes. length:
            scale of the random features, in median distances between rows; 0: none. seed: of the random
            features.
        """
        x = log_z - log_z.mean(1, keepdims=True) if common else log_z
        mean, axes, _ = principal_components(x)
        main = (x - mean) @ axes[:, :products]
        wave = np.zeros((len(mean), 0))
        if length:
            rng = np.random.default_rng(seed)
            a, b = x[rng.integers(len(x), size=(2, 2000))]
            usual = np.median(np.linalg.norm(a - b, axis=1))
            wave = rng.normal(size=(len(mean), _WAVES)) / (length * max(usual, 1e-9))
        return cls(np.array(float(common)), mean, axes[:, :products], main.min(0), main.max(0), wave)

    def __call__(self, log_z: np.ndarray) -> np.ndarray:
        """(n, terms) of rows (n, nelectrode)."""
        x = log_z - self.common * log_z.mean(1, keepdims=True)
        columns = [x]
        if self.axes.shape[1]:  # products must not extrapolate
            main = np.clip((x - self.mean) @ self.axes, self.low, self.high)
            i, j = np.triu_indices(main.shape[1])
            columns.append(main[:, i] * main[:, j])
        if self.wave.shape[1]:
            phase = (x - self.mean) @ self.wave
            columns += [np.cos(phase), np.sin(phase)]
        return np.hstack(columns)
