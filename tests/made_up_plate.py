"""A made-up sensor under a plate: a table of states without a skin."""

import numpy as np

from biotac_mj.geometry.design import BIOTAC
from biotac_mj.matching.states import PlateGrid, PlateStates

__all__ = ["MIRROR", "made_up_states"]

MIRROR = [10, 11, 12, 13, 14, 15, 6, 8, 7, 9, 0, 1, 2, 3, 4, 5, 16, 17, 18]  # E1..E6 and E11..E16, E8 and E9


def made_up_states(drag: tuple = PlateGrid().drag, design=BIOTAC):
    """PlateStates and log_z of a made-up sensor whose electrodes answer smoothly to where the plate faces,
    how it is dragged and how hard it presses, in mirror symmetry."""
    grid = PlateGrid(
        pitch=tuple(np.linspace(-0.1, 0.6, 6)),
        roll=tuple(np.linspace(0, 0.8, 4)),
        drag=drag,
        load=tuple(np.geomspace(2e-7, 2e-5, 8)),
    )
    way = np.array(grid.drag_paths)
    pitch, roll, load = np.meshgrid(grid.pitch, grid.roll, grid.load, indexing="ij")
    pitch, roll, load = pitch[:, :, None], roll[:, :, None], load[:, :, None]
    along, across = way[:, 0, None], way[:, 1, None]
    x = (pitch + 0.15 * along)[..., None]
    y = (roll + 0.2 * across)[..., None]
    place = np.random.default_rng(0).uniform([-0.1, -0.9], [0.6, 0.9], (design.nelectrode, 2))
    place = (place + place[design.mirror] * [1, -1]) / 2  # a mirrored electrode lies on the other side
    near = np.exp(-((x - place[:, 0]) ** 2 / 0.06 + (y - place[:, 1]) ** 2 / 0.15))
    log_z = (1.6 * near - 0.35) * ((load / 1e-6) ** 0.45)[..., None] * 0.5
    force = np.stack(np.broadcast_arrays(0.5 * along * load, 0.6 * across * load, load), -1)
    shape = force.shape[:-1]
    states = PlateStates(
        grid,
        np.zeros(1, int),
        np.zeros((1, 3)),
        np.zeros((*shape, 1, 3)),
        force,
        load + 0 * along,
        force[..., -1, 2],
        load + 0 * along,
        design,
    )
    return states, np.broadcast_to(log_z, (*shape, design.nelectrode)).copy()
