"""The film's scalar equations (see `formulas`), used by its kernels and, on tensors, by gradients."""

import numpy as np

from ..formulas import Number

__all__ = ["near_resistance", "rough_thickness", "sheet_scale"]


def rough_thickness(thickness: Number, rest: Number, power: Number) -> Number:
    """Thickness [m] of a smooth film with the conductance of a rough one, which is a power of its
    thickness."""
    return rest * np.pow(thickness / rest, power)


def sheet_scale(conductivity: Number, thickness: Number, area: Number) -> Number:
    """Conductance of a face of the sheet over its area [S/m^2]; products of its edges with it are
    conductances between corners. thickness: sum over its corners, area: of the parallelogram."""
    sheet = conductivity * thickness / np.float64(3.0)
    return np.float64(0.5) * sheet / area


def near_resistance(
    thickness: Number, slab: Number, radius: Number, footprint: Number, conductivity: Number
) -> Number:
    """Resistance [ohm] near a disc that the mesh does not resolve: the logarithm within the footprint, and
    the slab's addition to the sheet."""
    within = np.log(footprint / radius) / (np.float64(2.0) * np.float64(np.pi) * thickness)
    return (within + slab / radius) / conductivity
