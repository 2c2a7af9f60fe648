"""The film's equations that are of numbers alone (`formulas`): its kernels call them, and gradients take them
on tensors."""

import numpy as np

from ..formulas import Number

__all__ = ["near_resistance", "rough_thickness", "sheet_scale"]


def rough_thickness(thickness: Number, rest: Number, power: Number) -> Number:
    """Thickness of a smooth film [m] that conducts as a rough one does, whose conductance goes as a power."""
    return rest * np.pow(thickness / rest, power)


def sheet_scale(conductivity: Number, thickness: Number, area: Number) -> Number:
    """Conductance of a face of the sheet over its area [S/m^2], by which products of its edges are
    conductances between corners; thickness: the sum of its corners', area: of the parallelogram."""
    sheet = conductivity * thickness / np.float64(3.0)
    return np.float64(0.5) * sheet / area


def near_resistance(
    thickness: Number, slab: Number, radius: Number, footprint: Number, conductivity: Number
) -> Number:
    """Resistance [ohm] near a disc that the mesh does not see: the logarithm within the footprint, and what
    the slab adds to the sheet."""
    within = np.log(footprint / radius) / (np.float64(2.0) * np.float64(np.pi) * thickness)
    return (within + slab / radius) / conductivity
