"""The work of :mod:`acquire` as tasks of a Dask cluster: ``LocalCluster``, dask-jobqueue, Kubernetes, any that ``distributed`` knows.

Needs ``pip install "./python[dask]"``. Workers and client must see the same files by the same absolute paths, and have the same version of :mod:`acquire`. The dashboard
shows the stages by name. What fails, or was on a worker that died, the cluster runs again.

    from dask.distributed import Client, LocalCluster
    import acquire.dask

    client = Client(LocalCluster(n_workers=4, threads_per_worker=1))
    acquire.dask.build_matrix("captures", "slab.rd.zarr", client=client)
    material = acquire.dask.factor("slab.rd.zarr", "slab.safetensors", client=client, terms=15)
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
from ._material import Material, Path
from ._matrix import Matrix
from ._native import native

__all__ = ["build_matrix", "factor", "tradeoff"]

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


def factor(
    matrix: Path | Matrix,
    out: Path,
    *,
    client: Client | None = None,
    blocks: int | None = None,
    folder: Path | None = None,
    retries: int = 2,
    force: bool = False,
    **options: Any,
) -> Material:
    """Factors one matrix on a cluster, and saves the material at ``out``.

    A factorization goes over all rows ten to thirty times. Each pass (``survey``, ``terms``, ``measure``, ``colour``) is as many tasks as there are ``blocks`` of rows,
    on one thread each; what they find is joined where the caller is, in the order of the blocks: the material is the same, bit by bit, whichever workers did them.
    It is that of :func:`acquire.factor` with the same ``backend`` to rounding with ``gram``, and within its accuracy with ``randomized``. A worker holds the pass, 48 MiB of rows, and what it finds of its block
    (``docs/scale.md`` has figures). After an error files stay in ``folder``, and the same call goes on from them.

    :param matrix: a store's path, or an open one.
    :param client: of the cluster; default: the current one.
    :param blocks: tasks that share a pass, up to the chunks of the matrix; default: 32, or as many as have 512 MiB of responses each.
    :param folder: where all workers can write; default: beside ``out``, named ``OUT.passes``.
    :param retries: how often a task that failed is run again. One whose worker died is run again up to ``distributed.scheduler.allowed-failures`` times besides.
    :param force: replace an earlier material.
    :param options: those of :func:`acquire.factor`, but for ``backend="full"`` and ``memory``, which need all rows in one place. The default ``backend`` is
        ``randomized``, below an ``accuracy`` of 1e-6 ``gram``.
    :returns: the material with its ``report``, as :func:`acquire.factor`.
    :raises InputError: as :func:`acquire.factor`, with the words of the task that failed.
    """
    client = get_client() if client is None else client
    path = os.path.abspath(matrix.path if isinstance(matrix, Matrix) else os.fspath(matrix))
    out = os.path.abspath(os.fspath(out))
    place = FilePath(os.path.abspath(os.fspath(folder)) if folder is not None else out + ".passes")
    if out.endswith(".acq"):
        options.setdefault("precision", "coded")
    words = _commands._factor_words(options)
    place.mkdir(exist_ok=True)

    call, last, tries = uuid.uuid4().hex, 0, 0
    while True:
        made, told = native.factor_by_tasks(path, out, words, str(place), blocks, force, None)
        result: dict[str, Any] = json.loads(told)
        if made is not None:
            break
        number, stage, of = result["pass"], result["stage"], result["of"]
        tries = tries + 1 if number == last else 0
        if tries > retries:
            raise InputError(f"{place}: pass {number} ({stage}): parts {result['missing']} of {of} were written and are not there", "PassDue")
        last = number
        # The number of the pass is in the key: what was late for an earlier one is not taken for this.
        futures = [
            client.submit(_factor_part, str(place), (k, of), key=(f"{stage}-{call}-{number}-{tries}", k), retries=retries, pure=False) for k in result["missing"]
        ]
        with _all_or_none(client, futures):
            client.gather(futures)
    material = Material(made, result)
    material.save(out, force=force)
    _remove(place)
    tell(result["findings"])
    return material


def _factor_part(folder: str, part: tuple[int, int]) -> None:
    native.factor_part(folder, part, 1, None)


def _remove(folder: FilePath) -> None:
    """Removes what tasks have written there, and the folder where nothing else is in it."""
    for file in folder.iterdir():
        if file.suffix in (".part", ".prepared", ".pass", ".sum", ".unfinished"):
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
