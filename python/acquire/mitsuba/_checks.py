"""What a scene must have, told in sentences before anything is rendered."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import InputError


#: Rays along each side of the picture that look at the shapes, and the fewest on a shape that tell which side is seen.
_LOOKS, _FEWEST_LOOKS = 64, 16
#: Share of what the camera sees of a shape that must be its inside for it to be refused: holes of a closed mesh show its other side, and interpolated normals
#: turn away at the outline (3 of 4064 places on a ball of 506 triangles).
_MOSTLY = 0.9


def slabs_of(scene: mi.Scene, sensor: mi.Sensor | int | None = None) -> list:
    """The BSDFs ``acquire_slab`` of a scene, after a look at the shapes that have them.

    :param sensor: whose picture will be made, or its number in the scene; default: no camera looks.
    :raises InputError: no shapes, none of this material, shapes without UVs or too small for their material, a shape that the camera sees from inside.
    """
    shapes = scene.shapes()
    if not shapes:
        raise InputError("scene: expected a shape, found none: there is nothing to render", "Setting")
    slabs: list = []
    of_slabs = [shape for shape in shapes if hasattr(shape.bsdf(), "factors")]
    for shape in of_slabs:
        bsdf = shape.bsdf()
        if shape.is_mesh():
            _check_mesh(shape, bsdf)
        if not any(bsdf is other for other in slabs):
            slabs.append(bsdf)
    if not slabs:
        raise InputError(f"scene: expected a shape with the bsdf acquire_slab, found none among {len(shapes)}: use the integrator path", "Setting")
    if isinstance(sensor, int):
        sensor = scene.sensors()[sensor] if sensor < len(scene.sensors()) else None
    if sensor is not None:
        _check_sides(scene, sensor, of_slabs)
    return slabs


def name_of(shape: mi.Shape) -> str:
    """How messages call a shape."""
    return f"shape {shape.id() or 'without id'}"


def _check_sides(scene: mi.Scene, sensor: mi.Sensor, shapes: list) -> None:
    """A shape of which the camera sees the inside only would be black: light enters and leaves on the side of the normals."""
    at = (np.arange(_LOOKS) + 0.5) / _LOOKS
    x, y = (v.ravel() for v in np.meshgrid(at, at))
    if dr.is_jit_v(mi.Float):
        hits = [_look(scene, sensor, mi.Point2f(x, y), shapes)]
    else:
        hits = [_look(scene, sensor, mi.Point2f(*p), shapes) for p in zip(x, y)]
    which, face, normal = (np.concatenate([np.atleast_1d(np.array(h[k])) for h in hits]) for k in range(3))
    for number, shape in enumerate(shapes):
        hit = which == number
        outside = hit & (face > 0)
        seen = (outside & (normal > 0)).sum()
        if hit.sum() < _FEWEST_LOOKS or seen > (1 - _MOSTLY) * hit.sum():
            continue
        inside = hit.sum() - outside.sum()
        where = f"{name_of(shape)}: of {hit.sum()} places that the camera sees"
        if 2 * inside > hit.sum():
            why = f"{inside} are on its inside: its faces look inwards, or away from the camera; set flip_normals in Mitsuba, or turn the faces round"
        else:
            why = f"{(outside & (normal <= 0)).sum()} have vertex normals that point to the inside; set face_normals in Mitsuba, or compute the normals anew"
        raise InputError(f"{where}, {why}: a material is black from inside", "Setting")


def check_baked_sides(scene: mi.Scene, mesh: mi.Mesh, covered: np.ndarray, dark: np.ndarray) -> None:
    """No camera looks at a bake: vertex normals that point against their faces, and a mesh in the dark that has itself before its faces.

    :param covered: texels over its UVs, (v, u), where it is.
    :param dark: those of them that no light reached.
    """
    v, u = np.nonzero(covered)
    si = mesh.eval_parameterization(mi.Point2f((u + 0.5) / len(covered), (v + 0.5) / len(covered)))
    there = np.array(si.is_valid())
    against = (there & np.array(dr.dot(si.n, si.sh_frame.n) < 0)).sum()
    where = f"{name_of(mesh)}: of {there.sum()} texels"
    if against > _MOSTLY * there.sum():
        raise InputError(f"{where}, {against} have vertex normals against their faces: set face_normals in Mitsuba, or compute the normals anew", "Setting")
    ahead = scene.ray_intersect(si.spawn_ray(si.n))
    itself = (there & np.array(ahead.is_valid() & (ahead.shape == mi.ShapePtr(mesh)))).sum()
    if dark.sum() > _MOSTLY * covered.sum() and itself > _MOSTLY * there.sum():
        raise InputError(
            f"{where}, {dark.sum()} are dark and {itself} have the mesh itself before them: its faces look inwards; set flip_normals in Mitsuba, or turn the faces round",
            "Setting",
        )


def _look(scene: mi.Scene, sensor: mi.Sensor, place: mi.Point2f, shapes: list) -> tuple:
    """What a ray of the camera meets: which of the shapes (−1: none), and the cosines to its face's normal and to its vertices'."""
    ray = sensor.sample_ray(0, 0.5, place, mi.Point2f(0.5))[0]
    si = scene.ray_intersect(ray)
    which = mi.Int32(-1)
    for number, shape in enumerate(shapes):
        same = si.shape == (mi.ShapePtr(shape) if dr.is_jit_v(mi.Float) else shape)
        which = dr.select(si.is_valid() & same, number, which)
    return which, -dr.dot(si.n, ray.d), -dr.dot(si.sh_frame.n, ray.d)


def _check_mesh(mesh: mi.Mesh, slab) -> None:
    name = name_of(mesh)
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
            warnings.warn(
                f"{name}: {100 * small:.1f} % of its area has inverted UVs, against the rest: there it shows the mirror image of the material, "
                "what is left of a place and what is right of it exchanged; albedo and distances stay"
            )
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
