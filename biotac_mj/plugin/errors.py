"""Brings errors inside MuJoCo's step back to Python.

A callback cannot raise: C lies between it and whoever called mj_step. Its error is kept and warned of, and
`check` raises it; or it is raised as soon as MuJoCo has returned, where the model says on_error="raise", and
always if it is a KeyboardInterrupt or the like: in the thread that stepped, or in the main one where that is
no thread of Python's (`mujoco.rollout`)."""

import contextlib
import ctypes
import functools
import signal
import sys
import threading
import traceback
import warnings
from _signal import getsignal  # that of `signal` takes 20 us to name the handler, in every step
from collections.abc import Callable, Iterator

import mujoco

_lock = threading.Lock()
_first = None  # the first error since the last `check`
_doors = set()  # code of the outermost Python functions of callbacks: C discards exceptions raised there


def guarded(
    failed: int | None = None,
    raises: Callable[..., bool] = lambda *_: False,
    abandon: Callable[..., None] = lambda *_: None,
) -> Callable:
    """Makes a function a callback of C that never raises.

    Args:
      failed: returned to C after an error.
      raises: called with the callback's arguments; whether an error is raised after MuJoCo has returned.
      abandon: called with them after an error.
    """

    def decorate(function):
        # what is left when MuJoCo frees the last mjData: this module's names are gone by then
        finalizing = sys.is_finalizing

        @functools.wraps(function)
        def callback(*args):
            if finalizing():
                return failed
            out = failed
            try:
                out = function(*args)
            except BaseException as error:  # noqa: BLE001 - C cannot take it
                _meet(error, raises, abandon, args)
            _late.queue()
            return out

        _doors.add(callback.__code__)
        return callback

    return decorate


def _meet(error, raises, abandon, args):
    try:
        abandon(*args)
        keep = isinstance(error, Exception) and not raises(*args)
    except Exception:  # the error itself comes first
        keep = True
    if keep:
        _keep(error)
        return
    frame = sys._getframe()
    while frame.f_code not in _doors:
        frame = frame.f_back
    if frame.f_back is None or threading.get_ident() == threading.main_thread().ident:
        _late.throw(error)
    else:
        _throw(frame.f_back, error)


def _keep(error):
    global _first
    traceback.clear_frames(error.__traceback__)  # they hold the model
    with _lock:
        _first = _first or error
    try:
        warnings.warn(
            f"BioTac: {str(error) or type(error).__name__} (biotac_mj.plugin.check() raises it)",
            RuntimeWarning,
            stacklevel=4,
        )
    except RuntimeWarning:  # the user turned warnings into errors: it is kept above
        pass


def check() -> None:
    """Raises the first error that a BioTac with on_error="warn" met inside MuJoCo since the last call."""
    global _first
    with _lock:
        error, _first = _first, None
    if error is not None:
        raise error


@contextlib.contextmanager
def explained() -> Iterator[None]:
    """Replaces MuJoCo's error that a BioTac cannot be made by the BioTac's own."""
    before = _first
    try:
        yield
    except (ValueError, mujoco.FatalError):
        if _first is not before:
            check()
        raise


def clear_errors() -> None:
    """Forgets the kept error."""
    global _first
    _first = None


# --- raising once MuJoCo has returned  ---


class _Late:
    """An error for the main thread, which Python raises between two instructions that are not a callback's:
    it asks, in that thread, whether this object is true."""

    def __init__(self):
        self._error, self._queued = None, False

    def throw(self, error):
        if self._error is None or not isinstance(error, Exception):
            self._error = error
        self.queue()

    def waits_for(self, kind):
        return isinstance(self._error, kind)

    def queue(self):
        if self._error is not None and not self._queued:
            self._queued = True
            _add_pending_call(_is_true, id(self))

    def __bool__(self):
        self._queued = False
        frame = sys._getframe(1)
        if frame.f_code in _doors:  # about to leave
            self.queue()
        elif not _in_callback(frame):  # else the callback queues it when it ends
            error, self._error = self._error, None
            if error is not None:
                raise error
        return False  # to Python's pending calls: no error


_late = _Late()
_doors.add(_Late.queue.__code__)
_add_pending_call = ctypes.pythonapi.Py_AddPendingCall
_add_pending_call.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
_is_true = ctypes.cast(ctypes.pythonapi.PyObject_IsTrue, ctypes.c_void_p)


def _throw(frame, error):
    """Raises an error in a frame of this thread, at the first instruction that follows."""

    def trace(*_):
        raise error

    frame.f_trace, frame.f_trace_opcodes = trace, True
    sys.settrace(lambda *_: None)


def _in_callback(frame):
    while frame is not None and frame.f_code not in _doors:
        frame = frame.f_back
    return frame is not None


def interrupt(number: int, frame: object) -> None:
    """Python's own handler of Ctrl-C, but that a callback is not left half done, where the KeyboardInterrupt
    could also be lost, in a destructor for example. A second one does not wait."""
    if _in_callback(frame) and not _late.waits_for(KeyboardInterrupt):
        _late.throw(KeyboardInterrupt())
    else:
        signal.default_int_handler(number, frame)


def watch_interrupts() -> None:
    """Makes Ctrl-C end the loop that steps, unless the user has a handler of his own."""
    if (
        getsignal(signal.SIGINT) is signal.default_int_handler
        and threading.get_ident() == threading.main_thread().ident
    ):
        signal.signal(signal.SIGINT, interrupt)
