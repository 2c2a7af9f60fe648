"""Programs: kernel launches with loops and branches, made once and run many times.

On CUDA the launches can be captured by the caller, so that loops and branches become conditional nodes of its
graph (CUDA 12.4 and later). On the CPU a `Program` records the launches and replays them, since Warp needs
more time to pack the arguments of a launch than many of the kernels need to run."""

import concurrent.futures
import ctypes
import functools
import threading
import types
from collections.abc import Callable, Iterable, Sequence

import warp as wp

from ..launches import in_a_row, recorded, repeated
from ..quiet import headers
from ..threads import cores

FEW = 16  # up to this number of worlds do not fill the device: work is split more finely
THREADS_FEW = 64  # block size with few worlds: small, so that more multiprocessors take part
LANES_FEW = 8  # threads that sum one node with few worlds: a single thread would wait for each read


class Launcher:
    """Launches kernels immediately, on one device."""

    _packed = None  # launches with packed arguments, during a recording on CUDA

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
        """Launches a kernel over dim."""
        self._send(kernel, dim, inputs, outputs, block_dim)

    def launch_blocks(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
        block_dim: int = 128,
    ) -> None:
        """Launches a kernel with a block of threads for each item of dim."""
        self._send(kernel, dim, inputs, outputs, block_dim, tiled=True)

    def _send(self, kernel, dim, inputs, outputs, block_dim, tiled=False):
        launch = wp.launch_tiled if tiled else wp.launch
        how = dict(dim=dim, inputs=inputs, outputs=list(outputs), block_dim=block_dim, device=self.device)
        if self._packed is None:
            launch(kernel, **how)
            return
        # a step has equal launches at several places, and packing is most of the time of a recording
        key = kernel, str(dim), block_dim, *(_same(a) for a in (*inputs, *outputs))
        if key not in self._packed:  # the arguments are kept, so that their ids are not used again
            self._packed[key] = launch(kernel, **how, record_cmd=True), how
        command = self._packed[key][0]
        if command is not None:  # dim is not empty
            command.launch()

    def loop(self, flag: wp.array, body: Callable[[], None]) -> None:
        """Repeats body while flag[0] is not zero."""
        wp.capture_while(flag, body)

    def branch(
        self, flag: wp.array, body: Callable[[], None], otherwise: Callable[[], None] | None = None
    ) -> None:
        """Runs body if flag[0] is not zero, else `otherwise`."""
        wp.capture_if(flag, body, otherwise)

    def call(self, function: Callable[[], None]) -> None:
        """Calls a function of the host, on the CPU only."""
        if self.device.is_cuda:
            raise ValueError("a function of the host cannot be part of a program on CUDA")
        function()


class _Modules(Launcher):
    """Launches nothing: collects the modules of all kernels, of every branch."""

    def __init__(self, device: wp.DeviceLike):
        super().__init__(device)
        self.found = {}

    def _send(self, kernel, dim, inputs, outputs, block_dim, tiled=False):
        if _any(dim):
            self.found[kernel.module, block_dim] = None

    def loop(self, flag, body):
        body()

    def branch(self, flag, body, otherwise=None):
        body()
        if otherwise:
            otherwise()

    def call(self, function):
        pass


# future of each module's compilation: to query Warp takes longer than to record a step
_compiling: dict[tuple, concurrent.futures.Future] = {}

# Warp modules that every skin needs on the CPU: those of its geometry and sensor, which are launched before a
# step is prepared, and those of the steps
_MAKING = """
    skin.contact.meshes skin.contact.distances geometry.closest geometry.core_surface sensor.film.kernels
    sensor.film.systems.solve_sheet coupling.implicit.poses
""".split()
_STEPPING = """
    skin.newton.load_path skin.precondition.supernodal sensor.acquisition_kernels skin.contact.faces
    skin.contact.clearance skin.contact.faces.sum_wrench skin.newton.nodes skin.newton.worlds
    skin.newton.convergence skin.newton.krylov skin.newton.line_search skin.liquid launches
""".split()


def compile_for_skin(device: wp.DeviceLike) -> None:
    """Compiles in parallel the modules that every skin needs on the CPU, of those that are imported. When it
    returns, those of geometry and sensor are compiled, and those of the steps in the background, for
    `compile_kernels`. Does nothing for CUDA."""
    device = wp.get_device(device)
    if device.is_cuda:
        return
    package = __name__.partition(".")[0]
    making, stepping = (
        [(module, 1) for name in names if (module := wp.get_module(f"{package}.{name}")).kernels]
        for names in (_MAKING, _STEPPING)
    )
    begun = headers()
    if begun is not None:
        _share_headers(begun.result())
    for module, threads in making[:1]:  # in this thread, whose headers the others use
        wp.load_module(module, device, block_dim=threads)
    finish_compiling(_compile(device, making + stepping)[: len(making)])


def compile_ahead(
    device: wp.DeviceLike, modules: Iterable[tuple[types.ModuleType | wp.Module, int]]
) -> list[concurrent.futures.Future]:
    """Starts to compile modules of kernels for a CUDA device, in the background and in parallel. Warp would
    compile them one after another, when they are launched.

    Args:
      device: Warp device; nothing is done for the CPU.
      modules: Python modules, whose kernels all exist after the import, or Warp modules, each with its block
        size; those that take long come first.

    Returns:
      Futures for `finish_compiling`.
    """
    device = wp.get_device(device)
    return _compile(device, modules) if device.is_cuda else []


def _compile(device, modules):
    wanted = {}
    for module, threads in modules:
        threads = threads if device.is_cuda else 1
        module = wp.get_module(module.__name__) if isinstance(module, types.ModuleType) else module
        # a module may have got more kernels since
        wanted[module, len(module.kernels), device.alias, threads] = module, threads
    use_headers = functools.partial(_share_headers, threading.get_ident())
    pool = concurrent.futures.ThreadPoolExecutor(cores(), initializer=use_headers)
    for key, (module, threads) in wanted.items():
        if key not in _compiling:
            _compiling[key] = pool.submit(wp.load_module, module, device, block_dim=threads)
    pool.shutdown(wait=False)
    return [_compiling[key] for key in wanted]


def _share_headers(thread):
    """Lets this thread use the headers that another one has precompiled, which takes 2 s: Warp has a folder
    of them for each thread."""
    folders = getattr(wp._src.context.runtime, "_pch_dirs", {})
    if thread in folders:
        folders[threading.get_ident()] = folders[thread]


def finish_compiling(futures: Iterable[concurrent.futures.Future] | None = None) -> None:
    """Waits for futures of `compile_ahead`, or for all (None). Compiler errors are raised when the kernel is
    launched."""
    concurrent.futures.wait(list(_compiling.values() if futures is None else futures))


def compile_kernels(device: wp.DeviceLike, record: Callable[[Launcher], None]) -> None:
    """Compiles the kernels that record(launcher) launches, in parallel, and waits for `compile_ahead`."""
    modules = _Modules(device)
    record(modules)
    _compile(modules.device, modules.found)
    finish_compiling()


class Fork:
    """Parallel branches of a CUDA graph; on the CPU, or if not wanted, they run one after another.

    Small kernels mostly wait for memory, and several of them wait at the same time.
    """

    def __init__(self, device: wp.DeviceLike, wanted: bool = True):
        self._device, self._streams = wp.get_device(device), []
        self._parallel = wanted and self._device.is_cuda

    def run(self, *branches: Callable[[], None]) -> None:
        """Calls branches, which contain launches only (no loop, no branch) and do not write arrays that
        another branch uses. Later launches wait for all of them."""
        if not self._parallel:
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
    """The launches of record(program).

    Args:
      device: Warp device.
      record: called with the program, once on the CPU and at every `run` on CUDA; it calls the program's
        methods.

    The contents of arrays may change between runs; the set of arrays and plain numbers may not.
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
        """Frees the launches and their arrays. This breaks the reference cycle with the program, so that
        memory is freed now, instead of at the next garbage collection."""
        self._record, self._commands = None, []

    def _recorded(self, body):
        outer, self._open = self._open, []
        body()
        commands, self._open = in_a_row(self._open), outer
        return commands

    def _send(self, kernel, dim, inputs, outputs, block_dim, tiled=False):
        if self.device.is_cuda:
            super()._send(kernel, dim, inputs, outputs, block_dim, tiled)
        elif _any(dim):
            self._open.append(recorded(kernel, dim, inputs, outputs, tiled=tiled))

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
    """Key of an argument: the value of a number, the identity of anything else."""
    return argument if isinstance(argument, (int, float)) else (None, id(argument))


def _any(dim):
    """Whether dim is not empty."""
    return all(dim) if isinstance(dim, (tuple, list)) else dim


def _value(flag):
    """The first entry of an int array on the CPU, read faster than through numpy."""
    return ctypes.cast(flag.ptr, ctypes.POINTER(ctypes.c_int32))
