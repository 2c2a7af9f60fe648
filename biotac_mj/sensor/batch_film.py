"""`FilmConduction` for many worlds on one device: the impedance of the 19 electrodes without leaving it.

The same film, nodes, discs and closed forms as `film.py`, in Warp: distances from the core's triangles
(double precision on the nearest one), the sheet Laplacian as a band of tiles, its Cholesky factor by one
thread block per world. A direct solution costs some 20 million operations per world; conjugate gradients
would need tens of iterations, since a film pressed to a twentieth of its thickness is far from the one at
rest. Only worlds that are due compute anything, so the same launches can be recorded in a CUDA graph and
replayed every step."""

import numpy as np
import warp as wp

from biotac_mj.sensor import film_kernels as kernels
from biotac_mj.sensor.film_kernels import NDISC, TILE, real, vec3

__all__ = ["BatchFilm"]


class BatchFilm:
    """The film of `nworld` sensors of one geometry.

    Args:
      film: the `FilmConduction` whose constants it takes; four excitation electrodes.
      nworld: number of worlds.
      device: Warp device.

    Attributes:
      impedance: (nworld, 19) wp.array float64 [ohm], of the last `solve` that succeeded; at rest before.
      valid: (nworld,) wp.array int, 0 where the last one failed: an electrode without film over it, or a
        position that is not finite.
      nbytes: device memory of all worlds.

    Raises:
      ValueError: another number of excitation electrodes than four.
    """

    def __init__(self, film, nworld, device="cpu"):
        if len(film.excitation_pos) != 4:
            raise ValueError(
                f"the film has {len(film.excitation_pos)} excitation electrodes: a batch of films needs the "
                "sensor's four"
            )
        self.film, self.nworld, self.device = film, nworld, wp.get_device(device)
        self._rest = film.impedance(film.geometry.vert)
        n = len(film.node)
        self._nblock = -(-n // TILE)
        pattern = _Pattern(film.face, n)
        self._reach = pattern.reach
        rows = self._nblock * (self._reach + 1) * TILE
        electrode, face = film._pair
        order = np.argsort(electrode, kind="stable")
        table_step, table = _spreading(film)
        with wp.ScopedDevice(self.device):
            core = film.geometry
            self._mesh = wp.Mesh(
                wp.array(core.core_vert * 1e3, dtype=wp.vec3), wp.array(core.core_face.ravel(), dtype=int)
            )
            self._node = wp.array(film.node, dtype=int)
            self._face = wp.array(film.face, dtype=wp.vec3i)
            self._entry = wp.array(pattern.entry, dtype=wp.vec2i)
            self._sign = wp.array(pattern.sign, dtype=real)
            self._start = wp.array(pattern.start, dtype=int)
            self._slot = wp.array(pattern.slot, dtype=int)
            self._pos = wp.array(film._pos, dtype=vec3)
            self._tangent = wp.array(film._tangent, dtype=vec3, ndim=2)
            self._pair_start = wp.array(np.searchsorted(electrode[order], np.arange(NDISC + 1)), dtype=int)
            self._pair_face = wp.array(face[order], dtype=int)
            self._disc = wp.array(film._disc, dtype=wp.vec2d)
            self._table, self._table_step = wp.array(table, dtype=real), table_step
            self._cell_constant = wp.array(film.cell_constant, dtype=real)
            self.impedance = wp.array(np.tile(self._rest, (nworld, 1)), dtype=real)
            self.valid = wp.ones(nworld, dtype=int)
            per_world = [
                ("_middle", (n, nworld), vec3),
                ("_thickness", (n, nworld), real),
                ("_edge", (3 * len(film.face), nworld), real),
                ("_band", (nworld, rows, TILE), real),
                ("_rhs", (nworld, self._nblock * TILE, TILE), real),
                ("_local", (NDISC, nworld), real),
                ("_resistance", (nworld, TILE, TILE), real),
            ]
            for name, shape, dtype in per_world:
                setattr(self, name, wp.zeros(shape, dtype=dtype))
            self._nothing = wp.zeros((0, nworld), dtype=real)
        self.nbytes = sum(getattr(self, name).capacity for name, _, _ in per_world)

    @property
    def rest(self):
        """(19,) impedance at rest [ohm]."""
        return self._rest

    def solve(self, x, due):
        """New impedances of the worlds that are due. Launches only: may be captured in a CUDA graph.

        Args:
          x: (nvert, nworld) wp.array of vec3d, nodes in the BioTac frame [m].
          due: (nworld,) wp.array of int, 0 where the last impedances stay.

        Raises:
          ValueError: an array is on another device.
        """
        if x.device != self.device or due.device != self.device:
            raise ValueError(
                f"the film is on {self.device}, x on {x.device} and due on {due.device}: make both where "
                "the film is"
            )
        f, nworld = self.film, self.nworld
        surface = [self._middle, self._thickness]

        def launch(kernel, dim, inputs, outputs):
            wp.launch(kernel, dim=dim, inputs=[due, *inputs], outputs=outputs, device=self.device)

        launch(
            kernels.film_surface, self._middle.shape, [self._mesh.id, self._node, f.residual_film, x], surface
        )
        launch(
            kernels.face_conductance,
            (len(self._face), nworld),
            [self._face, f.conductivity, *surface],
            [self._edge],
        )
        launch(kernels.clear_system, self._band.shape, [], [self._band, self._rhs])
        launch(
            kernels.assemble,
            (len(self._entry), nworld),
            [self._entry, self._sign, self._start, self._slot, self._edge],
            [self._band],
        )
        discs = [
            self._pos,
            self._tangent,
            self._pair_start,
            self._pair_face,
            self._disc,
            self._face,
            f._footprint,
        ]
        launch(kernels.cover_discs, (NDISC, nworld), [*discs, *surface], [self._rhs, self._local])
        wp.launch_tiled(
            kernels.solve_band,
            dim=[nworld],
            inputs=[due, self._nblock, self._reach, self._band, self._rhs],
            outputs=[self._resistance],
            block_dim=128,
            device=self.device,
        )
        constants = [
            self._table,
            self._table_step,
            f.electrode_radius,
            f._footprint,
            f.conductivity,
            self._cell_constant,
        ]
        launch(
            kernels.driving_point,
            nworld,
            [self._resistance, self._local, *constants],
            [self.impedance, self.valid],
        )


class _Pattern:
    """Where the Laplacian's entries come from and go to: tiles of the band, the lower ones stored transposed
    under their column's diagonal.

    entry (nentry, 2): row and column in the stored band; entry 0 is the first diagonal. sign (nentry,), start
      (nentry + 1,), slot: edges of
    faces (3 face + corner) that add up to it, none for padding.
    """

    def __init__(self, face, n):
        i, j = (np.roll(face, -k, axis=1).ravel() for k in (1, 2))
        low, high = np.minimum(i, j), np.maximum(i, j)
        self.reach = max(int((high // TILE - low // TILE).max()), 1)
        edge = np.arange(len(low))
        padding = np.arange(n, -(-n // TILE) * TILE)
        # row <= column; the diagonal takes every edge at its node
        used, number = np.unique(
            np.concatenate([low * (n + 1), high * (n + 1), low * n + high]), return_inverse=True
        )
        order = np.argsort(number, kind="stable")
        self.slot = np.tile(edge, 3)[order]
        row, column = np.concatenate([used // n, padding]), np.concatenate([used % n, padding])
        self.start = np.concatenate(
            [np.searchsorted(number[order], np.arange(len(used) + 1)), np.full(len(padding), len(order))]
        )
        self.sign = np.where(row == column, 1.0, -1.0)
        block, down = row // TILE, column // TILE - row // TILE
        at = (block * (self.reach + 1) + down) * TILE + row % TILE
        self.entry = np.stack([at, column % TILE], axis=1)
        # Cholesky of the first tile of each column needs its lower triangle too
        inside = (down == 0) & (row != column)
        self._mirror(inside, block, row, column)

    def _mirror(self, inside, block, row, column):
        which = np.flatnonzero(inside)
        count = self.start[which + 1] - self.start[which]
        slot = (
            np.concatenate([self.slot[self.start[k] : self.start[k + 1]] for k in which])
            if len(which)
            else np.zeros(0, int)
        )
        at = block[which] * (self.reach + 1) * TILE + column[which] % TILE
        self.entry = np.concatenate([self.entry, np.stack([at, row[which] % TILE], axis=1)])
        self.sign = np.concatenate([self.sign, -np.ones(len(which))])
        self.slot = np.concatenate([self.slot, slot])
        self.start = np.concatenate([self.start, self.start[-1] + np.cumsum(count)])


def _spreading(film):
    """Step in r / (1 + r) and values of the film's table of `spreading_resistance`."""
    s = np.linspace(0, 0.98, 200)
    return float(s[1]), film._spreading(s / (1 - s))
