"""The preconditioner of `preconditioner.py` for all worlds at once on a CUDA device, in torch's batched
linear algebra."""

import numpy as np
import torch
import warp as wp

from .preconditioner import body_tangent
from .types import mat33

__all__ = ["BatchPreconditioner"]

wp.set_module_options({"enable_backward": False})

_PAD = 16  # touching nodes are padded to a multiple of this, so that few shapes of matrices occur
_STIFF = 1e5  # [N/m]


@wp.kernel
def scatter_blocks(
    # In:
    face: wp.array(dtype=wp.vec3i),
    touching: wp.array2d(dtype=int),
    block: wp.array2d(dtype=mat33),
    slot: wp.array2d(dtype=int),
    nslot: int,
    # Out:
    stiffness_out: wp.array3d(dtype=wp.float32),
):
    """Adds the contact tangents of the touching faces to each world's matrix over its touching nodes."""
    f, w = wp.tid()
    if touching[f, w] == 0:
        return
    k = int(0)
    for a in range(3):
        i = slot[face[f][a], w]
        for b in range(a, 3):
            j = slot[face[f][b], w]
            if i < nslot and j < nslot:
                K = block[6 * f + k, w]
                for c in range(3):
                    for d in range(3):
                        wp.atomic_add(stiffness_out, w, 3 * i + c, 3 * j + d, wp.float32(K[c, d]))
                        if a != b:
                            wp.atomic_add(stiffness_out, w, 3 * j + d, 3 * i + c, wp.float32(K[c, d]))
            k += 1


class BatchPreconditioner:
    """(A0 + U D U^T)^-1 by Woodbury's identity, one small system for each world, all of the size of the
    largest."""

    def __init__(self, model, scale):
        self.factor = model.factor
        self.device = wp.device_to_torch(model.device)
        self.scale = torch.as_tensor(scale, device=self.device)
        self.nvert = model.nvert
        index = torch.full((model.nvert + 1,), -1, device=self.device)
        index[torch.as_tensor(model.free, device=self.device)] = torch.arange(
            len(model.free), device=self.device
        )
        self.free_index = index
        self._inverse = self.factor.inverse.view(self.factor.padded // 3, 3, self.factor.padded // 3, 3)
        self._faces = {}

    def clear(self):
        """For skins that nothing touches."""
        self.size, self.gradient = 0, None

    def update(self, states, residual, gradient, kappa):
        """See `Preconditioner.update`; on the device."""
        # the liquid's direction is scaled so that its stiffness is like that of contact: single precision
        # then suffices
        self.kappa = _STIFF
        self.gradient = (
            None
            if gradient is None
            else gradient * torch.as_tensor((kappa / _STIFF) ** 0.5, device=self.device)[:, None]
        )
        gradient = self.gradient
        nworld = len(self.scale)
        faces = [self._face(s.surface.face_np) for s in states]
        flag = torch.zeros(self.nvert, nworld, device=self.device, dtype=torch.int32)
        for face, state in zip(faces, states):
            for corner in range(3):
                flag.index_add_(0, face[:, corner], wp.to_torch(state.touching))
        touched = (flag > 0) & (self.free_index[:-1, None] >= 0)
        slot = (torch.cumsum(touched.T.contiguous(), 1, dtype=torch.int32) - 1).T
        count = int(touched.sum(0).max())
        m = -(-count // _PAD) * _PAD
        slot = torch.where(touched, slot, m)  # slot m catches what is not touched
        nodes = torch.full((m + 1, nworld), self.nvert, device=self.device)
        nodes.scatter_(
            0, slot.long(), torch.arange(self.nvert, device=self.device)[:, None].expand(-1, nworld)
        )
        self.nodes = nodes[:m].T.contiguous()  # (nworld, m), nvert where unused
        self.size = 3 * m + (gradient is not None)
        if not self.size:
            return self.apply(residual)
        self.used = (self.nodes < self.nvert).repeat_interleave(3, 1)
        D = self._stiffness(states, slot)
        W = self._compliance(m)
        system = D @ W
        system.diagonal(dim1=1, dim2=2).add_(1)
        self.D, self.W, (self.lu, self.pivots) = D, W, torch.linalg.lu_factor(system)
        return self.apply(residual)

    def _face(self, face):
        key = id(face)
        if key not in self._faces:
            self._faces[key] = face, torch.as_tensor(face, device=self.device, dtype=torch.int64)
        return self._faces[key][1]

    def _stiffness(self, states, slot):
        nworld = len(self.scale)
        D = torch.zeros(nworld, self.size, self.size, device=self.device)
        slot = wp.from_torch(slot.int().contiguous())
        for state in states:
            wp.launch(
                scatter_blocks,
                dim=state.touching.shape,
                inputs=[state.surface.face, state.touching, state.block, slot, self.nodes.shape[1]],
                outputs=[wp.from_torch(D)],
                device=slot.device,
            )
        if self.gradient is not None:
            D[:, -1, -1] = self.kappa
        return D

    def _compliance(self, m):
        nworld = len(self.scale)
        W = torch.zeros(nworld, self.size, self.size, device=self.device)
        if m:
            local = self.free_index[self.nodes].clamp_min(0)
            block = self._inverse[local[:, :, None], :, local[:, None, :], :]  # (nworld, m, m, 3, 3)
            W[:, : 3 * m, : 3 * m] = (
                block.transpose(2, 3).reshape(nworld, 3 * m, 3 * m).float() * self.factor.scale
            )
            W[:, : 3 * m, : 3 * m] *= self.used[:, :, None] * self.used[:, None, :]
        if self.gradient is not None:
            along = self.factor.solve(self.gradient)
            W[:, -1, -1] = (self.gradient * along).sum((0, 2)).float()
            W[:, : 3 * m, -1] = W[:, -1, : 3 * m] = self._at_nodes(along).float()
        return W / self.scale[:, None, None].float()

    def _at_nodes(self, z):
        padded = torch.cat([z, z.new_zeros(1, *z.shape[1:])])
        world = torch.arange(z.shape[1], device=self.device)[:, None]
        return padded[self.nodes, world].reshape(z.shape[1], -1)

    def tangent(self, w, blocks, x):
        """See `Preconditioner.tangent`."""
        if not self.size:
            return np.zeros((6, 6))
        used = (self.nodes[w] < self.nvert).cpu().numpy()
        keep = np.concatenate([np.repeat(used, 3), np.ones(self.size - 3 * len(used), bool)])
        D, W = (a[w].double().cpu().numpy()[keep][:, keep] for a in (self.D, self.W))
        return body_tangent(
            self.nodes[w].cpu().numpy()[used],
            W,
            lambda u: np.linalg.solve(np.eye(len(D)) + D @ W, D @ u),
            blocks,
            x,
            self.nvert,
        )

    def apply(self, r):
        """Approximate inverse of the tangent times r: (nvert, nworld, 3), zero at fixed nodes."""
        z = self.factor.solve(r) / self.scale[:, None]
        if not self.size:
            return z
        u = self._at_nodes(z)
        if self.gradient is not None:
            u = torch.cat([u, (self.gradient * z).sum((0, 2))[:, None]], 1)
        q = torch.linalg.lu_solve(self.lu, self.pivots, (self.D @ u.float()[..., None])).squeeze(-1).double()
        push = z.new_zeros(self.nvert + 1, z.shape[1], 3)
        m = self.nodes.shape[1]
        world = torch.arange(z.shape[1], device=self.device)[:, None].expand(-1, m)
        push[self.nodes, world] = q[:, : 3 * m].reshape(-1, m, 3)
        push = push[:-1]
        if self.gradient is not None:
            push = push + q[:, -1, None] * self.gradient
        return z - self.factor.solve(push) / self.scale[:, None]
