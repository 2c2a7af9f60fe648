"""Derivatives by the rest positions of a skin's nodes: thickness and shape.

Rest positions X enter the rubber through the maps of its elements, contact through the samples' areas, the
liquid through its volume without pressure, and fixed nodes are at their rest positions. Areas and volume
depend on X only and use PyTorch's own gradients; here are the forces of the rubber. With G = d(dX)/dX, where
dX is the change of a point's rest position,

    dF = -F G,   dw = w tr G,   d(grad N) = -G' grad N,

where F is the deformation gradient, w the point's volume and N the shape functions. Stress and its derivative
are the elements' own (`skin.rubber.element_kernels`)."""

import numpy as np
import torch

from ..skin import SkinWorlds


def pull_rest(skin: SkinWorlds, x: np.ndarray, balance: np.ndarray) -> np.ndarray:
    """(nvert, 3) derivatives of balance . f by rest positions, f the forces of the rubber.

    Args:
      x: (nvert, 3) nodes [m]. balance: (nvert, 3).
    """
    points = _Points(skin, x)
    along = np.einsum("eai,eqaj->eqij", balance[points.elem], points.gradient)
    P, change, theta, direction = points.slopes(along)
    stiff_volume, F, eye = points.stiff_volume, points.F, np.eye(3)
    work = np.einsum("eqij,eqij->eq", P, along)[..., None, None] * eye
    S = work - np.swapaxes(F, 2, 3) @ change - np.swapaxes(along, 2, 3) @ P
    S *= -stiff_volume[..., None, None]
    if points.averaged:
        felt = np.einsum("eq,eqij,eqij->e", stiff_volume, direction, along)
        S -= (points.averaged * felt / points.volume)[:, None, None, None] * points.of_mean(theta, direction)
    out = np.zeros((len(x), 3))
    np.add.at(out, points.elem, np.einsum("eqij,eqaj->eai", S, points.gradient))
    return out


def push_rest(skin: SkinWorlds, x: np.ndarray, change: np.ndarray) -> np.ndarray:
    """(nvert, 3) change of the rubber's forces for a change (nvert, 3) of rest positions [m]."""
    points = _Points(skin, x)
    G = np.einsum("eai,eqaj->eqij", change[points.elem], points.gradient)
    P, dP, theta, direction = points.slopes(-points.F @ G)
    if points.averaged:
        mean = np.einsum("eqij,eqij->e", points.of_mean(theta, direction), G) / points.volume
        dP = dP + points.averaged * mean[:, None, None, None] * direction
    trace = np.trace(G, axis1=2, axis2=3)[..., None, None]
    dP = -points.stiff_volume[..., None, None] * (trace * P + dP - P @ np.swapaxes(G, 2, 3))
    out = np.zeros((len(x), 3))
    np.add.at(out, points.elem, np.einsum("eqij,eqaj->eai", dP, points.gradient))
    return out


class _Points:
    """Integration points at x (nvert, 3).

    Attributes:
      elem, gradient: of `Tetrahedra`. F: (nelem, npoint, 3, 3). stiff_volume: (nelem, npoint) volume times
        the factor on the modulus. volume: (nelem,) [m^3].
      averaged: part of the law's second constant that acts on the mean dilatation of an element [Pa].
    """

    def __init__(self, skin, x):
        elements, numbers = skin.model.elements, skin.read("mu", "lam")
        self._skin, self.elem, self.gradient = skin, elements.elem, elements.gradient
        self.stiff_volume = self._weight = elements.weight
        if elements.modulus is not None:
            self.stiff_volume = self.stiff_volume * elements.modulus[:, None]
        self.volume = self._weight.sum(1)
        self.averaged = max(float(numbers["lam"] - elements.cap * numbers["mu"]), 0.0)
        self.F = np.einsum("eai,eqaj->eqij", x[self.elem], self.gradient)

    def slopes(self, change):
        return self._skin.point_slopes(change)

    def of_mean(self, theta, direction):
        """(nelem, npoint, 3, 3) derivative by G of an element's mean dilatation times its volume."""
        mean = (self._weight * theta).sum(1) / self.volume
        own = (theta - mean[:, None])[..., None, None] * np.eye(3)
        return self._weight[..., None, None] * (own - np.swapaxes(self.F, 2, 3) @ direction)


def areas_at(vert: torch.Tensor, face: np.ndarray) -> torch.Tensor:
    """(nface,) of faces with nodes at vert (nvert, 3) [m^2]."""
    corner = vert[torch.from_numpy(face.astype(np.int64))]
    return torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=-1) / 2


def cavity_at(vert: torch.Tensor, face: np.ndarray) -> torch.Tensor:
    """Volume enclosed by inner faces (nface, 3), whose normals point inwards [m^3]."""
    a, b, c = vert[torch.from_numpy(face.astype(np.int64))].unbind(1)
    return -(a * torch.linalg.cross(b, c)).sum() / 6
