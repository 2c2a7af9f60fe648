"""Indentations with a known solution: our own rubber with liquid, as a substitute for ANSYS without the
paper's data."""

import dataclasses

import numpy as np

from ..fields import as_real
from ..skin.settings import read_settings
from .forward import simulate
from .indentation import Indentation
from .refinement import skin as named_skin

STAND_IN = "own rubber with liquid, in place of ANSYS"


def stand_in(
    indentation: Indentation,
    material: str = "rubber",
    skin: str = "default",
    noise: float = 0.0,
    seed: int = 0,
    liquid: bool | None = None,
    element: str | None = None,
    device: str = "cpu",
) -> Indentation:
    """The indentation with forces and displacements of a known skin.

    Args:
      indentation: the path.
      material: preset, dict, .json file or Material; "rubber" is Neo-Hookean with the paper's ANSYS
        constants, with liquid.
      skin: mesh, "refined:NAME" for each of its tetrahedra cut into eight.
      noise: standard deviation added to each force component [N].
      seed: of the noise.
      liquid, element: see SkinOptions; None takes the material's choice.

    Raises:
      ValueError: negative noise, or a path that the skin cannot follow.
    """
    as_real("noise", noise, 0.0, unit="N")
    rubber, options, _ = read_settings(
        material, None, liquid=liquid, element=element, tolerance=1e-4, max_newton=100
    )
    answer = simulate(named_skin(skin), options, [rubber], indentation, device)
    if answer.nonconverged[0]:
        raise ValueError(
            f"{answer.nonconverged[0]} of {answer.steps} reference steps of {indentation.name!r} did not "
            "converge: press less deep, or take more samples"
        )
    force = answer.force[0] + noise * np.random.default_rng(seed).standard_normal(answer.force[0].shape)
    return dataclasses.replace(
        indentation, force=force, peak_norm=answer.peak_norm[0], mean_norm=answer.mean_norm[0]
    )
