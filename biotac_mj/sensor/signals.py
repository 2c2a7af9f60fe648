"""Sources of the electrodes' impedances, by name."""

import os

from ..fields import check_choice
from ..short_repr import short_repr

SIGNALS = ("physics", "latent_projection", "learned")
_WEIGHTS = ".safetensors"


def read_signal(signal: str, weights: str | None = None) -> tuple[str, str | None]:
    """ "physics" or "learned", and the weights: a file, "latent_projection", or None for those of "learned".

    Args:
      signal: one of SIGNALS, or the file itself, which ends in .safetensors. weights: of "learned".

    Raises:
      ValueError: unknown signal, weights for the physics, or two files.
    """
    for name, value in (("signal", signal), ("weights", weights)):
        if not isinstance(value, (str, os.PathLike)) and (value is not None or name == "signal"):
            raise ValueError(
                f"{name} is {short_repr(value)}: give one of {', '.join(SIGNALS)}, or a file *{_WEIGHTS}"
            )
    if str(signal).endswith(_WEIGHTS):
        if weights is not None:
            raise ValueError(f"signal {short_repr(signal)} and weights {weights!r} are two models: give one")
        return "learned", str(signal)
    check_choice("unknown signal", signal, SIGNALS, f", or a file *{_WEIGHTS}")
    if signal != "learned" and weights is not None:
        raise ValueError(f"weights {weights!r} are given but the signal is {signal!r}: take signal='learned'")
    if signal == "latent_projection":
        return "learned", signal
    return signal, None if weights is None else str(weights)
