"""The work of :mod:`acquire` as tasks of a Dask cluster: ``LocalCluster``, dask-jobqueue, Kubernetes, any that ``distributed`` knows.

Needs ``pip install "./python[dask]"``. Workers and client must see the same files by the same absolute paths, and have the same version of :mod:`acquire`. The dashboard
shows the stages by name. What fails, or was on a worker that died, the cluster runs again.

    from dask.distributed import Client, LocalCluster
    import acquire.dask

    client = Client(LocalCluster(n_workers=4, threads_per_worker=1))
    acquire.dask.build_matrix("captures", "slab.rd.zarr", client=client)
"""

from __future__ import annotations

import json
import os
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path as FilePath
from typing import Any

from distributed import Client, Future, get_client

from . import _commands
from ._errors import FindingWarning, InputError, tell
from ._material import Path
from ._matrix import Matrix
from ._native import native

__all__ = ["build_matrix", "tradeoff"]

#: Tasks for each thread of the cluster, by default: one that is slow, or done again, keeps others waiting for half of its time.
PARTS_PER_THREAD = 2


def build_matrix(
    capture: Path,
    out: Path,
    *,
    client: Client | None = None,
    parts: int | None = None,
    folder: Path | None = None,
    retries: int = 2,
    force: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Builds the matrix of a capture folder on a cluster: that of :func:`acquire.build_matrix`, bit by bit.

    Three stages, ``prepare``, ``extract`` (one task a part, on one thread each) and ``assemble``, whose files are in ``folder`` until the matrix is there. After an error
    they stay, and the same call goes on from them.

    :param client: of the cluster; default: the current one.
    :param parts: tasks that share the lattice shots; default: two for each thread of the cluster.
    :param folder: where all workers can write; default: beside ``out``, named ``OUT.parts``.
    :param retries: how often a task that failed is run again. One whose worker died is run again up to ``distributed.scheduler.allowed-failures`` times besides.
    :param options: those of :func:`acquire.build_matrix`; ``memory`` bounds what each task takes.
    :returns: figures and ``findings``, as :func:`acquire.build_matrix`.
    :raises InputError: as :func:`acquire.build_matrix`, with the words of the task that failed.
    """
    client = get_client() if client is None else client
    capture, out = os.path.abspath(os.fspath(capture)), os.path.abspath(os.fspath(out))
    if options.get("calibration") is not None:
        options["calibration"] = os.path.abspath(os.fspath(options["calibration"]))
    shots: int = native.plan(capture, out, _commands._words(options), force)
    threads: list[int] = list(client.nthreads().values()) or [1]
    count = min(shots, PARTS_PER_THREAD * sum(threads)) if parts is None else parts
    if not 1 <= count <= shots:
        raise InputError(f"parts: expected 1 to {shots}, the number of lattice shots, found {parts}", "Setting")
    place = FilePath(os.path.abspath(os.fspath(folder)) if folder is not None else out + ".parts")
    place.mkdir(exist_ok=True)

    call = uuid.uuid4().hex
    more: dict[str, Any] = {"retries": retries, "pure": False}
    prepared = client.submit(_prepare, capture, str(place / "common.prepared"), max(threads), options, key=f"prepare-{call}", **more)
    memory = {name: value for name, value in options.items() if name in ("memory", "accept")}
    measured = [
        client.submit(_extract, prepared, str(place / f"{k}-of-{count}.part"), (k, count), memory, key=(f"extract-{call}", k), **more) for k in range(1, count + 1)
    ]
    built = client.submit(_assemble, capture, measured, out, max(threads), force, options, key=f"assemble-{call}", **more)
    with _all_or_none(client, [prepared, *measured, built]):
        result: dict[str, Any] = built.result()
    _remove(place)
    tell(result["findings"])
    return result


@contextmanager
def _all_or_none(client: Client, futures: list[Future]) -> Iterator[None]:
    """Where one fails, or the caller gives up, none goes on."""
    try:
        yield
    except BaseException:
        client.cancel(futures)
        raise


def _prepare(capture: str, out: str, threads: int, options: dict[str, Any]) -> str:
    _commands.prepare(capture, out, threads=threads, progress=False, **options)
    return out


def _extract(prepared: str, out: str, part: tuple[int, int], options: dict[str, Any]) -> str:
    _commands.extract(prepared, out, part=part, threads=1, progress=False, **options)
    return out


def _assemble(capture: str, parts: list[str], out: str, threads: int, force: bool, options: dict[str, Any]) -> dict[str, Any]:
    words = _commands._words(options)
    # Findings are told where the caller is.
    result: dict[str, Any] = json.loads(native.assemble(capture, parts, out, words, False, force, threads, None))
    return result


def _remove(folder: FilePath) -> None:
    """Removes what tasks have written there, and the folder where nothing else is in it."""
    for file in folder.iterdir():
        if file.suffix in (".part", ".prepared", ".unfinished"):
            file.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


#: What :func:`tradeoff` tries when nothing is given.
SETTINGS: tuple[dict[str, Any], ...] = (
    *({"model": "joint", "terms": terms} for terms in (1, 2, 4, 8, 15)),
    *({"model": "tucker", "terms": terms, "degree": degree} for terms in (1, 4, 8, 15) for degree in (3, 7)),
    *({"model": "peers2006", "terms": terms} for terms in (1, 4, 8, 15)),
)


def tradeoff(
    matrix: Path | Matrix,
    *,
    client: Client | None = None,
    settings: Iterable[Mapping[str, Any]] | None = None,
    retries: int = 2,
) -> list[dict[str, Any]]:
    """Factors a matrix with many settings, a task each on one thread, and measures each material against the matrix.

    :param settings: keywords of :func:`acquire.factor` for each task; default: :data:`SETTINGS`, the three models at several numbers of terms.
    :returns: for each of ``settings``, in their order: ``settings``, ``secs`` of factoring on one thread, ``bytes``, and every measure of :func:`acquire.evaluate`.
    """
    client = get_client() if client is None else client
    path = os.path.abspath(matrix.path if isinstance(matrix, Matrix) else os.fspath(matrix))
    call = uuid.uuid4().hex
    tried = [dict(one) for one in (SETTINGS if settings is None else settings)]
    futures = [client.submit(_try, path, one, key=(f"factor-{call}", k), retries=retries, pure=False) for k, one in enumerate(tried)]
    with _all_or_none(client, futures):
        return client.gather(futures)


def _try(path: str, settings: dict[str, Any]) -> dict[str, Any]:
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FindingWarning)
        material = _commands.factor(path, progress=False, **settings)
    secs = time.perf_counter() - start
    measures = _commands.evaluate(material, path, progress=False)
    report = material.report or {}
    return {"settings": settings, "secs": secs, "bytes": report.get("bytes"), **measures}
