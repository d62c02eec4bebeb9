"""What a scene must have, told in sentences before anything is rendered."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np

from .. import InputError


def slabs_of(scene: mi.Scene) -> list:
    """The BSDFs ``acquire_slab`` of a scene, after a look at the shapes that have them.

    :raises InputError: no shapes, none of this material, shapes without UVs, or too small for their material.
    """
    shapes = scene.shapes()
    if not shapes:
        raise InputError("scene: expected a shape, found none: there is nothing to render", "Setting")
    slabs: list = []
    for shape in shapes:
        bsdf = shape.bsdf()
        if bsdf is None or not hasattr(bsdf, "factors"):
            continue
        if shape.is_mesh():
            _check_mesh(shape, bsdf)
        if not any(bsdf is other for other in slabs):
            slabs.append(bsdf)
    if not slabs:
        raise InputError(f"scene: expected a shape with the bsdf acquire_slab, found none among {len(shapes)}: use the integrator path", "Setting")
    return slabs


def _check_mesh(mesh: mi.Mesh, slab) -> None:
    name = f"shape {mesh.id() or 'without id'}"
    if not mesh.has_vertex_texcoords():
        raise InputError(f"{name}: expected UVs, found none: a material is placed by them; unwrap the mesh (Blender, xatlas)", "Setting")
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)
    uv = np.array(mesh.vertex_texcoords_buffer(), dtype=float).reshape(-1, 2)[faces]
    place = np.array(mesh.vertex_positions_buffer(), dtype=float).reshape(-1, 3)[faces]
    area = np.linalg.norm(np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]), axis=1)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    flat = area[turn == 0].sum() / max(area.sum(), 1e-300)
    if not flat < 0.01:
        raise InputError(f"{name}: {100 * flat:.0f} % of its area has UVs without area: unwrap the mesh anew", "Setting")
    if (turn > 0).any() and (turn < 0).any():
        small = min(area[turn > 0].sum(), area[turn < 0].sum()) / area.sum()
        if small > 1e-3:
            warnings.warn(f"{name}: {100 * small:.0f} % of its area has inverted UVs: the material is mirrored there")
    _check_size(name, uv, slab)


def _check_size(name: str, uv: np.ndarray, slab) -> None:
    """The mesh must hold a window; a smaller part than all of the material is worth a word."""
    factors = slab.factors
    spans = np.ptp(uv.reshape(-1, 2), axis=0) * slab.mm_per_uv
    reach = np.array(factors.window) * factors.pitch_mm
    sides = np.ptp(factors.tile_mm, axis=1)
    words = lambda v: f"{v[0]:.3g} × {v[1]:.3g} mm"  # noqa: E731
    if (spans < reach / 2).any():
        raise InputError(
            f"{name}: its UVs span {words(spans)} at mm_per_uv = {slab.mm_per_uv:g}, and light in {slab.filename} spreads over {words(reach)}: "
            "the material is larger than the mesh; raise mm_per_uv",
            "Setting",
        )
    if (spans < 0.99 * sides).any():
        warnings.warn(f"{name}: shows {words(np.minimum(spans, sides))} of {slab.filename}, which is {words(sides)}: mm_per_uv is {slab.mm_per_uv:g}")
