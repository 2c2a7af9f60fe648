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
from ..tensors import add_rows


def push_rest(skin: SkinWorlds, x: np.ndarray, change: torch.Tensor) -> torch.Tensor:
    """(nvert, 3) change of the rubber's forces for a change (nvert, 3) of rest positions [m], at nodes x
    (nvert, 3) [m]; linear, so that PyTorch transposes it."""
    elements, numbers = skin.model.elements, skin.read("mu", "lam")
    elem, gradient = torch.from_numpy(elements.elem.astype(np.int64)), torch.from_numpy(elements.gradient)
    weight, modulus = torch.from_numpy(elements.weight), elements.modulus
    stiff_volume = weight if modulus is None else weight * torch.from_numpy(np.asarray(modulus))[:, None]
    volume = weight.sum(1)
    # part of the law's second constant that acts on the mean dilatation of an element [Pa]
    averaged = max(float(numbers["lam"] - elements.cap * numbers["mu"]), 0.0)
    F = torch.einsum("eai,eqaj->eqij", torch.from_numpy(x)[elem], gradient)
    G = torch.einsum("eai,eqaj->eqij", change[elem], gradient)
    P, _, theta, direction = map(torch.from_numpy, skin.point_slopes(np.zeros(F.shape)))
    dP = _Stress.apply(-F @ G, skin)
    if averaged:  # by an element's mean dilatation
        own = theta - ((weight * theta).sum(1) / volume)[:, None]
        by_mean = own[..., None, None] * torch.eye(3, dtype=torch.float64) - F.mT @ direction
        mean = torch.einsum("eq,eqij,eqij->e", weight, by_mean, G) / volume
        dP = dP + averaged * mean[:, None, None, None] * direction
    trace = G.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    dP = -stiff_volume[..., None, None] * (trace * P + dP - P @ G.mT)
    return add_rows(torch.zeros_like(change), elem, torch.einsum("eqij,eqaj->eai", dP, gradient))


class _Stress(torch.autograd.Function):
    """Derivative of the stress along a change of the deformation gradients, which is symmetric."""

    @staticmethod
    def forward(context, change, skin):
        context.skin = skin
        return torch.from_numpy(skin.point_slopes(change.detach().numpy())[1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, stress):
        return torch.from_numpy(context.skin.point_slopes(stress.numpy())[1]), None


def areas_at(vert: torch.Tensor, face: np.ndarray) -> torch.Tensor:
    """(nface,) of faces with nodes at vert (nvert, 3) [m^2]."""
    corner = vert[torch.from_numpy(face.astype(np.int64))]
    return torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=-1) / 2


def cavity_at(vert: torch.Tensor, face: np.ndarray) -> torch.Tensor:
    """Volume enclosed by inner faces (nface, 3), whose normals point inwards [m^3]."""
    a, b, c = vert[torch.from_numpy(face.astype(np.int64))].unbind(1)
    return -(a * torch.linalg.cross(b, c)).sum() / 6
