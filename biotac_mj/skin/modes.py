"""Small vibrations of the resting skin and its liquid: modes, and the pressure that forces on the outside
make.

M u'' + K u + kappa g g.u = f about the rest state, with the elements' lumped mass, their stiffness, g = dV/du
of the cavity and kappa = K_liquid / V; the pressure is -kappa g.u. Few modes move it below a few kilohertz;
what those left out would add is their static part, which one solve gives exactly.

The liquid has no mass here. As potential flow in the resting gap it would bring the mode that is heard most
from 289 to 125 Hz (default skin); what slides and is pressed is most sensitive near 330 Hz (Fishel and Loeb,
2012). In touch the gap is closed under the contact and the skin held there, so neither is right."""

import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from ..cache import cached
from .liquid import WATER
from .model import SkinModel

__all__ = ["NMODE", "SkinModes", "skin_modes"]

NMODE, _COUNT = 24, 48  # modes that are kept, of those that are looked for


@dataclasses.dataclass(frozen=True)
class SkinModes:
    """Modes of the resting skin, those first that move the pressure most.

    Attributes:
      node: (n,) nodes of the outer surface.
      rate: (nmode,) angular frequencies [rad/s].
      shape: (nmode, n, 3) displacement of the nodes, mass-normalised [kg^-1/2].
      static_pressure: (nmode,) of a unit modal force r = shape . f [Pa / (N kg^-1/2)]; that of one
        that moves is this times the response of an oscillator of unit static gain.
      static: (n, 3) pressure of a steady force on each node, of all modes and of what is beyond [Pa/N].
    """

    node: np.ndarray
    rate: np.ndarray
    shape: np.ndarray
    static_pressure: np.ndarray
    static: np.ndarray


def skin_modes(model: SkinModel) -> SkinModes:
    """Modes of a skin at rest, from disk where they were made before."""
    inputs = [model.geometry, model.material, model.options, model.has_liquid, model.modulus, _COUNT, NMODE]
    return SkinModes(**cached("modes", inputs, lambda: _make(model)))


def _make(model):
    dof = (3 * model.free[:, None] + np.arange(3)).ravel()
    n = len(dof)
    mass = np.repeat(model.material.density * model.elements.node_volume[model.free], 3)
    solve = splu(model.stiffness.tocsc()).solve  # the solver's own factor is in single precision
    w, give = np.zeros(n), 1.0
    if model.has_liquid:
        gradient, bulk = _volume_gradient(model).ravel()[dof], model.options.bulk_modulus
        w = solve(gradient)
        # volume that the cavity and the liquid give per unit pressure
        give = gradient @ w + model.liquid_volume / (bulk if np.isfinite(bulk) else WATER)

    def compliance(f):
        f = np.ravel(f)
        return solve(f) - w * (w @ f / give)

    square, shape = eigsh(
        sp.identity(n, format="csc"),  # not looked at: shifted to 0 and inverted it is the compliance
        min(_COUNT, n - 1),
        M=sp.diags(mass),
        sigma=0.0,
        OPinv=LinearOperator((n, n), compliance, dtype=float),
        v0=np.random.default_rng(0).standard_normal(n),  # else every process would find its own signs
    )
    node = np.unique(model.geometry.outer_face)
    full = np.zeros((len(square) + 1, 3 * model.nvert))
    full[:-1, dof], full[-1, dof] = shape.T, -w / give
    full = full.reshape(len(full), -1, 3)[:, node]
    pressure = -(w * mass) @ shape / give
    heard = np.abs(pressure) * np.sqrt((full[:-1] ** 2).sum((1, 2)))
    order = np.argsort(-heard)[:NMODE]
    return {
        "node": node,
        "rate": np.sqrt(square)[order],
        "shape": full[order],
        "static_pressure": pressure[order],
        "static": full[-1],
    }


def _volume_gradient(model):
    """(nvert, 3) dV/du of the cavity at rest [m^2]."""
    face = model.geometry.inner_face
    a, b, c = np.moveaxis(model.geometry.vert[face], 1, 0)
    third = -np.cross(b - a, c - a) / 6
    out = np.zeros((model.nvert, 3))
    for corner in face.T:
        np.add.at(out, corner, third)
    return out
