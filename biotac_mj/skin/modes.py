"""Small vibrations of the skin and its liquid without contact: modes, and the pressure by forces on the
outside.

M u'' + K u + kappa g g.u = f about the equilibrium, with the elements' lumped mass and stiffness, g = dV/du
of the cavity and kappa = K_liquid / V; the pressure is -kappa g.u. Few modes below a few kilohertz change it;
the static part of the others follows exactly from one solve.

The liquid has no mass here. As potential flow in the gap it would lower the mode with the largest pressure
from 289 to 125 Hz (default skin); a real sensor that slides under load is most sensitive near 330 Hz (Fishel
and Loeb, 2012). In contact the gap is closed and the skin supported there, so that neither value is right."""

import dataclasses

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from ..cache import cached
from .liquid import WATER, volume_gradient
from .model import SkinModel

NMODE, _COUNT = 24, 48  # modes that are kept, and that are computed


@dataclasses.dataclass(frozen=True)
class SkinModes:
    """Modes of the skin without contact, in descending order of their pressure.

    Attributes:
      node: (n,) nodes of the outer surface.
      rate: (nmode,) angular frequencies [rad/s].
      shape: (nmode, n, 3) displacement of the nodes, mass-normalised [kg^-1/2].
      static_pressure: (nmode,) by a unit modal force r = shape . f [Pa / (N kg^-1/2)]; the dynamic pressure
        is this times the response of an oscillator of unit static gain.
      static: (n, 3) pressure by a steady force on each node, of all modes and the remainder [Pa/N].
    """

    node: np.ndarray
    rate: np.ndarray
    shape: np.ndarray
    static_pressure: np.ndarray
    static: np.ndarray


def skin_modes(model: SkinModel) -> SkinModes:
    """Modes of a skin without contact; cached on disk."""
    inputs = [model.geometry, model.material, model.options, model.has_liquid, model.modulus, _COUNT, NMODE]
    return SkinModes(**cached("modes", inputs, lambda: _make(model)))


def _make(model):
    dof = (3 * model.free[:, None] + np.arange(3)).ravel()
    n = len(dof)
    mass = np.repeat(model.material.density * model.elements.node_volume[model.free], 3)
    solve = splu(model.stiffness.tocsc()).solve  # the solver's own factor is in single precision
    w, volume_compliance = np.zeros(n), 1.0
    if model.has_liquid:
        geometry, bulk = model.geometry, model.options.bulk_modulus
        gradient = volume_gradient(geometry.vert, geometry.inner_face).ravel()[dof]
        w = solve(gradient)
        # volume of cavity and liquid per unit pressure [m^3/Pa]
        volume_compliance = gradient @ w + model.liquid_volume / (bulk if np.isfinite(bulk) else WATER)

    def compliance(f):
        f = np.ravel(f)
        return solve(f) - w * (w @ f / volume_compliance)

    square, shape = eigsh(
        sp.identity(n, format="csc"),  # not used: shift-invert at 0 takes OPinv, the compliance
        min(_COUNT, n - 1),
        M=sp.diags(mass),
        sigma=0.0,
        OPinv=LinearOperator((n, n), compliance, dtype=float),
        v0=np.random.default_rng(0).standard_normal(n),  # for equal signs in every process
    )
    node = np.unique(model.geometry.outer_face)
    full = np.zeros((len(square) + 1, 3 * model.nvert))
    full[:-1, dof], full[-1, dof] = shape.T, -w / volume_compliance
    full = full.reshape(len(full), -1, 3)[:, node]
    pressure = -(w * mass) @ shape / volume_compliance
    amplitude = np.abs(pressure) * np.sqrt((full[:-1] ** 2).sum((1, 2)))
    order = np.argsort(-amplitude)[:NMODE]
    return {
        "node": node,
        "rate": np.sqrt(square)[order],
        "shape": full[order],
        "static_pressure": pressure[order],
        "static": full[-1],
    }
