"""Remembered launches: the present contents of the same arrays, other arguments, and no more of them than a
few skins'."""

import numpy as np
import warp as wp
from biotac_mj.skin.elasticity import gather
from biotac_mj.skin.launch import Launches

from biotac_mj.skin import launch as module
from biotac_mj.skin.types import vec3


def test_contents_and_arguments_may_change():
    wp.init()
    launch = Launches("cpu")
    start, slot = wp.array([0, 2, 3], dtype=int, device="cpu"), wp.array([0, 1, 2], dtype=int, device="cpu")
    corner, out = (wp.zeros((n, 1), dtype=vec3, device="cpu") for n in (3, 2))
    for scale in (1.0, 2.0, 1.0):
        for size in (1, 5):
            corner.numpy()[...] = size * np.arange(9).reshape(3, 1, 3)
            launch(gather, (2, 1), [start, slot, corner, scale, 0], [out])
            np.testing.assert_array_equal(out.numpy()[:, 0], scale * size * np.array([[3, 5, 7], [6, 7, 8]]))
    assert len(launch._known) == 2


def test_few_are_kept(monkeypatch):
    monkeypatch.setattr(module, "_MOST", 3)
    launch = Launches("cpu")
    start, slot = wp.array([0, 1], dtype=int, device="cpu"), wp.array([0], dtype=int, device="cpu")
    for k in range(10):  # arrays that live no longer than this: their places in memory are taken by the next
        corner, out = (wp.full((1, 1), value=wp.vec3d(float(k)), dtype=vec3, device="cpu") for _ in range(2))
        launch(gather, (1, 1), [start, slot, corner, 1.0, 1], [out])
        assert (out.numpy() == 2 * k).all()
        del corner, out
        assert len(launch._known) <= 3
