"""Launches on the CPU that are made once: the same as Warp's own, on whatever the arrays hold."""

import concurrent.futures
import gc

import numpy as np
import pytest
import warp as wp

from biotac_mj import launches as module
from biotac_mj.launches import in_a_row, recorded, repeated
from biotac_mj.skin.block import block_sum
from biotac_mj.skin.types import vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class Line:
    slope: wp.float64
    count: int
    offset: wp.array(dtype=wp.float64)


@wp.kernel
def follow(
    line: Line,
    x: wp.array2d(dtype=wp.float64),
    turn: wp.mat33d,
    share: float,
    out: wp.array2d(dtype=wp.float64),
):
    i, j = wp.tid()
    more = wp.float64(line.count) + turn[0, 2] + wp.float64(share)
    out[i, j] = line.slope * x[i, j] + line.offset[j] + more


@wp.kernel
def add_up(x: wp.array2d(dtype=wp.float64), wanted: wp.array(dtype=wp.float64), off: wp.array(dtype=int)):
    """Sums over the threads of a block, of numbers and vectors: counts those that are not as wanted."""
    i, t = wp.tid()
    number = wp.float64(0.0)
    pair = vec3()
    for k in range(t, x.shape[1], wp.block_dim()):
        number += x[i, k]
        pair += vec3(x[i, k], -x[i, k], wp.float64(1.0))
    number = block_sum(number)
    pair = block_sum(pair)
    if number != wanted[i] or pair[0] != number or pair[1] != -number:
        wp.atomic_add(off, i, 1)


def _arrays():
    line, rng = Line(), np.random.default_rng(3)
    line.slope, line.count = wp.float64(2.0), 5
    line.offset = wp.array(rng.normal(size=3), dtype=wp.float64, device="cpu")
    x = wp.array(rng.normal(size=(4, 3)), dtype=wp.float64, device="cpu")
    out = [wp.zeros((4, 3), dtype=wp.float64, device="cpu") for _ in range(2)]
    return [line, x, wp.mat33d(*range(9)), 0.25], x, out


@pytest.mark.parametrize("packed", (True, False))
def test_it_does_what_a_launch_does(packed, monkeypatch):
    """Also where Warp is of another version, whose launches are left to it."""
    if not packed:
        monkeypatch.setattr(module, "_KNOWN", ())
    inputs, x, (wanted, out) = _arrays()
    run = recorded(follow, (4, 3), inputs, [out])
    assert hasattr(run, "references") == (packed and wp.__version__.startswith("1.19."))
    assert not out.numpy().any()  # made, not run
    for _ in range(2):
        run()
        wp.launch(follow, (4, 3), inputs, [wanted], device="cpu")
        assert (out.numpy() == wanted.numpy()).all() and out.numpy().any()
        x.numpy()[:] += 1.0  # its arrays' present contents


def test_its_arrays_live_as_long_as_it():
    inputs, _, (_, out) = _arrays()
    inputs[1] = wp.full((4, 3), 7.0, dtype=wp.float64, device="cpu")
    run = recorded(follow, (4, 3), inputs, [out])
    run()
    first = out.numpy().copy()
    inputs.clear()
    gc.collect()
    others = [wp.zeros((4, 3), dtype=wp.float64, device="cpu") for _ in range(100)]  # where it was
    run()
    assert (out.numpy() == first).all() and len(others) == 100


@wp.kernel
def count(by: int, out: wp.array(dtype=int), left: wp.array(dtype=int)):
    out[0] = 10 * out[0] + by
    left[0] = wp.max(left[0] - 1, 0)


@pytest.mark.parametrize("packed", (True, False))
def test_launches_in_a_row_are_one(packed, monkeypatch):
    """In their order, with loops among them; a function of the host parts them."""
    if not packed:
        monkeypatch.setattr(module, "_KNOWN", ())
    (out, left), seen = (wp.zeros(1, dtype=int, device="cpu") for _ in range(2)), []
    one, two, three = (recorded(count, 1, [k, out, left]) for k in (1, 2, 3))
    again = repeated(left, [two, three])
    row = in_a_row([one, two, again, lambda: seen.append(out.numpy()[0]), one, two])
    assert len(row) == (3 if packed else 6)
    del one, two, three, again
    gc.collect()
    for turns, expected in ((0, 1212), (4, 122312)):  # one and two count as well
        out.zero_()
        left.fill_(turns)
        for run in row:
            run()
        assert out.numpy()[0] == expected
    assert seen == [12, 1223]


def test_blocks_of_several_threads_of_the_host():
    """They sum beside each other, each what is its own."""
    values, sums = np.random.default_rng(5).normal(size=(4, 20_000, 5)), []
    for x in values:
        x = wp.array(x, dtype=wp.float64, device="cpu")
        wanted, off = (wp.zeros(len(values[0]), dtype=t, device="cpu") for t in (wp.float64, int))
        for column in x.numpy().T:  # in the kernel's order
            wanted.numpy()[:] += column
        sums.append((recorded(add_up, [len(x)], [x, wanted, off], tiled=True), off))

    def repeat(run):
        for _ in range(100):
            run()

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        list(pool.map(repeat, [run for run, _ in sums]))
    assert not any(off.numpy().any() for _, off in sums)
