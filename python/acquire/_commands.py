"""What the program does as commands."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from ._errors import InputError, tell
from ._material import Material, Path
from ._matrix import Matrix
from ._native import native
from ._progress import Progress, report


def _words(options: dict[str, Any]) -> list[str]:
    """Options as they are typed: ``lit_pitch_mm=(1, 1.5)`` is ``--lit-pitch-mm 1x1.5``, ``noise_free=True`` is ``--noise-free``."""
    words: list[str] = []
    for name, value in options.items():
        flag = "--" + name.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            words.append(flag)
        elif isinstance(value, (tuple, list, np.ndarray)):
            # Names are lists, numbers are pairs; an empty list is the option alone.
            separator = "," if all(isinstance(v, str) for v in value) else "x"
            words.append(f"{flag}={separator.join(map(_number, value))}" if len(value) else flag)
        else:
            words.append(f"{flag}={_number(value)}")
    return words


def _number(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    return os.fspath(value) if isinstance(value, os.PathLike) else str(value)


def _pair(name: str, value: float | tuple[float, float] | None, kind: type) -> Any:
    """One number for both axes, or two for x and y."""
    if value is None:
        return None
    both = np.broadcast_to(np.asarray(value), (2,)) if np.ndim(value) == 0 else np.asarray(value)
    if both.shape != (2,):
        raise InputError(f"{name}: expected a number, or two for x and y, found {value}", "Setting")
    return [kind(v) for v in both]


def write_matrix(
    path: Path,
    response: npt.ArrayLike,
    *,
    pitch_mm: float,
    variance: npt.ArrayLike | None = None,
    valid: npt.ArrayLike | None = None,
    x_i_mm: npt.ArrayLike | None = None,
    y_i_mm: npt.ArrayLike | None = None,
    position_sd_mm: npt.ArrayLike | None = None,
    lit_pitch_mm: float | tuple[float, float] | None = None,
    points: tuple[int, int] | None = None,
    window: int | tuple[int, int] | None = None,
    full: bool = False,
    force: bool = False,
    progress: Progress = True,
) -> dict[str, Any]:
    """Writes a matrix store from arrays.

    :param response: R_d, mm⁻². Windows around lit points, shape (y_i, x_i, dy, dx), with odd numbers of samples; or a full matrix from lit point i to point o of the
        same lattice, (i, o), or (y_i, x_i, y_o, x_o) with ``full=True``; each with or without a last axis of 1 or 3 channels (one: grey). NaN: not measured.
    :param pitch_mm: side of a sample, mm.
    :param variance: of ``response``, mm⁻⁴, the same shape; default 0, not known.
    :param valid: whether each was measured, the same shape; default: where ``response`` is a number.
    :param x_i_mm, y_i_mm: where lit points are, mm, shape (y_i, x_i); default: a lattice of ``lit_pitch_mm`` from 0.
    :param position_sd_mm: standard deviation of those places per axis, mm; default 0.
    :param lit_pitch_mm: distance of lit points, mm, one number or (x, y); default: that of the places, else ``pitch_mm``.
    :param points: lit points along x and y of a full matrix (i, o); default: as many along both.
    :param window: samples along x and y that are cut out of a full matrix; default: the smallest with as many to all sides that leave out a thousandth of the light at most.
    :param force: replace an earlier matrix of this program.
    :returns: what was written: ``points``, ``window``, ``channels``, ``measured_share``, ``light_outside_window``, ``defaults``, ``findings``.
    :raises InputError: naming array and place, for shapes that do not fit, infinite numbers, negative variances.
    :warns FindingWarning: for negative responses, light outside the windows, more light than arrives.
    """

    def array(values: npt.ArrayLike | None, kind: type) -> Any:
        return None if values is None else np.ascontiguousarray(values, dtype=kind)

    flags = None if valid is None else np.ascontiguousarray(np.asarray(valid) != 0, dtype=np.uint8)
    told = native.write_matrix(
        os.fspath(path),
        array(response, np.float32),
        array(variance, np.float32),
        flags,
        array(x_i_mm, np.float64),
        array(y_i_mm, np.float64),
        array(position_sd_mm, np.float64),
        float(pitch_mm),
        _pair("lit_pitch_mm", lit_pitch_mm, float),
        _pair("points", points, int),
        _pair("window", window, int),
        full,
        force,
        report(progress),
    )
    result: dict[str, Any] = json.loads(told)
    tell(result["findings"])
    return result


def import_matrix(
    source: Path,
    out: Path,
    *,
    pitch_mm: float | None = None,
    lit_pitch_mm: float | tuple[float, float] | None = None,
    points: tuple[int, int] | None = None,
    window: int | tuple[int, int] | None = None,
    full: bool = False,
    force: bool = False,
    progress: Progress = True,
) -> dict[str, Any]:
    """Writes a matrix store from a file of arrays, as ``acquire import-matrix`` does.

    :param source: ``.npy`` (the response), ``.npz`` or a Zarr group with arrays by the names of :func:`write_matrix`'s parameters.
    :param pitch_mm: side of a sample, mm; default: that of the file.

    The other parameters, what is returned and raised are those of :func:`write_matrix`.
    """
    told = native.import_matrix(
        os.fspath(source),
        os.fspath(out),
        pitch_mm,
        _pair("lit_pitch_mm", lit_pitch_mm, float),
        _pair("points", points, int),
        _pair("window", window, int),
        full,
        force,
        report(progress),
    )
    result: dict[str, Any] = json.loads(told)
    tell(result["findings"])
    return result


def factor(
    matrix: Path | Matrix,
    *,
    terms: int | None = None,
    degree: int | None = None,
    model: str | None = None,
    target_psnr: float | None = None,
    max_bytes: int | str | None = None,
    precision: str | None = None,
    maps: bool | None = None,
    backend: str | None = None,
    accuracy: float | None = None,
    memory: int | str | None = None,
    progress: Progress = True,
    **more: Any,
) -> Material:
    """Factors a matrix into a material.

    :param matrix: a store's path, or an open one.
    :param terms: T; default: as many as exceed the measured noise.
    :param degree: P of the colour polynomial, 0 to 15.
    :param model: ``joint`` (default), ``tucker`` or ``peers2006``.
    :param target_psnr: the fewest bytes that reach it, dB.
    :param max_bytes: the best in so many, a number or ``"250kB"``.
    :param precision: ``f32``, ``f16`` or ``coded``; what is returned is what would be stored.
    :param maps: entry and exit maps; default: where they differ from one by more than noise.
    :param more: any other option of ``acquire factor``, with underscores: ``profile_power``, ``max_shift``, ``no_peak_shift``, ``color_regression``, ``added_error``.
    :returns: the material, with ``report``: ``choice``, ``rel_rmse``, ``psnr_db``, ``bytes``, ``agreement``, ``findings``.
    :warns FindingWarning: for what the factorization found.
    """
    options = dict(terms=terms, degree=degree, model=model, target_psnr=target_psnr, max_bytes=max_bytes, precision=precision, backend=backend, accuracy=accuracy, memory=memory)
    words = _factor_words({**options, "maps": maps, **more})
    path = matrix.path if isinstance(matrix, Matrix) else os.fspath(matrix)
    made, told = native.factor(path, words, report(progress))
    result: dict[str, Any] = json.loads(told)
    tell(result["findings"])
    return Material(made, result)


def _factor_words(options: dict[str, Any]) -> list[str]:
    """Options of :func:`factor` as they are typed."""
    maps = options.pop("maps", None)
    return _words(options) + ([] if maps is None else [f"--maps={'yes' if maps else 'no'}"])


def evaluate(candidate: Path | Material | Matrix, reference: Path | Matrix, *, progress: Progress = True) -> dict[str, Any]:
    """Compares a material or a matrix with a reference matrix.

    :returns: every measure of ``docs/metrics.md`` by its name: ``rel_rmse``, ``psnr_db``, ``log_rmse``, ``relit_psnr_db``, ``bytes_f32``, …; ``None`` where it is not defined.
    :raises InputError: when points, window or pitch differ.
    """
    against = reference.path if isinstance(reference, Matrix) else os.fspath(reference)
    if isinstance(candidate, Material):
        return json.loads(native.evaluate(None, candidate._native, against, report(progress)))
    path = candidate.path if isinstance(candidate, Matrix) else os.fspath(candidate)
    return json.loads(native.evaluate(path, None, against, report(progress)))


def simulate(dir: Path, *, progress: Progress = True, **options: Any) -> dict[str, Any]:
    """Writes a simulated capture: photographs, rig, and the truth (``truth.rd.zarr``).

    :param options: those of ``acquire simulate``, with underscores; pairs are tuples: ``material="chessboard-4x4"``, ``grid=(16, 12)``, ``window=(15, 15)``, ``pitch_mm``, ``lit_pitch_mm``,
        ``seed``, ``truth_only=True``, ``noise_free=True``, ``only=["drift"]``, ``force=True``, … ``acquire help simulate`` lists them.
    :returns: ``shots``, ``photographs``, ``size_px``, ``photograph_bytes``, ``findings``.
    """
    result: dict[str, Any] = json.loads(native.simulate(os.fspath(dir), _words(options), report(progress)))
    tell(result["findings"])
    return result


def build_matrix(capture: Path, out: Path, *, force: bool = False, progress: Progress = True, **options: Any) -> dict[str, Any]:
    """Builds the matrix of a capture folder.

    A chessboard is found only where :data:`acquire.has_opencv` is true; captures with frame marks need none.

    :param force: replace an earlier matrix of this program.
    :param options: those of ``acquire build-matrix``, with underscores: ``calibration``, ``exposure_from``, ``accept=["lamp-level"]``, …
    :returns: figures and ``findings``, as ``acquire build-matrix --json``.
    """
    result: dict[str, Any] = json.loads(native.build_matrix(os.fspath(capture), os.fspath(out), _words(options), force, report(progress)))
    tell(result["findings"])
    return result


def prepare(capture: Path, out: Path, *, threads: int | None = None, progress: Progress = True, **options: Any) -> int:
    """Writes what all lattice shots of a capture have in common to the file ``out`` (``*.prepared``), which :func:`extract` takes in the place of the capture.

    :param threads: threads to work on; default: all.
    :param options: those of ``acquire prepare``, as of :func:`build_matrix`.
    :returns: bytes of the file.
    """
    return native.prepare(os.fspath(capture), os.fspath(out), _words(options), threads, report(progress))


def extract(
    source: Path,
    out: Path,
    *,
    part: tuple[int, int] | None = None,
    shots: tuple[int, int] | None = None,
    threads: int | None = None,
    progress: Progress = True,
    **options: Any,
) -> dict[str, Any]:
    """Measures some lattice shots and writes them to the part ``out`` (``*.part``), as ``acquire extract`` does: one task of many.

    :param source: the capture folder, or what :func:`prepare` has made of it.
    :param part: ``(3, 64)``: the third of 64 parts of nearly equal size; or
    :param shots: ``(120, 180)``: shots by their numbers in the sweep, from 0, the end not among them.
    :param threads: threads to work on; default: all.
    :returns: ``shots``, ``of``, ``photographs``, ``rows``, ``was_there``, ``once_secs``, ``shots_secs``.
    """
    return json.loads(native.extract(os.fspath(source), os.fspath(out), _words(options), part, shots, threads, report(progress)))


def assemble(
    capture: Path,
    parts: Path | list[Path],
    out: Path,
    *,
    measure_missing: bool = False,
    force: bool = False,
    threads: int | None = None,
    progress: Progress = True,
    **options: Any,
) -> dict[str, Any]:
    """Puts parts together to the matrix that :func:`build_matrix` makes, bit by bit.

    :param parts: parts, or folders of them.
    :param measure_missing: measure the shots that no part has; default: :class:`InputError`, ``kind`` ``MissingShots``, that names them.
    :returns: what :func:`build_matrix` returns, and ``unused_parts``: parts that were of no use, and why.
    """
    paths = [os.fspath(p) for p in (parts if isinstance(parts, list) else [parts])]
    told = native.assemble(os.fspath(capture), paths, os.fspath(out), _words(options), measure_missing, force, threads, report(progress))
    result: dict[str, Any] = json.loads(told)
    tell(result["findings"])
    return result
