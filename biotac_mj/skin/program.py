"""Launches of kernels with loops and branches between them, made once and run many times.

On CUDA they are launched as they come, so that a caller's capture makes them nodes of its graph, loops and
branches conditional ones (CUDA 12.4 and later). On the CPU a `Program` records them and plays the record:
packing a launch's arguments takes Warp longer than many of the kernels run.
"""

import concurrent.futures
import ctypes
import os
import types
from collections.abc import Callable, Iterable, Sequence

import warp as wp

from ..launches import in_a_row, recorded, repeated

__all__ = ["Fork", "Launcher", "Program", "compile_ahead", "compile_kernels", "finish_compiling"]


class Launcher:
    """Launches at once, on one device."""

    _packed = None  # launches whose arguments are packed, while something is recorded on CUDA

    def __init__(self, device: wp.DeviceLike):
        self.device = wp.get_device(device)

    def launch(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
        block_dim: int = 256,
    ) -> None:
        """A kernel over dim."""
        self._send(wp.launch, kernel, dim, inputs, outputs, block_dim)

    def launch_blocks(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
        block_dim: int = 128,
    ) -> None:
        """A block of threads for each item of dim."""
        self._send(wp.launch_tiled, kernel, dim, inputs, outputs, block_dim)

    def _send(self, launch, kernel, dim, inputs, outputs, block_dim):
        how = dict(dim=dim, inputs=inputs, outputs=list(outputs), block_dim=block_dim, device=self.device)
        if self._packed is None:
            launch(kernel, **how)
            return
        # a step launches the same at several places, and packing is most of the time that recording takes
        key = kernel, str(dim), block_dim, *(_same(a) for a in (*inputs, *outputs))
        if key not in self._packed:  # with the arguments, which would free their numbers otherwise
            self._packed[key] = launch(kernel, **how, record_cmd=True), how
        command = self._packed[key][0]
        if command is not None:  # there is something to launch it over
            command.launch()

    def loop(self, flag: wp.array, body: Callable[[], None]) -> None:
        """body again and again while flag[0] is not zero."""
        wp.capture_while(flag, body)

    def branch(
        self, flag: wp.array, body: Callable[[], None], otherwise: Callable[[], None] | None = None
    ) -> None:
        """body if flag[0] is not zero, else `otherwise`."""
        wp.capture_if(flag, body, otherwise)

    def call(self, function: Callable[[], None]) -> None:
        """A function of the host: on the CPU only, where arrays are its memory."""
        if self.device.is_cuda:
            raise ValueError("a function of the host cannot be part of a program on CUDA")
        function()


class _Modules(Launcher):
    """Launches nothing: finds the modules of the kernels that would be, on every branch."""

    def __init__(self, device: wp.DeviceLike):
        super().__init__(device)
        self.found = {}

    def launch(self, kernel, dim, inputs, outputs=(), block_dim=256):
        if _any(dim):
            self.found[kernel.module, block_dim] = None

    def launch_blocks(self, kernel, dim, inputs, outputs=(), block_dim=128):
        self.launch(kernel, dim, inputs, outputs, block_dim)

    def loop(self, flag, body):
        body()

    def branch(self, flag, body, otherwise=None):
        body()
        if otherwise:
            otherwise()

    def call(self, function):
        pass


# what compiles each module, or has: to ask Warp for it takes longer than to record a step
_begun: dict[tuple, concurrent.futures.Future] = {}


def compile_ahead(
    device: wp.DeviceLike, modules: Iterable[tuple[types.ModuleType | wp.Module, int]]
) -> list[concurrent.futures.Future]:
    """Begins to compile modules of kernels for a CUDA device, behind what goes on and beside each other: Warp
    would one by one, as they are launched.

    Args:
      device: Warp device; nothing happens where it is no CUDA device.
      modules: Python's, whose kernels are all there once they are imported, or Warp's own, each with the
        threads of the blocks that it is launched by; what takes long first.

    Returns:
      what `finish_compiling` waits for.
    """
    device = wp.get_device(device)
    if not device.is_cuda:
        return []
    wanted = {}
    for module, threads in modules:
        module = wp.get_module(module.__name__) if isinstance(module, types.ModuleType) else module
        # a module may have got more kernels since
        wanted[module, len(module.kernels), device.alias, threads] = module, threads
    pool = concurrent.futures.ThreadPoolExecutor(os.cpu_count())
    for key, (module, threads) in wanted.items():
        if key not in _begun:
            _begun[key] = pool.submit(wp.load_module, module, device, block_dim=threads)
    pool.shutdown(wait=False)
    return [_begun[key] for key in wanted]


def finish_compiling(begun: Iterable[concurrent.futures.Future] | None = None) -> None:
    """Waits for what `compile_ahead` began, None: ever; who launches a kernel that cannot be compiled is
    told."""
    concurrent.futures.wait(list(_begun.values() if begun is None else begun))


def compile_kernels(device: wp.DeviceLike, record: Callable[[Launcher], None]) -> None:
    """Compiles what record(launcher) launches on a CUDA device, and what `compile_ahead` began."""
    modules = _Modules(device)
    record(modules)
    compile_ahead(device, modules.found)
    finish_compiling()


class Fork:
    """Branches of a CUDA graph; on the CPU, or where they are not wanted, one after another.

    Small kernels mostly wait: those of several parts of a skin, or of several skins, wait together.
    """

    def __init__(self, device: wp.DeviceLike, wanted: bool = True):
        self._device, self._streams = wp.get_device(device), []
        self._abreast = wanted and self._device.is_cuda

    def run(self, *branches: Callable[[], None]) -> None:
        """Calls branches, each of launches only (no loop, no branch), that write nothing that another one
        reads or adds to. What is launched afterwards waits for all."""
        if not self._abreast:
            for branch in branches:
                branch()
            return
        main, others = self._device.stream, branches[1:]
        while len(self._streams) < len(others):
            self._streams.append((wp.Stream(self._device), wp.Event(self._device), wp.Event(self._device)))
        for (stream, begin, end), branch in zip(self._streams, others):
            stream.wait_event(main.record_event(begin))
            with wp.ScopedStream(stream, sync_enter=False):
                branch()
                stream.record_event(end)
        for branch in branches[:1]:
            branch()
        for (_, _, end), _ in zip(self._streams, others):
            main.wait_event(end)


class Program(Launcher):
    """What record(program) launches.

    Args:
      device: Warp device.
      record: is called with the program, once on the CPU and at every `run` on CUDA; calls its methods.

    What the arrays hold may change between runs; which arrays, and numbers given as such, may not.
    """

    def __init__(self, device: wp.DeviceLike, record: Callable[["Program"], None]):
        super().__init__(device)
        self._record, self._commands, self._open = record, None, None
        if not self.device.is_cuda:
            self._commands = self._recorded(lambda: record(self))

    def run(self) -> None:
        """Runs it on the device's current stream."""
        if self._commands is None:
            self._packed = {}
            self._record(self)
            self._packed = None
        else:
            for command in self._commands:
                command()

    def forget(self) -> None:
        """Lets go of the launches and of all that they work on: these may hold the program, and Python finds
        circles late, which a skin is too large for."""
        self._record, self._commands = None, []

    def _recorded(self, body):
        outer, self._open = self._open, []
        body()
        commands, self._open = in_a_row(self._open), outer
        return commands

    def launch(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
        block_dim: int = 256,
    ) -> None:
        if self.device.is_cuda:
            super().launch(kernel, dim, inputs, outputs, block_dim)
        elif _any(dim):
            self._open.append(recorded(kernel, dim, inputs, outputs))

    def launch_blocks(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
        block_dim: int = 128,
    ) -> None:
        if self.device.is_cuda:
            super().launch_blocks(kernel, dim, inputs, outputs, block_dim)
        else:
            self._open.append(recorded(kernel, dim, inputs, outputs, tiled=True))

    def loop(self, flag: wp.array, body: Callable[[], None]) -> None:
        if self.device.is_cuda:
            super().loop(flag, body)
            return
        self._open.append(repeated(flag, self._recorded(body)))

    def branch(
        self, flag: wp.array, body: Callable[[], None], otherwise: Callable[[], None] | None = None
    ) -> None:
        if self.device.is_cuda:
            super().branch(flag, body, otherwise)
            return
        on, commands = _value(flag), self._recorded(body)
        others = self._recorded(otherwise) if otherwise else []

        def choose():
            for command in commands if on[0] else others:
                command()

        self._open.append(choose)

    def call(self, function: Callable[[], None]) -> None:
        if self.device.is_cuda:
            super().call(function)
        self._open.append(function)


def _same(argument):
    """What tells arguments apart: numbers by value, all others by being another thing."""
    return argument if isinstance(argument, (int, float)) else (None, id(argument))


def _any(dim):
    """Whether there is anything in dim to be launched over."""
    return all(dim) if isinstance(dim, (tuple, list)) else dim


def _value(flag):
    """The first entry of an int array on the CPU, read faster than through numpy."""
    return ctypes.cast(flag.ptr, ctypes.POINTER(ctypes.c_int32))
