"""Features of a displacement field for the electrodes: principal components, film and strain over each
electrode, and the mirror image."""

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import nn

from ...geometry.core_surface import CoreSurface
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.film import excitation_places
from ..networks.points import SAME_SHAPE, shape_values

_RADII = (0.8e-3, 1.6e-3, 3.2e-3)  # [m] of the patches over an electrode: the disc, the gap, the neighbours
_FILM = 50e-6  # [m] residual film where the skin touches the core, as in sensor.film


def orthogonal_modes(x: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The `count` strongest right singular vectors (k, count) of x (n, k), on its device, and the root mean
    square (count,) of x along each, by a randomised method with torch's generator. Fewer for a smaller x."""
    count = min(count, *x.shape)
    _, s, v = torch.svd_lowrank(x, q=min(count + 32, *x.shape), niter=3)
    return v[:, :count], s[:count] / len(x) ** 0.5 + 1e-9


class Pod(nn.Module):
    """Principal components of displacement fields (proper orthogonal decomposition), not centred: rest is
    zero.

    Args:
      nvert: nodes. modes: components.

    Attributes:
      basis: (3 nvert, modes) orthonormal. scale: (modes,) root mean square of each component.
    """

    def __init__(self, nvert: int, modes: int = 128):
        super().__init__()
        self.nvert = nvert
        self.register_buffer("basis", torch.zeros(3 * nvert, modes))
        self.register_buffer("scale", torch.ones(modes))

    @classmethod
    def fit(
        cls, field: torch.Tensor, rows: torch.Tensor, modes: int = 128, most: int = 16000, seed: int = 0
    ) -> "Pod":
        """Fits to at most `most` rows of a field (n, nvert, 3) [mm], by a randomised decomposition."""
        generator = torch.Generator().manual_seed(seed)
        if len(rows) > most:
            rows = rows[torch.randperm(len(rows), generator=generator)[:most].to(rows.device)]
        torch.manual_seed(seed)
        basis, scale = orthogonal_modes(field[rows].flatten(1).float(), modes)
        out = cls(field.shape[1], len(scale)).to(basis.device)
        out.basis.copy_(basis), out.scale.copy_(scale)
        return out

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """(n, modes) components, with unit variance in training, of u (n, nvert, 3) [mm]."""
        return u.flatten(1).to(self.basis.dtype) @ self.basis / self.scale

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        """(n, nvert, 3) [mm] of components."""
        return ((x * self.scale) @ self.basis.T).view(len(x), self.nvert, 3)


class FilmFeatures(nn.Module):
    """Film and strain of the inner skin over each electrode, for one head shared by all electrodes.

    The gap h of an inner node is its rest value plus the displacement along the direction away from the core
    (linearised), at least 50 um. Gaussian patches of three radii around each electrode give: mean ln(h / h0),
    mean h0 / h - 1, displacement along the electrode's normal and two tangents [mm]; the gradient of the
    displacement over the middle patch (6, the skin's local strain and tilt); and mean ln(h / h0) near the
    k excitation electrodes and over the whole film (k + 1), which all currents cross.

    The second tangent points away from the midplane, so that an electrode and its mirror image have equal
    features.

    Args:
      geometry: SkinGeometry.

    Attributes:
      count: features of one electrode.
    """

    def __init__(self, geometry: SkinGeometry):
        super().__init__()
        node = np.setdiff1d(np.unique(geometry.inner_face), geometry.fixed)
        place = geometry.vert[node]
        core = CoreSurface(geometry.core_vert, geometry.core_face)
        gap, foot, triangle = core.closest(place)
        away = place - foot
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away = np.where(length > 1e-5, away / np.maximum(length, 1e-12), core.normal[triangle])
        gap = np.maximum(gap, _FILM)
        self.nvert = geometry.nvert
        normal = geometry.electrode_normal
        along = np.array([1.0, 0, 0]) - normal[:, :1] * normal
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.cross(normal, along)
        side = np.where(
            np.abs(geometry.electrode_pos[:, 2]) < 5e-4, 1.0, np.sign(geometry.electrode_pos[:, 2])
        )
        across *= (np.sign(across[:, 2]) * side)[:, None]
        frame = np.stack([normal, along, across], 1)  # (nelectrode, 3, 3): rows are directions

        # over an electrode: distance along the surface from the skin point on its normal; points across the
        # finger are far in depth
        offset = place[None] - geometry.electrode_pos[:, None]
        height = np.einsum("enk,ek->en", offset, normal)
        flat = np.linalg.norm(offset - height[..., None] * normal[:, None], axis=2)
        facing = np.einsum("nk,ek->en", away, normal)
        patches = []
        for radius in _RADII:
            w = np.exp(-0.5 * (flat / radius) ** 2) * (height > -1.5e-3) * np.clip(facing, 0, 1)
            w = np.where(
                w.sum(1, keepdims=True) > 1e-6,
                w,
                np.exp(-0.5 * (np.linalg.norm(offset, axis=2) / radius) ** 2) + 1e-30,
            )
            patches.append(w / w.sum(1, keepdims=True))
        w = patches[1]
        tangent = np.einsum("enk,eak->ena", offset, frame[:, 1:])  # (nelectrode, n, 2)
        centred = tangent - np.einsum("en,ena->ea", w, tangent)[:, None]
        spread = np.einsum("en,ena,enb->eab", w, centred, centred)
        # (nelectrode, 2, n)
        slope = np.einsum("en,ena,eab->ebn", w, centred, np.linalg.inv(spread + 1e-9 * np.eye(2)))
        operators = [w_[:, None] for w_ in patches] + [1e-3 * slope]
        # (nelectrode, 5, n) acts on each component in the electrode's frame
        operator = np.concatenate(operators, 1)
        linear = np.einsum("ekn,eac->ekanc", operator, frame).reshape(3 * operator[..., 0].size, -1)

        seeds = excitation_places(geometry.design.excitation, geometry.design, published=True)
        g = np.exp(-0.5 * (np.linalg.norm(place[None] - seeds[:, None], axis=2) / 3e-3) ** 2)
        g = np.concatenate([g, np.ones((1, len(node)))])
        g /= g.sum(1, keepdims=True)
        # an electrode and its mirror image see the excitation electrodes in mirrored order
        k, lead = len(seeds), seeds[np.abs(seeds[:, 2]).argmax(), 2]
        mirrored = cKDTree(seeds).query(seeds * [1, 1, -1])[1]
        other = geometry.electrode_pos[:, 2:] * np.sign(lead) < 0
        order = np.where(other, [*mirrored, k], np.arange(k + 1))
        self.count = 5 * len(_RADII) + 6 + k + 1
        self.register_buffer("order", torch.as_tensor(order), persistent=False)
        for name, value in (
            ("linear", linear),
            ("away", away),
            ("patch", np.concatenate(patches)),
            ("whole", g),
            ("gap", 1e3 * gap),
        ):
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        self.register_buffer("node", torch.as_tensor(node), persistent=False)

    def forward(self, u: torch.Tensor) -> torch.Tensor:
        """(n, nelectrode, count) of u (n, nvert, 3) [mm]."""
        inner = u[:, self.node].float()
        n = len(u)
        linear = (inner.flatten(1) @ self.linear.T).view(n, len(self.order), -1)
        film = torch.clamp(self.gap + (inner * self.away).sum(2), min=1e3 * _FILM)
        thinner = torch.log(film / self.gap)
        inverse = self.gap / film - 1
        # ln of the mean of 1/h is for resistances in series; ln h alone is averaged as is
        means = thinner @ self.patch.T, torch.log1p((inverse @ self.patch.T).clamp(min=-0.9))
        local = [mean.view(n, len(_RADII), -1).transpose(1, 2) for mean in means]
        whole = (thinner @ self.whole.T)[:, self.order]
        return torch.cat([*local, linear, whole], 2)


def mirror_matrix(geometry: SkinGeometry) -> csr_matrix:
    """(nvert, nvert) CSR: values of a nodal field at the points mirrored in z = 0. Curved surfaces do not map
    onto themselves exactly."""
    return shape_values(geometry.vert, geometry.tets, geometry.vert * [1, 1, -1])


def mirror_order(geometry: SkinGeometry) -> np.ndarray | None:
    """(nelectrode,) electrode that is the mirror image of each one in z = 0; None for a fingertip that is
    not symmetric."""
    flip = np.array([1, 1, -1])
    off, order = cKDTree(geometry.electrode_pos).query(geometry.electrode_pos * flip)
    error = np.linalg.norm(mirror_matrix(geometry) @ geometry.vert - geometry.vert * flip, axis=1)
    return order if max(off.max(), np.quantile(error, 0.98)) < SAME_SHAPE else None
