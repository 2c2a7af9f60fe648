"""The film's impedances as a differentiable PyTorch function: the equations of `sensor.film` on tensors.

The film itself finds the core triangle nearest to a node and the faces over a disc. Impedances are smooth
between changes of these."""

import types

import numpy as np
import torch

from ...sensor.film import FilmConduction, NoFilmError, kernels, spreading_table
from ...sensor.formulas import with_globals
from ..tensors import real_tensor

_INSIDE = 1e-9  # barycentric coordinate below which a point is on a triangle's edge
# Warp's names in the film's formulas
_WARP = types.SimpleNamespace(pi=np.pi, log=torch.log, pow=torch.pow, min=lambda a, most: a.clamp(max=most))
_names = {"wp": _WARP, "real": lambda value: value, "int": lambda value: value.detach().long()}
_formulas = types.SimpleNamespace(**with_globals(kernels, _names))
_ON_EDGE = 1e-9  # as in `sensor.film.kernels`: both faces accept a sample on their edge


def impedance(
    film: FilmConduction,
    nodes: torch.Tensor,
    conductivity: torch.Tensor | None = None,
    electrode_radius: torch.Tensor | None = None,
    residual_film: torch.Tensor | None = None,
    cell_constant: torch.Tensor | None = None,
    rest_nodes: torch.Tensor | None = None,
) -> torch.Tensor:
    """Impedances (nelectrode,) [ohm] of E1, E2, ... over a deformed skin.

    Args:
      film: of the skin.
      nodes: (nvert, 3) in the BioTac frame [m]; edge nodes are last.
      conductivity [S/m], electrode_radius [m], residual_film [m], cell_constant (nelectrode,): constants of
      the sensor;
        None: the film's own.
      rest_nodes: (nvert, 3) rest positions, as in `press`: cell constants are such that the readings there
        are the film's at rest, and a rough film has its thickness at rest there. None: the film's own.

    Raises:
      NoFilmError: an electrode without film.
      ValueError: both rest_nodes and cell_constant, which follows from them; nodes that are not finite, or of
        another shape.
    """
    if rest_nodes is not None:
        if cell_constant is not None:
            raise ValueError("cell_constant follows from rest_nodes: give one of them")
        cell_constant = torch.ones(film.design.nelectrode, dtype=torch.float64)
    sigma, radius, least, cell = (
        torch.as_tensor(own if given is None else given, dtype=torch.float64, device="cpu")
        for own, given in (
            (film.conductivity, conductivity),
            (film.electrode_radius, electrode_radius),
            (film.residual_film, residual_film),
            (film.cell_constant, cell_constant),
        )
    )
    rest = torch.from_numpy(film._rest_thickness)
    if rest_nodes is not None:
        at_rest = _nodes_of(film, "rest_nodes", rest_nodes)
        middle, rest = _lay(film, at_rest, least)
        # a rough film at rest equals a smooth one
        cell = torch.from_numpy(film.rest) / _solve(film, middle, rest, sigma, radius)
    middle, thickness = _lay(film, _nodes_of(film, "nodes", nodes), least)
    if film._power != 1.0:
        thickness = _formulas.rough_thickness(thickness, rest, film._power)
    return cell * _solve(film, middle, thickness, sigma, radius)


def _nodes_of(film, name, value):
    """The film's nodes (n, 3) of a skin's nodes."""
    nodes, n = real_tensor(name, value).cpu(), film.geometry.nvert
    if nodes.ndim != 2 or len(nodes) < n or nodes.shape[-1] != 3:
        raise ValueError(
            f"{name} has shape {tuple(nodes.shape)}: pass ({n}, 3) of one skin, nodes on edges after them"
        )
    nodes = nodes[film.node]
    if not torch.isfinite(nodes).all():
        raise ValueError(f"{name} is not finite under the film: give numbers [m]")
    return nodes


def _solve(film, middle, thickness, sigma, radius):
    """Impedances (nelectrode,) without the cell constants."""
    face = torch.as_tensor(film.face.astype(np.int64))
    system = _laplacian(middle, thickness, face, sigma)
    weights, local = _cover(film, middle, thickness, face)
    resistance = weights.T @ torch.linalg.solve(system, weights)
    step, table = spreading_table()
    near = _formulas.near_resistance(local, torch.from_numpy(table), step, radius, film._footprint, sigma)
    own = resistance.diagonal() + near
    n = film.design.nelectrode
    ground, among = slice(n, None), resistance[n:, n:]
    one = torch.ones(len(among), 1, dtype=torch.float64)
    among = among - among.diagonal().diag() + own[ground].diag()
    scale = among.diagonal().mean().detach()
    border = torch.cat(
        [torch.cat([among, scale * one], 1), torch.cat([scale * one.T, torch.zeros(1, 1).double()], 1)]
    )
    into = torch.cat([resistance[ground, :n], scale * torch.ones(1, n).double()])
    return own[:n] - (into * torch.linalg.solve(border, into)).sum(0)


def _lay(film, point, least):
    """The surface halfway between skin and core, and the film's thickness."""
    at = point.detach().numpy()
    distance, foot, triangle = film.core.closest(at)
    corner = 1e-3 * film.core.core.corner.numpy()[triangle]  # [m]
    fixed, along = torch.from_numpy(foot), torch.from_numpy(_projection(corner, foot))
    here = fixed + (along @ (point - torch.from_numpy(at))[..., None])[..., 0]
    gap = point - here
    thickness = torch.from_numpy(np.sign(distance)) * gap.norm(dim=-1)
    thickness = torch.where(torch.from_numpy(distance) < float(least.detach()), least, thickness)
    return point - 0.5 * gap, thickness


def _projection(corner, foot):
    """(n, 3, 3) projection onto the directions in which a foot point moves: the triangle, its edge, or none
    at a corner."""
    a, b, c = np.moveaxis(corner, 1, 0)
    normal = np.cross(b - a, c - a)
    size = (normal**2).sum(1)
    fraction = [(normal * np.cross(q - p, foot - p)).sum(1) / size for p, q in ((b, c), (c, a), (a, b))]
    out = np.eye(3) - normal[:, :, None] * normal[:, None, :] / size[:, None, None]
    on = np.array(fraction).T < _INSIDE
    for k, (p, q) in enumerate(((b, c), (c, a), (a, b))):
        edge = (q - p) / np.linalg.norm(q - p, axis=1, keepdims=True)
        out[on[:, k]] = (edge[:, :, None] * edge[:, None, :])[on[:, k]]
    out[on.sum(1) > 1] = 0
    return out


def _laplacian(middle, thickness, face, sigma):
    """Laplacian of the sheet, (n, n); the first diagonal is doubled, which fixes the free constant."""
    a, b, c = (middle[face[:, k]] for k in range(3))
    side = c - b, a - c, b - a
    area = torch.linalg.cross(side[0], side[1]).norm(dim=-1)
    area = torch.maximum(area, 1e-6 * sum((e * e).sum(-1) for e in side))
    scale = _formulas.sheet_scale(sigma, thickness[face].sum(1), area)
    n = len(middle)
    total = torch.zeros(n * n, dtype=torch.float64)
    for k in range(3):
        i, j = face[:, (k + 1) % 3], face[:, (k + 2) % 3]
        value = -scale * (side[(k + 1) % 3] * side[(k + 2) % 3]).sum(-1)
        for row, column, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            total = total.index_add(0, row * n + column, sign * value)
    first = torch.zeros(n, n, dtype=torch.float64)
    first[0, 0] = 1.0
    total = total.reshape(n, n)
    return total + first * total[0, 0]


def _cover(film, middle, thickness, face):
    """Weights (n, ndisc) of the discs' means, and their mean thickness (ndisc,)."""
    electrode, candidate = film._pair
    corner = face[torch.from_numpy(candidate)]
    tangent, pos = torch.from_numpy(film._tangent)[electrode], torch.from_numpy(film._pos)[electrode]
    flat = torch.einsum("mak,mck->mca", tangent, middle[corner] - pos[:, None])
    a, first, second = flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    d = torch.from_numpy(film._disc)[None] - a[:, None]
    u = (d[..., 0] * second[:, None, 1] - d[..., 1] * second[:, None, 0]) / area[:, None]
    v = (first[:, None, 0] * d[..., 1] - first[:, None, 1] * d[..., 0]) / area[:, None]
    weight = torch.stack([1 - u - v, u, v], -1)
    over = (weight.detach() >= -_ON_EDGE).all(-1).numpy()
    hits = np.zeros((len(film._pos), len(film._disc)))
    np.add.at(hits, electrode, over)
    covered = (hits > 0).sum(1)
    if (covered == 0).any():
        raise NoFilmError(f"no liquid film over disc {int(np.argmin(covered)) + 1}: take a smaller step")
    fraction = over / np.maximum(hits[electrode], 1) / covered[electrode][:, None]
    weight = (weight * torch.from_numpy(fraction)[..., None]).sum(1)
    n, m = len(middle), len(hits)
    number = corner * m + torch.from_numpy(electrode)[:, None]
    weights = torch.zeros(n * m, dtype=torch.float64).index_add(0, number.ravel(), weight.ravel())
    weights = weights.reshape(n, m)
    return weights, weights.T @ thickness
