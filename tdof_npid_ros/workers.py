"""Independent chunks of one work: on threads of this machine, or on the workers of a Dask cluster.

A chunk is a pure function of picklable values, and results are put in the order of the chunks. So a work ends with the
same bits on one thread and on any number of workers, whichever of them are slow, killed or added while it runs, and
resumed as if never interrupted.
"""

from __future__ import annotations

import base64
import hashlib
import os
import pickle
import queue
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar, cast

import numpy as np

from tdof_npid_ros.checkpoint import CheckpointError, first_difference, read_checkpoint, write_checkpoint
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.output_file import hold

Shared = TypeVar("Shared")
Chunk = TypeVar("Chunk")
Result = TypeVar("Result")

CONNECT_TIMEOUT = 10.0  # s, for the scheduler's answer
LOOK_PERIOD = 5.0  # s without a result, after which it is looked whether there are workers at all
SAVING = 0.05  # fraction of the time that may go into saving checkpoints
LEAST_BETWEEN_SAVES = 1.0  # s
_PACKAGE = Path(__file__).parent


class WorkersError(RuntimeError):
    """Chunks that cannot be run where they were to. The message is one line: what, where, what to do."""


@dataclass(frozen=True)
class ChunkCheckpoint:
    """Where the results of chunks are kept until all are done.

    Attributes:
        path: the file.
        work: all that the results depend on, as JSON holds it.
        resume: go on from the file if it is there; otherwise it must not be.
        replace: a file that is of other work, or damaged, is replaced.
    """

    path: Path
    work: dict[str, Any]
    resume: bool = False
    replace: bool = False

    @property
    def how_to_go_on(self) -> str:
        """After an error."""
        again = "run the same again" if self.replace else "run the same again with --resume"
        return f", then {again}: {self.path} keeps what was done"


class Workers(ABC):
    """Runs chunks; made by `workers`, and used as a context.

    Attributes:
        cores: how many chunks run at once, to cut a work by. No result depends on it.
    """

    cores: int

    def map(
        self,
        function: Callable[[Shared, Chunk], Result],
        shared: Shared,
        chunks: Sequence[Chunk],
        *,
        unit: str | None = None,
        sizes: Sequence[int] | None = None,
        checkpoint: ChunkCheckpoint | None = None,
    ) -> list[Result]:
        """`function(shared, chunk)` of each chunk, in the order of the chunks.

        Chunks of a second or so are best: what is done is saved, and shown, by chunks; each costs a cluster 1 ms.

        Args:
            function: of a module, pure; it may be called by several threads at once, and again for the same chunk.
            shared: what all chunks need; sent to each worker's process once.
            chunks: small values each.
            unit: of the progress bar, which only a terminal sees: `plant`, `run`, …; None: no bar.
            sizes: how many of the unit each chunk is; by default one.
            checkpoint: then a result is of None, numbers, strings, NumPy arrays, and lists and dictionaries of them.

        Raises:
            CheckpointError: the checkpoint is of other work, damaged, or there but not to be resumed; or it cannot
                be written.
            WorkersError: the scheduler or every worker was lost, or a worker has another version of this program.
            Exception: what a chunk raised.
        """
        from tqdm import tqdm

        sizes = [1] * len(chunks) if sizes is None else list(sizes)
        store = _Store(checkpoint, len(chunks)) if checkpoint else None
        results: dict[int, Any] = dict(store.results) if store else {}
        waiting = [index for index in range(len(chunks)) if index not in results]
        with tqdm(
            total=sum(sizes),
            initial=sum(sizes[index] for index in results),
            unit=f" {unit}",
            leave=False,
            disable=None if unit else True,
        ) as bar:
            try:
                with closing(self._results(function, shared, {index: chunks[index] for index in waiting})) as done:
                    for index, result in done:
                        results[index] = store.keep(index, result) if store else result
                        bar.update(sizes[index])
            except WorkersError as error:
                raise WorkersError(f"{error}{checkpoint.how_to_go_on if checkpoint else ''}") from None
            finally:
                if store:
                    store.save()
        return [results[index] for index in range(len(chunks))]

    def threads_in(self, chunks: int) -> int:
        """How many threads each of so many chunks may use, that all cores have work and not much more than that."""
        return 1

    @abstractmethod
    def _results(
        self, function: Callable[[Shared, Chunk], Result], shared: Shared, chunks: dict[int, Chunk]
    ) -> Generator[tuple[int, Result]]:
        """Each chunk's number and result, as they come."""

    def __enter__(self) -> Workers:
        return self

    @abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go of threads and connections; what still runs is not waited for longer than its chunk."""


def workers(scheduler: str | None = None, threads: int | None = None) -> Workers:
    """Where chunks run.

    Args:
        scheduler: of a Dask cluster: its address (`tcp://host:8786`), or its scheduler file (`….json`). None: threads
            of this process.
        threads: how many then; by default one per core that this process may run on.

    Raises:
        WorkersError: there is no such scheduler, or Dask is not installed.

    Example:
        >>> from tdof_npid_ros.workers import workers
        >>> with workers() as here:
        ...     here.map(pow, 2, [1, 2, 3])
        [2, 4, 8]
    """
    return _Threads(threads or available_cores()) if scheduler is None else _Cluster(scheduler)


def available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0))


@cache
def program_digest() -> str:
    """Of all sources of this program: the same wherever the same program is installed."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


class _Threads(Workers):
    """Threads of this process: what is compiled runs in parallel."""

    def __init__(self, threads: int) -> None:
        self.cores = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="chunk")

    def threads_in(self, chunks: int) -> int:
        return max(1, self.cores // max(1, chunks))

    def _results(
        self, function: Callable[[Shared, Chunk], Result], shared: Shared, chunks: dict[int, Chunk]
    ) -> Generator[tuple[int, Result]]:
        running = {self._pool.submit(function, shared, chunk): index for index, chunk in chunks.items()}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        finally:
            for future in running:
                future.cancel()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=True)


class _Cluster(Workers):
    """The workers of a Dask scheduler. What a dead worker had is done again by another one: that is Dask's."""

    def __init__(self, scheduler: str) -> None:
        try:
            import distributed
        except ImportError:
            raise WorkersError("--scheduler needs Dask: pip install 'tdof_npid_ros[cluster]'") from None
        _silence_dask()
        self._told = scheduler
        where = {"scheduler_file": scheduler} if scheduler.endswith(".json") else {"address": scheduler}
        if "scheduler_file" in where and not Path(scheduler).exists():  # Dask would wait for it for ever
            raise WorkersError(f"no Dask scheduler answers at {scheduler}: there is no such file")
        try:
            self._client: Any = distributed.Client(timeout=CONNECT_TIMEOUT, set_as_default=False, **where)
        except (OSError, ValueError, TypeError) as error:  # what Dask makes of an address that is none
            raise WorkersError(f"no Dask scheduler answers at {scheduler}: {one_line(error)}") from None
        self._no_worker_told = False

    @property
    def cores(self) -> int:  # type: ignore[override]  # it changes as workers come and go
        """Threads of all workers now; at least 1."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def _results(
        self, function: Callable[[Shared, Chunk], Result], shared: Shared, chunks: dict[int, Chunk]
    ) -> Generator[tuple[int, Result]]:
        from distributed import CancelledError, KilledWorker

        job = _by_value(function, shared)
        done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[str, int] = {}
        futures = []
        try:
            for index, chunk in chunks.items():
                future = self._client.submit(_run_on_worker, job, chunk, program_digest(), pure=False)
                running[future.key] = index
                futures.append(future)
                future.add_done_callback(done.put)
            while running:
                try:
                    future = done.get(timeout=LOOK_PERIOD)
                except queue.Empty:
                    self._look_for_workers()
                    continue
                yield running.pop(future.key), future.result()
        except (CancelledError, OSError) as error:
            if isinstance(error, OSError) and self._client.status == "running":
                raise  # the chunk's own
            raise WorkersError(f"the Dask scheduler at {self._told} was lost: start it again") from None
        except KilledWorker:
            raise WorkersError(
                f"the same chunk ended its worker again and again (at {self._told}): have the workers memory enough?"
            ) from None
        finally:
            if self._client.status == "running":
                self._client.cancel([future for future in futures if future.key in running])

    def _look_for_workers(self) -> None:
        """Tell once if there are none; they may still come."""
        if not self._no_worker_told and self._client.status == "running" and not self._client.nthreads():
            self._no_worker_told = True
            warnings.warn(f"the Dask scheduler at {self._told} has no worker: waiting for one", stacklevel=2)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close(timeout=2)


def _silence_dask() -> None:
    """A lost connection is told by our own error, in one line."""
    import logging

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _by_value(function: Any, shared: Any) -> bytes:
    import cloudpickle

    return cast(bytes, cloudpickle.dumps((function, shared)))


@lru_cache(maxsize=8)
def _job(pickled: bytes) -> tuple[Callable[[Any, Any], Any], Any]:
    """Once in each process, so that what chunks share is built, sampled and compiled once."""
    return cast(tuple[Callable[[Any, Any], Any], Any], pickle.loads(pickled))


def _run_on_worker(job: bytes, chunk: Any, program: str) -> Any:
    """A chunk, on a worker.

    Raises:
        WorkersError: this is another version of the program than the one that sent it, and might compute otherwise.
    """
    if program != program_digest():
        raise WorkersError(
            f"the worker on {os.uname().nodename} has another version of tdof_npid_ros in {_PACKAGE}: install the same "
            "one everywhere, and start the worker anew"
        )
    function, shared = _job(job)
    return function(shared, chunk)


class _Store:
    """The results of chunks in a checkpoint."""

    def __init__(self, checkpoint: ChunkCheckpoint, chunks: int) -> None:
        self._path = path = checkpoint.path
        self._work = {**checkpoint.work, "chunks": chunks, "program": program_digest()}
        self._plain: dict[str, Any] = {}
        self.results: dict[int, Any] = {}
        self._unsaved, self._next_save = True, 0.0
        hold(path)
        if path.exists():
            if not checkpoint.resume:
                raise CheckpointError(f"checkpoint {path} exists: resume it, or give another file")
            try:
                self._restore()
            except CheckpointError:
                if not checkpoint.replace:
                    raise
        self._save_if_due()

    def keep(self, index: int, result: Any) -> Any:
        """Take a chunk's result; returns it as it is when it has been read again."""
        self._plain[str(index)] = _to_json(result)
        self._unsaved = True
        self._save_if_due()
        return _from_json(self._plain[str(index)])

    def save(self) -> None:
        """Write what has not been written."""
        if self._unsaved:
            write_checkpoint(self._path, "sweep", {"work": self._work, "results": self._plain})
            self._unsaved = False

    def _save_if_due(self) -> None:
        started = time.monotonic()
        if started >= self._next_save:
            self.save()
            ended = time.monotonic()
            self._next_save = ended + max(LEAST_BETWEEN_SAVES, (ended - started) / SAVING)

    def _restore(self) -> None:
        content = read_checkpoint(self._path, "sweep")
        difference = first_difference(content.get("work"), self._work)
        if difference:
            raise CheckpointError(f"checkpoint {self._path} is of other work: {difference}")
        try:
            plain = dict(content["results"])
            self.results = {int(index): _from_json(one) for index, one in plain.items()}
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(
                f"checkpoint {self._path} is damaged, start anew with another file: {one_line(error)}"
            ) from None
        self._plain, self._unsaved = plain, False


def _to_json(value: Any) -> Any:
    """As JSON holds it, bit for bit; an array by its bytes."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise TypeError(f"an array of {value.dtype} cannot be kept in a checkpoint")
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {"dtype": value.dtype.str, "shape": list(value.shape), "bytes": data}
    if isinstance(value, dict):
        return {"items": [[key, _to_json(one)] for key, one in value.items()]}
    if isinstance(value, (list, tuple)):
        return [_to_json(one) for one in value]
    if isinstance(value, float):
        return {"float": value.hex()}
    return value


def _from_json(value: Any) -> Any:
    if isinstance(value, list):
        return [_from_json(one) for one in value]
    if not isinstance(value, dict):
        return value
    if "items" in value:
        return {key: _from_json(one) for key, one in value["items"]}
    if "float" in value:
        return float.fromhex(value["float"])
    return np.frombuffer(base64.b64decode(value["bytes"]), value["dtype"]).reshape(value["shape"]).copy()
