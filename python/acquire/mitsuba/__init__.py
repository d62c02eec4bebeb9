"""Factored materials in Mitsuba 3, on any geometry and under any light.

    import mitsuba as mi
    import acquire.mitsuba
    acquire.mitsuba.use("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")      # <integrator type="acquire_path"/>, <bsdf type="acquire_slab"> …

Importing this registers the BSDF ``acquire_slab`` (a material under a coat) and the integrator ``acquire_path`` for every variant that is set afterwards, and for
the present one. ``docs/rendering.md`` of the repository has their parameters and equations.
"""

from __future__ import annotations

from typing import Any

from .. import InputError

try:
    import mitsuba as mi
except ModuleNotFoundError as error:
    raise InputError('acquire.mitsuba: expected Mitsuba 3, found none: pip install "./python[mitsuba]"', "Setting") from error


def _register(old: str | None, new: str | None) -> None:
    if not new or not new.endswith("_rgb"):
        return
    from ._integrator import make_integrator
    from ._slab import make_slab

    slab, integrator = make_slab(mi.BSDF), make_integrator(mi.SamplingIntegrator)
    mi.register_bsdf("acquire_slab", slab)
    mi.register_integrator("acquire_path", integrator)


from ._bake import Baked, bake  # noqa: E402
from ._variants import find_llvm, use  # noqa: E402


def render(scene: mi.Scene, **options: Any) -> mi.TensorXf:
    """``mi.render`` after a look at the scene: what is wrong with it is an ``InputError``.

    ``mi.render`` alone raises the same in a JIT variant as the cause of a ``RuntimeError``.

    :param options: those of ``mi.render``: ``spp``, ``seed``, ``sensor``, ``integrator``.
    :raises InputError: no shapes, none of this material, no UVs, a material larger than its mesh, a shape that the camera sees from inside.
    """
    from ._checks import slabs_of

    slabs_of(scene, options.get("sensor", 0))
    return mi.render(scene, **options)


mi.detail.add_variant_callback(_register)
_register(None, mi.variant())

__all__ = ["Baked", "bake", "find_llvm", "render", "use"]
