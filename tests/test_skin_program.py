"""Programs: recorded once on the CPU, played again with the present contents of the same arrays, with loops,
branches and functions of the host between the launches."""

import gc
import weakref

import numpy as np
import pytest
import warp as wp

from biotac_mj.skin.block import block_sum
from biotac_mj.skin.program import Launcher, Program

CPU = "cpu"


@wp.kernel(enable_backward=False)
def add(a: wp.array(dtype=int), k: int, out: wp.array(dtype=int)):
    i = wp.tid()
    out[i] = out[i] + k * a[i]


@wp.kernel(enable_backward=False)
def count_down(flag: wp.array(dtype=int)):
    flag[0] = wp.max(flag[0] - 1, 0)


@wp.kernel(enable_backward=False)
def sum_block(a: wp.array2d(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    i, t = wp.tid()
    s = wp.float64(0.0)
    for k in range(t, a.shape[1], wp.block_dim()):
        s += a[i, k]
    total = block_sum(s)
    if t == 0:
        out[i] = total


def ints(*values):
    return wp.array(np.array(values, np.int32), dtype=int, device=CPU)


def test_it_is_recorded_once_and_played_with_present_contents():
    a, out, calls = ints(1, 2, 3), ints(0, 0, 0), []

    def record(program):
        calls.append(program)
        program.launch(add, 3, [a, 2], [out])
        program.launch(add, (3,), [a, 10, out])

    program = Program(CPU, record)
    assert calls == [program] and not out.numpy().any()  # recorded, not run
    program.run()
    np.testing.assert_array_equal(out.numpy(), [12, 24, 36])
    a.assign([1, 0, -1])
    program.run()
    np.testing.assert_array_equal(out.numpy(), [24, 24, 24])
    assert len(calls) == 1


def test_loops_and_branches_look_at_their_flags_when_they_run():
    one, out, other = ints(1), ints(0), ints(0)
    outer, inner, which = ints(0), ints(0), ints(0)

    def again(program):
        program.launch(count_down, 1, [], [outer])
        program.launch(add, 1, [one, 2], [inner])
        program.loop(inner, lambda: (program.launch(count_down, 1, [], [inner]),
                                     program.launch(add, 1, [one, 1], [out])))  # fmt: skip

    def record(program):
        program.loop(outer, lambda: again(program))
        program.branch(
            which,
            lambda: program.launch(add, 1, [one, 100], [other]),
            lambda: program.launch(add, 1, [one, 1], [other]),
        )
        program.branch(which, lambda: program.launch(add, 1, [one, 1000], [other]))

    for made in (Program(CPU, record), None):
        out.zero_()
        other.zero_()
        for turns, chosen in ((0, 0), (3, 1), (1, 0)):
            before = out.numpy()[0], other.numpy()[0]
            outer.fill_(turns)
            which.fill_(chosen)
            record(Launcher(CPU)) if made is None else made.run()  # a launcher does the same at once
            assert out.numpy()[0] - before[0] == 2 * turns
            assert other.numpy()[0] - before[1] == (1100 if chosen else 1)
            assert outer.numpy()[0] == inner.numpy()[0] == 0


def test_functions_of_the_host_take_their_turn():
    a, out, seen = ints(5), ints(0), []
    flag = ints(0)

    def record(program):
        program.call(lambda: seen.append(int(out.numpy()[0])))
        program.launch(add, 1, [a, 1], [out])
        program.branch(flag, lambda: program.call(lambda: seen.append("branch")))
        program.call(lambda: a.fill_(int(out.numpy()[0])))

    program = Program(CPU, record)
    assert seen == []
    program.run()
    flag.fill_(1)
    program.run()
    assert seen == [0, 5, "branch"] and out.numpy()[0] == 10


def test_blocks_of_threads_sum_their_rows():
    a = wp.array(np.arange(12.0).reshape(3, 4), dtype=wp.float64, ndim=2, device=CPU)
    out = wp.zeros(3, dtype=wp.float64, device=CPU)
    program = Program(CPU, lambda p: p.launch_blocks(sum_block, [3], [a], [out]))
    for scale in (1.0, -2.0):
        a.assign(scale * np.arange(12.0).reshape(3, 4))
        program.run()
        np.testing.assert_array_equal(out.numpy(), scale * np.array([6.0, 22.0, 38.0]))


def test_nothing_to_do_is_nothing():
    """Launches over no items; a program without launches."""
    out, none = ints(7), ints(1)[:0]
    Program(CPU, lambda p: [p.launch(add, dim, [none, 1], [out]) for dim in (0, (0,), [0])]).run()
    Program(CPU, lambda p: None).run()
    assert out.numpy()[0] == 7


def test_arguments_live_as_long_as_the_program():
    """Arrays that only the recorded launches know, also inside loops and branches."""
    out, held = ints(0, 0, 0), []

    def array(k):
        held.append(weakref.ref(made := wp.full(3, k, dtype=int, device=CPU)))
        return made

    flag = ints(1)

    def record(program):
        program.launch(add, 3, [array(1), 1], [out])
        program.branch(flag, lambda: program.launch(add, 3, [array(10), 1], [out]))

    program = Program(CPU, record)
    gc.collect()
    trash = [wp.full(3, -77, dtype=int, device=CPU) for _ in range(50)]
    assert all(ref() is not None for ref in held)
    program.run()
    np.testing.assert_array_equal(out.numpy(), [11, 11, 11])
    del program, trash
    gc.collect()
    assert all(ref() is None for ref in held)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_cuda_calls_no_function_of_the_host():
    for launcher in (Launcher("cuda:0"), Program("cuda:0", lambda p: None)):
        with pytest.raises(ValueError, match="cannot be part of a program on CUDA"):
            launcher.call(lambda: None)
