"""Subsurface-scattering matrices R_d(x_i, x_o) and factored materials.

A *matrix* holds R_d, the radiant exitance at x_o per unit of radiant flux that arrives at x_i, in mm⁻², in windows around lit points; a
*material* is its factored form, thousands of times smaller, that a renderer evaluates. Lengths are mm; arrays are ``(y, x)``; channels are
linear R, G, B.

    import acquire
    material = acquire.factor("slab.rd.zarr")
    material.response([[1.0, 1.2]], [[1.1, 1.3]])        # (1, 3), mm⁻²

``docs/python.md`` of the repository has the rest.
"""

from ._commands import assemble, build_matrix, evaluate, extract, factor, import_matrix, prepare, simulate, write_matrix
from ._errors import Error, FindingWarning, InputError, InternalError
from ._material import Exitance, Material
from ._matrix import Matrix
from ._native import has_opencv, version as __version__

__all__ = [
    "Error",
    "Exitance",
    "FindingWarning",
    "InputError",
    "InternalError",
    "Material",
    "Matrix",
    "__version__",
    "assemble",
    "build_matrix",
    "evaluate",
    "extract",
    "factor",
    "has_opencv",
    "import_matrix",
    "prepare",
    "simulate",
    "write_matrix",
]
