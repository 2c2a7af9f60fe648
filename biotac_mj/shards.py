"""Runs a list of independent tasks in this process, in several, or on a Ray cluster, with one progress bar.
The files that they write do not depend on that.

`work` is a picklable object that is called in each process: `work(values, folder, report)` takes an iterator
over the values of tasks, writes files to the folder and yields results. `report` takes a number, by which the
bar moves, or a line of text."""

import contextlib
import dataclasses
import multiprocessing
import os
import pathlib
import queue
import signal
import socket
import tempfile
import threading
import traceback
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import tqdm

from .files import replacing
from .versions import versions

Work = Callable[[Iterable, pathlib.Path, Callable[[int | str], object]], Iterator]

_VISIBLE = "CUDA_VISIBLE_DEVICES"
_TRIES = 5  # of a task whose process or machine failed
_AGAIN = "run the command again, what is there is kept"


@dataclasses.dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
      value: input of the work, which determines the result and all files.
      size: weight in the progress bar.
      last: name of the file that is moved to the folder last, and thus marks the task as done.
    """

    value: Any
    size: int = 1
    last: str = ""


def run_tasks(
    work: Work,
    tasks: Iterable[Task],
    folder: pathlib.Path | str,
    name: str = "tasks",
    unit: str = "task",
    ray: str | None = None,
    processes: Mapping[str, Mapping[str, str]] | None = None,
    cpus: int = 1,
    gpus: int = 0,
    progress: bool = True,
) -> Iterator:
    """Yields the results of all tasks when they are finished.

    Args:
      folder: for the files. name, unit: of the bar.
      ray: address of a Ray cluster ("auto": that of this machine), or "local": one Ray process for each core;
        None: without Ray. Tasks of a machine that fails are repeated on another one.
      processes: {name: additional environment variables}, one process for each; None: this process.
      cpus, gpus: of a Ray node for one task.
      progress: whether to show the bar and lines of text.

    Raises:
      ValueError: an error of the work's input, Ray is not installed, or no cluster is at the address.
      RuntimeError: the work failed, with its message.
    """
    tasks, folder = list(tasks), pathlib.Path(folder)
    total = sum(task.size for task in tasks)
    with tqdm.tqdm(total=total, desc=name, unit=unit, disable=not progress or None, leave=False) as bar:

        def report(news):
            if not isinstance(news, str):
                bar.update(news)
            elif progress:
                bar.write(news)

        if ray is not None:
            yield from _on_ray(work, tasks, folder, report, ray, cpus, gpus)
        elif processes:
            yield from _in_processes(work, tasks, folder, report, processes)
        else:
            yield from work((task.value for task in tasks), folder, report)


def one_per_gpu(devices: Iterable[str]) -> dict[str, dict[str, str]]:
    """`processes` for devices ("cuda:0", "cuda:3"); each process sees one of them, as cuda:0."""
    visible = os.environ.get(_VISIBLE)
    names = visible.split(",") if visible else None
    numbers = {device: int(device.split(":")[1]) for device in devices}
    return {device: {_VISIBLE: names[k] if names else str(k)} for device, k in numbers.items()}


def end_with_parent() -> None:
    """Ends this child process when its parent has ended, also if that was killed; otherwise it would wait for
    tasks for ever. Ctrl-C, which a terminal sends to all processes, is handled by the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end, args=(multiprocessing.parent_process(),), daemon=True).start()


def _end(parent):
    parent.join()
    os._exit(1)


def _in_processes(work, tasks, folder, report, processes):
    """Runs tasks in processes that take them from one queue; results and messages come through another."""
    context = multiprocessing.get_context("spawn")
    todo, news = context.Queue(), context.Queue()
    for task in [*tasks, *[None] * len(processes)]:
        todo.put(task)
    running = {}
    try:
        for name, environment in processes.items():
            with added_to_environment(environment):
                running[name] = context.Process(target=_process, args=(work, folder, name, todo, news))
                running[name].start()
        while running:
            try:
                name, what, value = news.get(timeout=2.0)
            except queue.Empty:
                gone = [f"{n} (exit code {p.exitcode})" for n, p in running.items() if p.exitcode]
                if gone:
                    raise RuntimeError(f"the process of {', '.join(gone)} ended: {_AGAIN}") from None
                continue
            if what == "result":
                yield value
            elif what == "news":
                report(f"{name}: {value}" if isinstance(value, str) else value)
            elif what == "end":
                running.pop(name).join()
            else:
                raise what(f"{name}: {value}")
    finally:
        for process in running.values():
            process.terminate()


@contextlib.contextmanager
def added_to_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Adds variables to the environment, which a process inherits when it starts."""
    kept = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in kept.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _process(work, folder, name, todo, news):
    end_with_parent()
    try:
        values = (task.value for task in iter(todo.get, None))
        for result in work(values, folder, lambda one: news.put((name, "news", one))):
            news.put((name, "result", result))
        news.put((name, "end", None))
    except Exception as error:
        news.put((name, *_describe(error)))


def _describe(error):
    """Kind and text of an error: one line for errors of the input, else with the traceback."""
    for kind in (FileNotFoundError, ValueError):
        if isinstance(error, kind):
            return kind, str(error)
    return RuntimeError, traceback.format_exc()


def _on_ray(work, tasks, folder, report, address, cpus, gpus):
    with _cluster(address) as ray:
        remote = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=_TRIES)(_task)
        kept, key, here = ray.put(work), uuid.uuid4().hex, versions()
        waiting = {remote.remote(key, kept, task.value, here): task for task in tasks}
        while waiting:
            (ref,), _ = ray.wait(list(waiting), num_returns=1)
            task = waiting.pop(ref)
            try:
                error, results, files, lines = ray.get(ref)
            except ray.exceptions.RayError as failed:
                cause = str(failed).strip().splitlines()[-1].strip()
                raise RuntimeError(f"a task on {address} was lost ({cause}): {_AGAIN}") from None
            if error:
                raise error[0](error[1])
            for name in sorted(files, key=lambda name: name == task.last):
                with replacing(folder / name) as temporary:
                    temporary.write_bytes(files[name])
            for line in lines:
                report(line)
            report(task.size)
            yield from results


@contextlib.contextmanager
def _cluster(address):
    """Connects to Ray, unless the caller has connected already."""
    try:
        import ray
    except ImportError:
        raise ValueError("--ray needs Ray: pip install 'biotac-mj[ray]', or leave it out") from None
    if ray.is_initialized():
        yield ray
        return
    try:
        host, _, port = address.rpartition(":")
        if host and "//" not in address:  # Ray itself tries for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        quiet = {"include_dashboard": False} if address == "local" else {}
        ray.init(address, log_to_driver=False, logging_level="error", **quiet)
    except (OSError, RuntimeError, ValueError) as error:
        cause = str(error).splitlines()[0]
        raise ValueError(
            f"no Ray cluster at {address} ({cause}): start one with `ray start --head`, or give --ray local"
        ) from None
    try:
        yield ray
    finally:
        ray.shutdown()


_works = {}  # key of a run -> its work, which caches objects in this process


def _task(key, work, value, wanted):
    """Runs a task in a Ray process; returns error (kind, text) or None, results, {name: bytes} of files,
    lines."""
    lines = []
    try:
        if versions() != wanted:
            raise ValueError(
                f"a Ray node has {versions()}, this machine {wanted}: install the same versions on all"
            )
        if key not in _works:
            _works.clear()
            _works[key] = work
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            found = _works[key](iter([value]), folder, lambda one: isinstance(one, str) and lines.append(one))
            results = list(found)
            files = {
                path.relative_to(folder).as_posix(): path.read_bytes()
                for path in sorted(folder.rglob("*"))
                if path.is_file()
            }
        return None, results, files, lines
    except Exception as error:
        return _describe(error), [], {}, lines
