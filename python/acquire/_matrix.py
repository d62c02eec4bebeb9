"""Matrix stores."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ._errors import InputError
from ._material import Floats, Path
from ._native import native

if TYPE_CHECKING:
    import xarray


class Rows(NamedTuple):
    """Consecutive rows of a matrix, shape (n, dy, dx, 3) each.

    :param response: R_d, mm⁻²; NaN where it was not measured.
    :param variance: its variance, mm⁻⁴; 0 where it is not known, NaN where not measured.
    :param valid: whether it was measured.
    """

    response: npt.NDArray[np.float32]
    variance: npt.NDArray[np.float32]
    valid: npt.NDArray[np.bool_]


class Matrix:
    """A matrix store ``*.rd.zarr``, this program's or one that zarr-python, xarray or dask wrote (``docs/matrix-format.md``).

    Its numbers are read when they are asked for.
    """

    def __init__(self, native_matrix: Any, path: str) -> None:
        self._native = native_matrix
        self._header: dict[str, Any] = json.loads(native_matrix.header())
        #: Where it is.
        self.path = path

    @classmethod
    def open(cls, path: Path) -> Matrix:
        """Opens a store, and reads everything but the rows.

        :raises InputError: when it is no matrix; the text says which array or attribute, what was expected and what was found.
        """
        name = os.fspath(path)
        return cls(native.NativeMatrix.open(name), name)

    def __repr__(self) -> str:
        (x, y), (w, h) = self.points, self.window
        return f"<acquire.Matrix {self.path}: {x} × {y} points, windows of {w} × {h} samples of {self.pitch_mm} mm>"

    def __len__(self) -> int:
        return self.points[0] * self.points[1]

    @property
    def info(self) -> dict[str, Any]:
        """Everything but the rows and places: ``points``, ``window``, ``pitch_mm``, ``lit_pitch_mm``, ``channels``, ``shots``, ``findings``, ``provenance``."""
        return dict(self._header)

    @property
    def points(self) -> tuple[int, int]:
        """Lit points along x and y."""
        return tuple(self._header["points"])

    @property
    def window(self) -> tuple[int, int]:
        """Samples of a window along x and y."""
        return tuple(self._header["window"])

    @property
    def pitch_mm(self) -> float:
        """Side of a sample, mm."""
        return self._header["pitch_mm"]

    @property
    def lit_mm(self) -> Floats:
        """Where the light really fell, mm, shape (points along y, points along x, 2), x first."""
        x, y = self.points
        return self._native.places()[0].reshape(y, x, 2)

    def read(self, start: int = 0, stop: int | None = None) -> Rows:
        """Rows from ``start`` to before ``stop`` (default: the last), row-major over (y, x)."""
        stop = len(self) if stop is None else stop
        if not 0 <= start <= stop <= len(self):
            raise InputError(f"rows: expected a range within 0 to {len(self)}, found {start} to {stop}", "Setting")
        response, variance, valid = self._native.read(start, stop)
        measured = valid.astype(bool)
        response[~measured] = np.nan
        variance[~measured] = np.nan
        return Rows(response, variance, measured)

    @property
    def response(self) -> npt.NDArray[np.float32]:
        """All responses, mm⁻², shape (y_i, x_i, dy, dx, 3); NaN where not measured. For matrices that fit into memory; else :meth:`read` or :meth:`to_xarray`."""
        (x, y), (w, h) = self.points, self.window
        return self.read().response.reshape(y, x, h, w, 3)

    def to_xarray(self) -> xarray.Dataset:
        """The store as a lazy xarray ``Dataset`` (needs xarray and zarr-python 3)."""
        import xarray

        return xarray.open_zarr(self.path, consolidated=False)
