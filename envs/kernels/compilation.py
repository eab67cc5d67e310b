"""Compiling many kernels at once, in parallel processes that fill the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dis import get_instructions
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from inspect import unwrap
from pathlib import Path
from pkgutil import walk_packages
from queue import SimpleQueue
from types import CodeType, FunctionType, ModuleType
from typing import IO, Any

from filelock import FileLock

from leapnav.envs.kernels import progress
from leapnav.envs.kernels.decorator import cache_directory, cache_root
from leapnav.envs.kernels.numba_internals import Kernel

MIN_PARALLEL = 6  # kernels; fewer are compiled in this process: starting others takes two seconds
WORKER = "from leapnav.envs.kernels.compilation import serve; serve()"
COMPILED, FAILED = "compiled", "failed"  # answers of a worker process


def prepare(*kernels: Kernel, jobs: int | None = None, advise: bool = True) -> None:
    """Compile kernels and those that they call, or load them from the cache.

    Kernels that are not in the cache are compiled by several processes, if they are many. Processes that need them at
    the same time wait for the first one.

    Args:
        kernels: the kernels.
        jobs: number of processes; None for one per core.
        advise: whether the progress line mentions `leapnav compile`.

    Raises:
        BrokenExecutor: a process that compiled a kernel has ended, for example because memory was short.

    """
    if all(one.is_ready for one in kernels):
        return
    if len(missing(kernels)) >= MIN_PARALLEL and (jobs or usable_cores()) > 1 and sys.executable:
        with FileLock(cache_root() / "compile.lock"):
            remaining = missing(kernels)  # another process may have compiled them meanwhile
            if remaining:
                _compile(remaining, jobs or usable_cores(), advise)
    for one in kernels:
        one.prepare()


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def missing(kernels: Iterable[Kernel]) -> list[Kernel]:
    """The kernels, among these and those that they call, that are not in the cache; callees come first."""
    ordered: dict[Kernel, None] = {}

    def visit(one: Kernel) -> None:
        if one not in ordered and not one.is_ready:
            for callee in one.callees:
                visit(callee)
            ordered[one] = None

    for one in kernels:
        visit(one)
    directories = {one: cache_directory(one.py_func.__module__) for one in ordered}
    return [one for one, directory in directories.items() if directory is None or not one.is_cached(directory)]


def _compile(kernels: list[Kernel], jobs: int, advise: bool) -> None:
    """Compiles kernels in processes; one is started when those that it calls are finished."""
    waiting = dict.fromkeys(one for one in kernels if _is_importable(one))
    unfinished, running = set(waiting), dict[Future[None], Kernel]()
    idle: SimpleQueue[_Worker] = SimpleQueue()

    def compile_one(one: Kernel) -> None:
        worker = idle.get()
        try:
            is_compiled = worker.compile(one)
        finally:
            idle.put(worker)
        if not is_compiled:
            one.prepare()  # raises the error here

    count = min(jobs, len(waiting))
    with (
        progress.counted(waiting, advise) as done,
        ThreadPoolExecutor(jobs) as pool,
        _workers(count) as workers,  # ended before the threads, which would wait for them after an error
    ):
        for worker in workers:
            idle.put(worker)
        while waiting or running:
            for one in [one for one in waiting if not unfinished.intersection(one.callees)]:
                del waiting[one]
                running[pool.submit(compile_one, one)] = one
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                one = running.pop(future)
                unfinished.remove(one)
                future.result()
                done(one)


def _is_importable(one: Kernel) -> bool:
    """Whether another process finds the kernel by its name; not so for the flows that are generated."""
    return one.py_func.__module__.startswith("leapnav.")


class _Worker:
    """A process that compiles the kernels whose names it reads.

    Args:
        label: description of the process in the message of an error.
        errors: file of its standard error, readable.

    """

    def __init__(self, label: str, errors: IO[str]) -> None:
        self._label, self._errors = label, errors
        command = [sys.executable, "-c", WORKER]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
        )

    def compile(self, one: Kernel) -> bool:
        """Compile a kernel, and return whether this was successful.

        Raises:
            BrokenExecutor: the process has ended.

        """
        stdin, stdout, function = self._process.stdin, self._process.stdout, one.py_func
        assert stdin is not None and stdout is not None
        with suppress(OSError):  # of a process that has ended, which the missing answer shows, too
            stdin.write(f"{function.__module__} {function.__qualname__}\n")
            stdin.flush()
        answer = stdout.readline().strip()
        if answer in (COMPILED, FAILED):
            return answer == COMPILED
        name = f"{function.__module__}.{function.__qualname__}"
        raise BrokenExecutor(f"{self._label}, which compiled {name}, ended with {self._reason()}")

    def _reason(self) -> str:
        """The exit code of the process, and the last line that it has written to standard error."""
        code = self._process.wait()
        self._errors.seek(0)
        lines = [line.strip() for line in self._errors if not line.startswith(progress.TITLE)]
        last = next((line for line in reversed(lines) if line), "no message")
        return f"{f'signal {-code}' if code < 0 else f'exit code {code}'}: {last}"

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # closing a pipe writes what a process that has ended did not read
                if stream is not None:
                    stream.close()


@contextmanager
def _workers(count: int) -> Iterator[list[_Worker]]:
    """Processes that compile kernels."""
    workers: list[_Worker] = []
    with ExitStack() as stack:
        for number in range(1, count + 1):
            errors = stack.enter_context(tempfile.TemporaryFile("w+", errors="replace"))
            workers.append(_Worker(f"worker process {number} of {count}", errors))
            stack.callback(workers[-1].end)
        yield workers


def serve() -> None:
    """The loop of a process that compiles: reads names of kernels, and reports when each is in the cache."""
    from leapnav.envs.kernels.numba_internals import named

    for line in sys.stdin:
        module, name = line.split()
        try:
            named(module, name).prepare()
        except Exception:  # the process that asked compiles the kernel itself, and raises the error
            print(FAILED, flush=True)
        else:
            print(COMPILED, flush=True)


def called_kernels(function: Callable[..., Any]) -> list[Kernel]:
    """Return the kernels that a function and the functions of leapnav below it call from Python.

    A function is taken to call every function that it names, and every method of a class that it names. Not found are
    the functions that are called under another name, such as the entries of a dictionary and the methods of an object
    whose class no function below names.
    """
    found: list[Kernel] = []
    visited: set[int] = set()
    waiting: list[Any] = [function]
    while waiting:
        value = waiting.pop()
        if id(value) in visited:
            continue
        visited.add(id(value))
        if isinstance(value, Kernel):
            found.append(value)
            continue
        if isinstance(value, property):
            value = value.fget
        if isinstance(value, cached_property | partial):
            value = value.func
        if callable(value):
            value = unwrap(value)
        if not _is_own(value):
            continue
        if isinstance(value, type):
            members = [member for member in vars(value).values() if not isinstance(member, Kernel)]
            waiting += [*value.__bases__, *members]
        elif isinstance(value, FunctionType):
            waiting += _named_globals(value.__code__, value.__globals__, visited)
    return found


def _is_own(value: object) -> bool:
    """Whether a function, a class or a module belongs to leapnav."""
    name = getattr(value, "__name__" if isinstance(value, ModuleType) else "__module__", None)
    return isinstance(name, str) and name.startswith("leapnav.")


def _named_globals(code: CodeType, scope: dict[str, Any], visited: set[int]) -> Iterator[Any]:
    """The objects of leapnav that a function and those nested in it name; of a module, the members that they name.

    Functions that may name only objects that have been visited are omitted, because reading the code takes long.
    """
    if any(_is_own(value) and id(value) not in visited for value in map(scope.get, code.co_names)):
        module: ModuleType | None = None
        for instruction in get_instructions(code):  # which distinguishes globals from attributes of the same name
            named: Any = None
            if instruction.opname == "LOAD_GLOBAL":
                named = scope.get(instruction.argval)
            elif module is not None and instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
                named = vars(module).get(instruction.argval)
            module = named if isinstance(named, ModuleType) and _is_own(named) else None
            if _is_own(named):
                yield named
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _named_globals(constant, scope, visited)


def all_kernels() -> list[Kernel]:
    """Every kernel of leapnav, in the order of their modules' names."""
    found: dict[Kernel, None] = {}
    for package in ("leapnav.envs", "leapnav.experts"):
        root = import_module(package)
        for module in sorted(info.name for info in walk_packages(root.__path__, f"{package}.")):
            spec = find_spec(module)
            if spec is None or spec.origin is None or b"@kernel(" not in Path(spec.origin).read_bytes():
                continue
            for value in vars(import_module(module)).values():
                if isinstance(value, Kernel):
                    found[value] = None
    return list(found)
