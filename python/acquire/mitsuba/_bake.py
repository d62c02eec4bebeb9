"""The exitance of a mesh as textures, for renderers that know no subsurface scattering."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from .. import InputError, Material
from ._checks import check_baked_sides, slabs_of
from ._export import write_all

#: Texels that a pitch has when no size is given, and the most of a side.
TEXELS_A_PITCH, MOST_TEXELS = 2, 4096
#: Pixels of the light that a tile is under.
PIXELS_A_PITCH = 4
#: Paths that are traced together: 32-bit counts and some GB of memory.
MOST_PATHS = 1 << 23

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Baked:
    """Maps over the UVs 0…1 of a mesh, shape (v, u, 3), row 0 at v = 0.

    :param irradiance: what arrives, each direction by its entry Fresnel relative to the normal; beside the charts that of the nearest texel.
    :param exitance: what leaves, in the unit of the irradiance; radiance is that over π.
    :param albedo: exitance under an even irradiance of 1: what a diffuse texture shows of the material.
    :param covered: where the mesh is, (v, u).
    """

    irradiance: Image
    exitance: Image
    albedo: Image
    covered: npt.NDArray[np.bool_]


def bake(
    scene: mi.Scene, folder: str | os.PathLike[str] | None = None, *, shape: str | None = None, size: int | None = None, spp: int = 256, seed: int = 0, force: bool = False
) -> Baked:
    """Exitance of one mesh under a scene's light, as a texture: irradiance by Mitsuba, then ``Material.relight`` tile by tile.

    Light is spread over the UV chart, not over the surface: at a chart's border the nearest texels' irradiance stands for what lies beyond. What leaves is even
    over all directions (as ``exit_fresnel = false``).

    :param folder: where to write ``exitance.exr``, ``albedo.exr``, ``albedo.png``, ``mesh.ply``, ``scene.xml`` (Mitsuba), ``slab.glb`` (glTF), ``blender.py`` (Cycles).
    :param shape: the id of the mesh; needed where several have a material.
    :param size: texels of a side; default: two for each sample of the material, at most 4096.
    :param spp: paths for each texel.
    :param force: replace an earlier bake.
    :raises InputError: no such mesh, UVs that leave 0…1 or overlap, a JIT variant missing, the wrap ``clamp``, faces or vertex normals that look inwards, a folder that is not of an earlier bake.
    """
    if not dr.is_jit_v(mi.Float):
        raise InputError(f"bake: expected a JIT variant such as llvm_ad_rgb, found {mi.variant()}", "Setting")
    mesh = _mesh(scene, shape)
    slab = mesh.bsdf()
    if slab.factors.wrap == "clamp":
        raise InputError("bake: expected the wrap repeat, mirror or none, found clamp: its outermost rows have no end", "Setting")
    if not isinstance(slab.source, Material):
        raise InputError(f"bake: expected a material, found the matrix {slab.filename}: factor it first", "Setting")
    size = size or min(MOST_TEXELS, int(np.ceil(TEXELS_A_PITCH * slab.mm_per_uv / slab.factors.pitch_mm)))
    found, covered = _irradiance(scene, mesh, size, spp, seed)
    check_baked_sides(scene, mesh, covered, covered & ~found.any(-1))
    reach = int(np.ceil(np.hypot(*slab.factors.window) / 2 * slab.factors.pitch_mm / slab.mm_per_uv * size)) + 1
    irradiance = _spread(found, covered, reach)
    exitance, albedo = (_relit(slab, image) for image in (irradiance, np.ones_like(irradiance)))
    baked = Baked(irradiance, exitance, albedo, covered)
    if folder is not None:
        write_all(Path(folder), mesh, slab, baked, force)
    return baked


def _mesh(scene: mi.Scene, name: str | None) -> mi.Mesh:
    slabs_of(scene)
    meshes = [s for s in scene.shapes() if s.is_mesh() and hasattr(s.bsdf(), "factors") and name in (None, s.id())]
    if len(meshes) != 1:
        ids = ", ".join(m.id() for m in meshes) or "none"
        raise InputError(f"bake: shape: expected one mesh with the bsdf acquire_slab{f' and the id {name}' if name else ''}, found {ids}", "Setting")
    uv = np.array(meshes[0].vertex_texcoords_buffer())
    if uv.min() < -1e-4 or uv.max() > 1 + 1e-4:
        raise InputError(f"bake: expected UVs from 0 to 1, found {uv.min():.3g} to {uv.max():.3g}: a texture has one texel for one place", "Setting")
    return meshes[0]


def _irradiance(scene: mi.Scene, mesh: mi.Mesh, size: int, spp: int, seed: int) -> tuple[Image, np.ndarray]:
    """Mean irradiance of every texel, (v, u, 3), and which texels the mesh covers."""
    integrator = mi.load_dict({"type": "acquire_path"})
    sums, hits = np.zeros((3, size * size), np.float32), np.zeros(size * size, np.float32)
    rounds = -(-spp * size * size // MOST_PATHS)
    for k in range(rounds):
        each = -(-spp // rounds)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * rounds + k, size * size * each)
        texel = dr.arange(mi.UInt32, size * size * each) // each
        place = mi.Point2f(texel % size, texel // size) + sampler.next_2d()
        si = mesh.eval_parameterization(place / size)
        there = si.is_valid()
        light = dr.select(there, integrator.irradiance_at(scene, sampler, mesh.bsdf(), si, there), 0)
        sums += np.stack([np.array(dr.block_sum(light[c], each)) for c in range(3)])
        hits += np.array(dr.block_sum(mi.Float(there), each))
    mean = np.pi * sums / np.maximum(hits, 1)
    return mean.T.reshape(size, size, 3), hits.reshape(size, size) > 0


def _spread(image: Image, covered: np.ndarray, reach: int) -> Image:
    """The mean of the neighbours into texels that have none of their own, ring by ring, as far as light spreads."""
    image, there = np.where(covered[..., None], image, 0), covered.copy()
    for _ in range(reach):
        if there.all():
            break
        sums, counts = np.zeros_like(image), np.zeros(there.shape, np.float32)
        for axis in (0, 1):
            for step in (-1, 1):
                inner = [slice(None), slice(None)]
                outer = [slice(None), slice(None)]
                inner[axis], outer[axis] = (slice(1, None), slice(None, -1)) if step > 0 else (slice(None, -1), slice(1, None))
                sums[tuple(outer)] += np.where(there[tuple(inner)][..., None], image[tuple(inner)], 0)
                counts[tuple(outer)] += there[tuple(inner)]
        new = ~there & (counts > 0)
        image[new] = sums[new] / counts[new][:, None]
        there |= new
    return image


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """An image at places in pixels, the rim's beyond it, (…, 3)."""
    lines, columns, _ = image.shape
    x, y = np.clip(x, 0, columns - 1), np.clip(y, 0, lines - 1)
    i, j = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), lines - 2)
    a, b = (x - i)[..., None], (y - j)[..., None]
    return (image[j, i] * (1 - a) + image[j, i + 1] * a) * (1 - b) + (image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a) * b


def _relit(slab, irradiance: Image) -> Image:
    """Exitance of every texel: each tile of the material under its part of the light, added up."""
    factors, size = slab.factors, irradiance.shape[0]
    mm = slab.mm_per_uv / size
    tile = np.array(factors.tile_mm)
    reach = np.array(factors.window) * factors.pitch_mm / 2
    texels = (np.arange(size) + 0.5) * mm  # from the tile's corner
    out = np.zeros((size, size, 3))
    for number in _tiles(factors, slab.mm_per_uv, reach):
        start = number * np.ptp(tile, axis=1)
        mirrored = (number % 2 == 1) & (factors.wrap == "mirror")
        relit = slab.source.relight(_tile_light(irradiance, factors, start, mirrored, mm), extent_mm=tuple(tile.ravel()))
        # Texels that this tile's light reaches, in the tile's own coordinates.
        along = [tile[a, 1] - (texels - start[a]) if mirrored[a] else tile[a, 0] + texels - start[a] for a in (0, 1)]
        near = [np.nonzero((v > at[0]) & (v < at[-1]))[0] for v, at in zip(along, (relit.x_mm, relit.y_mm))]
        columns, lines = ((v[n] - at[0]) / factors.pitch_mm for v, n, at in zip(along, near, (relit.x_mm, relit.y_mm)))
        out[np.ix_(near[1], near[0])] += _bilinear(relit.values, *np.meshgrid(columns, lines))
    return out.astype(np.float32)


def _tiles(factors, mm_per_uv: float, reach: np.ndarray) -> list[np.ndarray]:
    """Numbers along x and y of the tiles whose light reaches uv 0…1."""
    if factors.wrap == "none":
        return [np.array([0, 0])]
    sides = np.ptp(factors.tile_mm, axis=1)
    along = [range(-int(np.ceil(reach[a] / sides[a])), int(np.ceil((mm_per_uv + reach[a]) / sides[a]))) for a in (0, 1)]
    return [np.array([x, y]) for y in along[1] for x in along[0]]


def _tile_light(irradiance: Image, factors, start: np.ndarray, mirrored: np.ndarray, mm: float) -> Image:
    """The light on one tile as an image over it; beyond uv 0…1 that of the rim."""
    light = []
    for a, flip in enumerate(mirrored):
        side = np.ptp(factors.tile_mm[a])
        count = int(np.ceil(PIXELS_A_PITCH * side / factors.pitch_mm))
        along = (np.arange(count) + 0.5) / count * side
        light.append((start[a] + (side - along if flip else along)) / mm - 0.5)
    return _bilinear(irradiance, *np.meshgrid(*light)).astype(np.float32)
