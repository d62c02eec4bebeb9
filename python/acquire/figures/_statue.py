"""A statue made by code: a twisted, dented column on a foot, its surface by marching cubes, its UVs by xatlas."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

#: Height of the statue, mm.
HEIGHT_MM = 80.0


def _union(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Smooth minimum of two distances."""
    h = np.clip(0.5 + 0.5 * (b - a) / radius, 0, 1)
    return b + (a - b) * h - radius * h * (1 - h)


def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Signed distance, roughly, in heights of the statue: z from 0 to 1, the axis at x = y = 0."""
    turn = 2.4 * z + 0.4
    u, v = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    waist = 0.13 + 0.05 * np.cos(2 * np.pi * 1.2 * (z - 0.1))
    angle = np.arctan2(v, u)
    body = np.hypot(u, v * 1.25) - waist * (1 + 0.1 * np.cos(5 * angle))
    body = np.maximum(body, np.abs(z - 0.42) - 0.34)
    head = np.sqrt((x - 0.03) ** 2 + y**2 + ((z - 0.85) * 0.85) ** 2) - 0.115
    nose = np.sqrt((x - 0.13) ** 2 + y**2 + (z - 0.84) ** 2) - 0.035
    arm = np.hypot(np.hypot(x * 0.9, z - 0.52) - 0.21, y + 0.02 + 0.1 * (z - 0.5)) - 0.035
    foot = np.maximum(np.hypot(x, y) - 0.26, np.abs(z - 0.05) - 0.05)
    shape = _union(_union(body, head, 0.06), nose, 0.02)
    return _union(_union(shape, arm, 0.04), foot, 0.05)


def statue(path: Path, cells: int = 96) -> float:
    """Writes the mesh as PLY and returns its millimetres per unit of UV.

    :param cells: of marching cubes along the height.
    """
    import xatlas
    from skimage.measure import marching_cubes

    step = 1.0 / cells
    across, up = np.arange(-0.36, 0.36, step), np.arange(-0.05, 1.1, step)
    x, y, z = np.meshgrid(across, across, up, indexing="ij")
    places, faces, _, _ = marching_cubes(distance(x, y, z), 0.0, spacing=(step,) * 3)
    places = (places + [across[0], across[0], up[0]]) * HEIGHT_MM
    corners = places[faces]
    if np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]  # counterclockwise seen from outside
    normals = _normals(places, faces)
    atlas = xatlas.Atlas()
    atlas.add_mesh(places.astype(np.float32), faces.astype(np.uint32))
    charts = xatlas.ChartOptions()
    charts.max_cost, charts.max_iterations = 12.0, 2  # few and large charts
    atlas.generate(chart_options=charts)
    vertices, faces, uv = atlas[0]
    uv = _unmirrored(uv, faces)
    corners = places[vertices][faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    _write(path, places[vertices], normals[vertices], uv, faces)
    return float(np.sqrt(area / np.abs(_turns(uv, faces)).sum()))


def _normals(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of vertices, faces by their area."""
    corners, sums = places[faces], np.zeros_like(places)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(sums, faces[:, k], across)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)


def _turns(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the signed area of each face on the chart."""
    flat = uv[faces]
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _unmirrored(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Every chart turned so that nothing is mirrored; charts may then overlap, which a picture does not mind."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    _, chart = connected_components(coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(uv), len(uv))), directed=False)
    turned = np.bincount(chart[faces[:, 0]], _turns(uv, faces), minlength=chart.max() + 1) < 0
    out = uv.copy()
    out[turned[chart], 0] *= -1
    return out


def _write(path: Path, places: np.ndarray, normals: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> None:
    mesh = mi.Mesh("statue", len(places), len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    values = mi.traverse(mesh)
    for name, array in (("vertex_positions", places), ("vertex_normals", normals), ("vertex_texcoords", uv)):
        values[name] = array.ravel().astype(np.float32)
    values["faces"] = faces.ravel().astype(np.uint32)
    values.update()
    mesh.write_ply(str(path))
